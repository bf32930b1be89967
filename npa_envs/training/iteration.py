"""One iteration's rollout, loss and gradients, launched kernel by kernel or as a CUDA graph."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Any, Literal, Protocol, TypedDict, Unpack

import torch
from torch import Tensor

from npa_envs.rule.rule import LIFE, NPARule, fate_parameters
from npa_envs.tasks.base import Task
from npa_envs.tasks.damage import counted_together
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.randomness import registered
from npa_envs.world.cuda_graph import GraphSequence, capture, host_call
from npa_envs.world.division import living
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.rollout import Memory

WARM_UP_STEPS = 2
"""Steps of the eager rollout that loads every kernel before the first capture."""


class TrainingOptions(TypedDict):
    """Keyword arguments that the trainer gives a rollout."""

    eps: float
    box: tuple[float, ...] | None
    update_prob: float
    memory: Memory
    generator: Randomness
    return_path_length: Literal[True]


class Rollout(Protocol):
    """`npa_envs.rollout` as the trainer calls it."""

    def __call__(
        self, rule: NPARule, x: Tensor, s: Tensor, steps: int, /, **options: Unpack[TrainingOptions]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions, states and path lengths after `steps` steps."""


def power_mean(values: Tensor, power: float) -> Tensor:
    """Return (mean |a|^power)^(1/power) of each world's values, shape [B].

    Args:
        values: Numbers, shape [B, ...].
        power: At least 1 and at most `LARGEST_POWER`.
    """
    each = values.flatten(1)
    # A vector's norm has a gradient of 0 where all is at rest.
    norm: Tensor = torch.linalg.vector_norm(each, power, dim=1)
    return norm / math.pow(each.shape[1], 1.0 / power)


class EagerIteration:
    """One iteration up to the gradients, launched kernel by kernel.

    Reads `start`; writes `end`, `terms` and the `.grad` of every parameter. All of these are the
    same tensors in every iteration: fill them with `copy_`.
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
        """Worlds before the rollout."""
        self.end = self.start._replace(x=torch.empty_like(worlds.x), s=torch.empty_like(worlds.s))
        """Worlds after the rollout, with the same goals."""
        x, s, _, goal = self.start
        task = task.toward(goal)
        self.grown = torch.zeros_like(x[:, 0, 0], dtype=torch.bool)
        """Which worlds are grown and whole, and are to rest, shape [B]."""
        self._stillness_weight = config.stillness_weight
        self._stillness_power = config.stillness_power
        self._mean_over_processes = mean_over_processes
        self._divides = bool(fate_parameters(rule))
        self._task = task
        with torch.no_grad():
            total, parts = self._loss(x, s, torch.zeros_like(x[..., 0]))
        self.term_names: tuple[str, ...] = ("loss", *parts)
        """Names of `terms`."""
        self.terms = total.new_zeros(len(self.term_names))
        """The loss and then its named parts, shape [K]."""
        self.parameters = [p for p in rule.parameters() if p.requires_grad]
        """What the gradients are for."""
        self.gradients = [torch.zeros_like(p) for p in self.parameters]
        """Their `.grad`."""
        for parameter, buffer in zip(self.parameters, self.gradients, strict=True):
            parameter.grad = buffer
        self._rule = rule
        self._memory = config.memory
        self._generator = generator
        self._rollout = rollout

    def run(self, steps: int) -> None:
        """Run the rollout, the loss and the backward pass."""
        self._forward_backward(steps)

    def _forward_backward(self, steps: int) -> None:
        # Through these states codes learn; the pool holds them as they were.
        s0 = self._task.coded(self.start.s)
        if s0 is not self.start.s:
            self.start.s.copy_(s0.detach())
        x, s, path_length = self._rollout(
            self._rule,
            self.start.x,
            s0,
            steps,
            eps=self._task.eps,
            box=self._task.box,
            update_prob=self._task.update_prob,
            memory=self._memory,
            generator=self._generator,
            return_path_length=True,
        )
        alone = self._mean_over_processes is None
        with contextlib.nullcontext() if alone else counted_together(self._mean):
            total, parts = self._loss(x, s, path_length)
        # Not backward(): its accumulation nodes remember the stream they were first used on,
        # which a capture on another stream must not touch.
        gradients = torch.autograd.grad(
            total, self.parameters, allow_unused=True, materialize_grads=True
        )
        for buffer, gradient in zip(self.gradients, gradients, strict=True):
            buffer.copy_(gradient)
        self.terms.copy_(torch.stack([total, *parts.values()]).detach())
        self.end.x.copy_(x.detach())
        self.end.s.copy_(s.detach())

    def _mean(self, value: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes, taken between two graphs."""
        assert self._mean_over_processes is not None, "shared by several processes"
        own, over = value.detach().clone(), self._mean_over_processes
        mean = torch.empty_like(own)
        host_call(lambda: mean.copy_(over(own)))
        return mean

    def _loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the task's loss and its parts, and how far grown worlds are from rest."""
        total, parts = self._task.loss(x, s, path_length)
        if self._stillness_weight > 0.0:
            change = s - self.start.s
            if self._divides:
                # Births and deaths are no unrest; who lives is the business of the task's loss.
                stayed = (living(s) & living(self.start.s))[..., None]
                change = torch.where(stayed, change, 0.0)[..., LIFE + 1 :]
            moved, changed = (
                power_mean(each, self._stillness_power) for each in (path_length, change)
            )
            unrest = moved / self._task.eps + changed
            parts["rest"] = (self.grown.to(x.dtype) * unrest).mean()
            total = total + self._stillness_weight * parts["rest"]
        return total, parts


class GraphedIteration(EagerIteration):
    """The same on CUDA, captured once for every number of steps and replayed from then on.

    Launches of thousands of short kernels would otherwise take longer than the kernels do. All
    graphs share one memory pool: they never run at the same time, and everything that outlives a
    replay lies in buffers outside that pool. What processes take means of within an iteration, they
    take between two graphs: torch does not watch what a graph replays for processes that do not
    answer.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._graphs: dict[int, GraphSequence] = {}
        self._memory_pool = torch.cuda.graph_pool_handle()

    def run(self, steps: int) -> None:
        """Replay the graph for this number of steps, capturing it when it is first asked for."""
        with torch.cuda.device(self.start.x.device):
            if steps not in self._graphs:
                self._graphs[steps] = capture(
                    lambda: self._forward_backward(steps),
                    self.start.x.device,
                    pool=self._memory_pool,
                    generator=registered(self._generator),
                    warm_up=None if self._graphs else self._warm_up,
                )
            self._graphs[steps].replay()

    def _warm_up(self) -> None:
        """Run eagerly once: load kernels and allocate workspaces, which no capture may do."""
        # A resumed run warms up again: the masks that follow must not depend on that.
        generator = self._generator
        if isinstance(generator, WorldRandom):
            streams = generator.take(slice(None))
            self._forward_backward(WARM_UP_STEPS)
            generator.put(slice(None), streams)
            return
        state = generator.get_state()
        self._forward_backward(WARM_UP_STEPS)
        generator.set_state(state)
