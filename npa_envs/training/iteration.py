"""Rollout, loss and gradients of one iteration, eager or as a CUDA graph; loss statistics."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, TypedDict, Unpack

import torch
from torch import Tensor, nn

from npa_envs.errors import DivergedError, shown
from npa_envs.rule.rule import LIFE, NPARule, fate_parameters
from npa_envs.tasks.base import Task
from npa_envs.tasks.damage import counted_together
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.ranks import registered
from npa_envs.world.cuda_graph import GraphSequence, capture, host_call
from npa_envs.world.division import living
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.rollout import Memory

WARM_UP_STEPS = 2
"""Steps of the eager rollout that loads every kernel before the first capture."""


class TrainingOptions(TypedDict):
    """Keyword arguments of a rollout in training."""

    eps: float
    box: tuple[float, ...] | None
    update_prob: float
    memory: Memory
    generator: Randomness
    return_path_length: Literal[True]


class Rollout(Protocol):
    """Type of `npa_envs.rollout` in training."""

    def __call__(
        self, rule: NPARule, x: Tensor, s: Tensor, steps: int, /, **options: Unpack[TrainingOptions]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions, states and path lengths after `steps` steps."""


def power_mean(values: Tensor, power: float) -> Tensor:
    """Return (mean |a|^power)^(1/power) of each world's values [B, ...], shape [B]."""
    each = values.flatten(1)
    # The gradient of a vector's norm is 0 at 0.
    norm: Tensor = torch.linalg.vector_norm(each, power, dim=1)
    return norm / math.pow(each.shape[1], 1.0 / power)


class EagerIteration:
    """One iteration up to the gradients, launched kernel by kernel.

    Reads `start`; writes `end`, `terms` and the `.grad` of every parameter, always in the same
    tensors: write to `start` with `copy_`.
    """

    def __init__(
        self,
        task: Task,
        rule: NPARule,
        config: TrainConfig[Any],
        worlds: Particles,
        generator: Randomness,
        rollout: Rollout,
        *,
        mean_over_processes: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        self.start = worlds.map(torch.clone)
        self.end = self.start._replace(x=torch.empty_like(worlds.x), s=torch.empty_like(worlds.s))
        task = task.with_goal(self.start.goal)
        self.grown = torch.zeros_like(worlds.x[:, 0, 0], dtype=torch.bool)
        """Worlds to which the stillness loss applies, bool, shape [B]."""
        self._stillness_weight = config.stillness_weight
        self._stillness_power = config.stillness_power
        self._mean_over_processes = mean_over_processes
        self._divides = bool(fate_parameters(rule))
        self._task = task
        with torch.no_grad():
            total, parts = self._loss(self.start.with_zero_paths())
        self.term_names: tuple[str, ...] = ("loss", *parts)
        """Names of `terms`."""
        self.terms = total.new_zeros(len(self.term_names))
        """The loss, followed by its named parts, shape [K]."""
        self.parameters = [p for p in rule.parameters() if p.requires_grad]
        self.gradients = [torch.zeros_like(p) for p in self.parameters]
        for parameter, buffer in zip(self.parameters, self.gradients, strict=True):
            parameter.grad = buffer
        self._rule = rule
        self._memory = config.memory
        self._generator = generator
        self._rollout = rollout

    def run(self, steps: int) -> None:
        """Run the rollout, the loss and the backward pass."""
        # Gradients of codes flow through these states; `start` keeps their values.
        first_states = self._task.with_target_code(self.start.s)
        if first_states is not self.start.s:
            self.start.s.copy_(first_states.detach())
        fields = self._rollout(
            self._rule,
            self.start.x,
            first_states,
            steps,
            eps=self._task.eps,
            box=self._task.box,
            update_prob=self._task.update_prob,
            memory=self._memory,
            generator=self._generator,
            return_path_length=True,
        )
        end = Particles(*fields)
        single = self._mean_over_processes is None
        with contextlib.nullcontext() if single else counted_together(self._mean):
            total, parts = self._loss(end)
        # Not backward(): its accumulation nodes remember the stream they were first used on,
        # which a capture on another stream must not touch.
        gradients = torch.autograd.grad(
            total, self.parameters, allow_unused=True, materialize_grads=True
        )
        for buffer, gradient in zip(self.gradients, gradients, strict=True):
            buffer.copy_(gradient)
        self.terms.copy_(torch.stack([total, *parts.values()]).detach())
        self.end.x.copy_(end.x.detach())
        self.end.s.copy_(end.s.detach())

    def _mean(self, value: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes, computed between two graphs."""
        assert self._mean_over_processes is not None, "there are several processes"
        own, over = value.detach().clone(), self._mean_over_processes
        mean = torch.empty_like(own)
        host_call(lambda: mean.copy_(over(own)))
        return mean

    def _loss(self, end: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the task's loss plus the stillness loss of grown worlds, and named parts."""
        total, parts = self._task.loss(end)
        if self._stillness_weight > 0.0:
            x, s, path = end.per_particle()
            change = s - self.start.s
            if self._divides:
                # Births and deaths do not count.
                stayed = (living(s) & living(self.start.s))[..., None]
                change = torch.where(stayed, change, 0.0)[..., LIFE + 1 :]
            moved, changed = (power_mean(each, self._stillness_power) for each in (path, change))
            unrest = moved / self._task.eps + changed
            parts["rest"] = (self.grown.to(x.dtype) * unrest).mean()
            total = total + self._stillness_weight * parts["rest"]
        return total, parts


class GraphedIteration(EagerIteration):
    """`EagerIteration` on CUDA, captured as a graph for each number of steps and then replayed.

    Launching thousands of short kernels would take longer than running them. All graphs share one
    memory pool: they never run at the same time, and all that is read after a replay is in buffers
    outside of that pool. Means over processes are computed between two graphs: torch does not
    notice lost processes inside a graph.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._graphs: dict[int, GraphSequence] = {}
        self._memory_pool = torch.cuda.graph_pool_handle()

    def run(self, steps: int) -> None:
        """Replay the graph for this number of steps, captured at the first use."""
        run_eagerly = super().run
        with torch.cuda.device(self.start.x.device):
            if steps not in self._graphs:
                self._graphs[steps] = capture(
                    lambda: run_eagerly(steps),
                    self.start.x.device,
                    pool=self._memory_pool,
                    generator=registered(self._generator),
                    warm_up=None if self._graphs else self._warm_up,
                )
            self._graphs[steps].replay()

    def _warm_up(self) -> None:
        """Run eagerly once, to load kernels and allocate workspaces, which a capture cannot do."""
        # A resumed run warms up again and must draw the same masks: so these draws do not count.
        generator = self._generator
        if isinstance(generator, WorldRandom):
            streams = generator.take(slice(None))
            super().run(WARM_UP_STEPS)
            generator.put(slice(None), streams)
        else:
            state = generator.get_state()
            super().run(WARM_UP_STEPS)
            generator.set_state(state)


# Loss statistics, and diagnosis of divergence.

NONE_YET = -1
"""Value of the bad iteration while every loss was finite."""


@dataclass(frozen=True)
class Interval:
    """Statistics of the iterations between two log lines."""

    means: dict[str, float]
    """Mean loss terms by name, mean `steps`, and the number of `replaced_worlds`."""

    bad_iteration: int | None
    """The first iteration of the run whose loss was not finite, or None."""


class LossMeter:
    """Sums of the loss terms, and a snapshot of the first iteration whose loss is not finite.

    `begin`, `observe` and `send` launch kernels and do not synchronise. `observe` can be captured
    in a CUDA graph: it reads and writes the same tensors in each iteration.
    """

    def __init__(self, iteration: EagerIteration) -> None:
        self._iteration = iteration
        device = iteration.terms.device
        # One tensor, so that one copy transfers all of them; float64, in which long sums keep their
        # digits and integers are exact.
        totals = torch.zeros(len(iteration.terms) + 3, dtype=torch.float64, device=device)
        self._totals = totals
        self._sums, self._replaced, self._bad = totals[:-3], totals[-3], totals[-2:]
        self._bad[0] = NONE_YET
        self._now = torch.zeros_like(self._bad)
        self._snapshot = {name: value.clone() for name, value in self._observed().items()}
        self._count = 0
        self._step_sum = 0
        on_cuda = device.type == "cuda"
        self._sent = torch.zeros(totals.shape, dtype=totals.dtype, device="cpu", pin_memory=on_cuda)
        self._sent_counts = (0, 0)
        self._arrival = torch.cuda.Event() if on_cuda else None  # type: ignore[no-untyped-call]

    def begin(self, number: int, steps: int) -> None:
        """Set the number and the steps of the iteration that is observed next."""
        self._now[0].fill_(number)
        self._now[1].fill_(steps)
        self._count += 1
        self._step_sum += steps

    def observe(self, replaced: Tensor) -> None:
        """Add an iteration, before the optimiser changes the parameters."""
        terms = self._iteration.terms
        self._sums += terms
        self._replaced += replaced.sum()
        # A comparison with NaN is false: one reduction finds both NaN and infinity.
        finite = torch.linalg.vector_norm(terms, math.inf) < math.inf
        first = ~finite & (self._bad[0] == NONE_YET)
        torch.where(first, self._now, self._bad, out=self._bad)
        for name, value in self._observed().items():
            torch.where(first, value, self._snapshot[name], out=self._snapshot[name])

    def send(self) -> None:
        """Start to copy the interval's statistics to the host, and begin the next interval."""
        self._sent.copy_(self._totals, non_blocking=True)
        if self._arrival is not None:
            self._arrival.record(torch.cuda.current_stream(self._totals.device))
        self._sent_counts = self._count, self._step_sum
        self._totals[:-2].zero_()
        self._count = 0
        self._step_sum = 0

    def receive(self) -> Interval:
        """Return the statistics of the last `send`; waits for that copy alone."""
        if self._arrival is not None:
            self._arrival.synchronize()
        count, step_sum = self._sent_counts
        count = max(count, 1)
        means = (self._sent[:-3] / count).tolist()
        replaced, bad_iteration, _ = map(int, self._sent[-3:].tolist())
        result = dict(zip(self._iteration.term_names, means, strict=True))
        result |= {"steps": step_sum / count, "replaced_worlds": replaced}
        return Interval(result, None if bad_iteration == NONE_YET else bad_iteration)

    def bad_iteration(self) -> int | None:
        """Return the first iteration whose loss was not finite, or None; synchronises."""
        number = int(self._bad[0].item())
        return None if number == NONE_YET else number

    def snapshot(self) -> dict[str, Any]:
        """Return the state of the first iteration whose loss was not finite, on the CPU.

        Returns:
            `iteration`, `steps`, `terms` (by name), `x0`, `s0` (before the rollout), `x`, `s`
            (after it), `parameters` (one flat vector), and `goal` where the task has goals.
        """
        values = {name: value.cpu() for name, value in self._snapshot.items()}
        terms = values.pop("terms").tolist()
        iteration, steps = map(int, self._bad.tolist())
        return {
            "iteration": iteration,
            "steps": steps,
            "terms": dict(zip(self._iteration.term_names, terms, strict=True)),
            **values,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the statistics of the current interval, for a checkpoint."""
        return {
            "sums": self._sums,
            "replaced": self._replaced,
            "count": self._count,
            "step_sum": self._step_sum,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the interval that `state_dict` returned."""
        self._sums.copy_(state["sums"])
        self._replaced.copy_(state["replaced"])
        self._count = state["count"]
        self._step_sum = state["step_sum"]

    def _observed(self) -> dict[str, Tensor]:
        iteration = self._iteration
        start, end = iteration.start, iteration.end
        goals = {} if start.goal is None else {"goal": start.goal}
        worlds = {"x0": start.x, "s0": start.s, "x": end.x, "s": end.s}
        flat = nn.utils.parameters_to_vector(iteration.parameters).detach()
        return goals | {"terms": iteration.terms} | worlds | {"parameters": flat}


def divergence_error(
    task: Task, rule: NPARule, snapshot: dict[str, Any], diagnosis: Path
) -> DivergedError:
    """Return the error that ends a run whose loss is not finite."""
    terms = [name for name, value in snapshot["terms"].items() if not math.isfinite(value)]
    visible = [name for name in terms if name != "loss"] or terms
    worlds = bad_worlds(task, rule, snapshot)
    where = f"world{'s' * (len(worlds) > 1)} {', '.join(map(str, worlds))}" if worlds else "no one"
    return DivergedError(
        f"the loss must stay finite, but {' and '.join(visible)} was not in iteration "
        f"{snapshot['iteration']} ({snapshot['steps']} steps, {where} of the batch): lower "
        "learning_rate, or use fewer steps; the worlds and the rule are in "
        f"{shown(str(diagnosis))}, the last good checkpoint is untouched"
    )


def bad_worlds(task: Task, rule: NPARule, snapshot: dict[str, Any]) -> list[int]:
    """Return the indices of the batch's worlds whose own loss is not finite."""
    rule = copy.deepcopy(rule).cpu()
    trained = [parameter for parameter in rule.parameters() if parameter.requires_grad]
    nn.utils.vector_to_parameters(snapshot["parameters"], trained)
    task = task.for_rule(rule)
    worlds = Particles(snapshot["x"], snapshot["s"], goal=snapshot.get("goal"))
    bad = []
    for index in range(len(worlds.x)):
        world = worlds.take(torch.tensor([index]))
        finite = all(bool(torch.isfinite(value).all()) for value in world.tensors())
        if finite:
            with torch.no_grad():
                total, parts = task.with_goal(world.goal).loss(world.with_zero_paths())
            finite = all(bool(torch.isfinite(v).all()) for v in (total, *parts.values()))
        if not finite:
            bad.append(index)
    return bad
