"""Rollout, loss and gradients of one training iteration, launched or as a CUDA graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from npa_envs.rule.rule import LIFE, fate_parameters
from npa_envs.tasks.base import Task
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.process_group import generator_to_register
from npa_envs.world.cuda_graph import GraphSequence, capture, host_call
from npa_envs.world.division import living
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom

WARM_UP_STEPS = 2
"""Number of steps of the launched rollout that loads every kernel before the first capture."""

Rollout = Callable[..., Particles]
"""A function as `rollout_particles`: of a rule, worlds and the number of steps."""


def power_mean(values: Tensor, power: float) -> Tensor:
    """Return (mean |a|^power)^(1/power) over each world's values a, [B, ...]; shape [B]."""
    each = values.flatten(1)
    # The gradient of a vector's norm is 0 at 0.
    norm: Tensor = torch.linalg.vector_norm(each, power, dim=1)
    return norm / math.pow(each.shape[1], 1.0 / power)


def _process_mean(take_means: Callable[[Sequence[Tensor]], None], value: Tensor) -> Tensor:
    """Return the mean of a tensor over all processes; in a capture, computed between two graphs."""
    mean = value.detach().clone()
    host_call(lambda: take_means([mean]))
    return mean


class EagerIteration:
    """One iteration from its start worlds to the gradients, launched kernel by kernel.

    `run` always reads and writes the same tensors: write to `start` with `copy_`. `take_means`
    replaces tensors by their means over all processes; None: there is one process.
    """

    def __init__(
        self,
        task: Task,
        rule: nn.Module,
        config: TrainConfig[Any],
        worlds: Particles,
        generator: Randomness,
        rollout: Rollout,
        *,
        take_means: Callable[[Sequence[Tensor]], None] | None = None,
    ) -> None:
        self.start = worlds.map(torch.clone)
        self.end = worlds._replace(goal=None).map(torch.empty_like)._replace(goal=self.start.goal)
        task = task.with_goal(self.start.goal)
        self.past_min_age = torch.zeros_like(worlds.x[:, 0, 0], dtype=torch.bool)
        """Worlds to which the stillness loss applies, bool, shape [B]."""
        self.wounds: Tensor | None = None
        """Pixels that each world's last damage changed, uint8, [B, R, R]; None: without weight."""
        if config.wound_weight > 0.0:
            self.wounds = task.wounds_between(worlds, worlds)
        if self.wounds is not None:
            task = task.with_wounds(self.wounds, config.wound_weight)
        self._config = config
        self._divides = bool(fate_parameters(rule))
        self._task = task
        # Only to learn the names and the dtype of the terms.
        with torch.no_grad():
            total, parts = self._loss(self.start.with_zero_paths())
        self.term_names: tuple[str, ...] = ("loss", *parts)
        """Names of `terms`."""
        if take_means is not None:
            self._task = task.with_process_mean(partial(_process_mean, take_means))
        self.terms = total.new_zeros(len(self.term_names))
        """The loss, followed by its named parts, shape [L]."""
        self.parameters = [p for p in rule.parameters() if p.requires_grad]
        self.gradients = [torch.zeros_like(p) for p in self.parameters]
        for parameter, buffer in zip(self.parameters, self.gradients, strict=True):
            parameter.grad = buffer
        self._rule, self._generator, self._rollout = rule, generator, rollout

    def run(self, steps: int) -> None:
        """Run `steps` steps from `start`; write `end`, `terms` and the parameters' `.grad`."""
        # Gradients of codes flow through these states; `start` keeps their values.
        first_states = self._task.with_target_code(self.start.s)
        if first_states is not self.start.s:
            self.start.s.copy_(first_states.detach())
        end = self._rollout(
            self._rule,
            self.start._replace(s=first_states),
            steps,
            memory=self._config.memory,
            generator=self._generator,
            return_path_length=True,
            **self._task.rollout_options,
        )
        total, parts = self._loss(end)
        # Not backward(): its accumulation nodes remember the stream they were first used on,
        # which a capture on another stream must not touch.
        gradients = torch.autograd.grad(
            total, self.parameters, allow_unused=True, materialize_grads=True
        )
        for buffer, gradient in zip(self.gradients, gradients, strict=True):
            buffer.copy_(gradient)
        self.terms.copy_(torch.stack([total, *parts.values()]).detach())
        kept = end._replace(path_length=None, goal=None).map(Tensor.detach)
        self.end._replace(goal=None).copy_(kept)

    def _loss(self, end: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the task's loss of worlds `end` plus the stillness loss, and the terms by name."""
        total, parts = self._task.loss(end)
        if self._config.stillness_weight > 0.0:
            x, s, path, *_ = end
            assert path is not None, "the rollout returns path lengths"
            change = s - self.start.s
            if self._divides:
                # Births and deaths do not count.
                stayed = (living(s) & living(self.start.s))[..., None]
                change = torch.where(stayed, change, 0.0)[..., LIFE + 1 :]
            power = self._config.stillness_power
            moved, changed = (power_mean(each, power) for each in (path, change))
            change_of_world = moved / self._task.eps + changed
            parts["stillness"] = (self.past_min_age.to(x.dtype) * change_of_world).mean()
            total = total + self._config.stillness_weight * parts["stillness"]
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
        """Replay the graph of this number of steps, which the first use captures."""
        run_eagerly = super().run
        with torch.cuda.device(self.start.x.device):
            if steps not in self._graphs:
                self._graphs[steps] = capture(
                    lambda: run_eagerly(steps),
                    self.start.x.device,
                    pool=self._memory_pool,
                    generator=generator_to_register(self._generator),
                    warm_up=None if self._graphs else self._warm_up,
                )
            self._graphs[steps].replay()

    def _warm_up(self) -> None:
        """Launch once, to load kernels and allocate workspaces, which a capture cannot do."""
        # A resumed run warms up again and must draw the same masks: so the generator is reset.
        generator = self._generator
        if isinstance(generator, WorldRandom):
            streams = generator.take(slice(None))
            super().run(WARM_UP_STEPS)
            generator.put(slice(None), streams)
        else:
            state = generator.get_state()
            super().run(WARM_UP_STEPS)
            generator.set_state(state)
