"""Training in worlds of several kinds: other numbers of particles, ε, probabilities, time steps.

Half of the batches are as the task says. The others are of some kinds of worlds, drawn evenly.
Worlds of a kind have one number of particles, one probability of updates and one time step, so each
kind has a pool of its own, and on CUDA graphs of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import torch
from torch import Tensor

import npa_envs.world.rollout
from npa_envs.errors import NPAError
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.train_config import VARIED, TrainConfig
from npa_envs.training.cycle import TrainingCycle
from npa_envs.training.iteration import Rollout, RolloutOptions
from npa_envs.training.meter import Interval, LossMeter
from npa_envs.training.presets import task_entry

PLACES = {"vary_particles": (1, 0), "vary_update_prob": (2, 1), "vary_dt": (3, 3)}
"""Stride and start of the walk of each factor through its range, so that no two go together; the
stride is the next one that comes to every place."""

SEED_STEP = 7919
"""Between the seeds of two kinds' randomness."""


@dataclass(frozen=True)
class Variant:
    """A kind of worlds, by factors on what the task says."""

    particles: float
    update_prob: float
    dt: float


def variants_of(config: TrainConfig[Any]) -> list[Variant]:
    """Return the kinds of worlds that a configuration asks for."""
    count = config.variants
    columns = []
    for name, (stride, start) in PLACES.items():
        lo, hi = getattr(config, name)
        while math.gcd(stride, count) > 1:
            stride += 1
        places = [(number * stride + start) % count for number in range(count)]
        shares = [place / (count - 1) for place in places] if count > 1 else [0.5]
        columns.append([lo * (hi / lo) ** share for share in shares])
    return [Variant(*factors) for factors in zip(*columns, strict=True)]


class VariedCycle(TrainingCycle):
    """A training cycle with others beside it, one for each further kind of worlds.

    What it shows of itself, worlds, pool and batch, is of worlds as the task says.

    Args:
        task: What to learn.
        rule: The rule, on the device, in the run's dtype.
        config: How.
        device: Where the worlds are.
        schedule: Randomness of the numbers of steps and of the kinds, on the CPU.
        task_name: The task's name in `TASKS`.

    Raises:
        NPAError: The task's worlds cannot be varied like this.
    """

    def __init__(
        self,
        task: Task,
        rule: NPARule,
        config: TrainConfig[Any],
        device: torch.device,
        schedule: torch.Generator,
        *,
        task_name: str,
    ) -> None:
        told = task.config  # type: ignore[attr-defined]
        if config.vary_eps != (1.0, 1.0) and (task.box is not None or rule.static):
            raise NPAError(
                f"vary_eps needs particles that move in open space, got the task {task_name}: "
                "leave it out"
            )
        if config.vary_eps != (1.0, 1.0) and rule.divides:
            raise NPAError(
                "vary_eps needs seeds of more than one particle, whose size it varies, got a rule "
                "that divides: leave it out"
            )
        largest = told.update_prob * config.vary_update_prob[1]
        if largest > 1.0:
            raise NPAError(
                f"vary_update_prob must leave probabilities in (0, 1], got {largest:g} for "
                f"update_prob={told.update_prob:g}: give factors up to {1.0 / told.update_prob:g}"
            )
        nothing: dict[str, Any] = dict.fromkeys(VARIED, (1.0, 1.0))
        super().__init__(task, rule, replace(config, **nothing), device, schedule)
        self._others = []
        for number, variant in enumerate(variants_of(config)):
            count = max(2, round(told.particle_count * variant.particles))
            prob = min(1.0, told.update_prob * variant.update_prob)
            own = replace(told.with_particle_count(count), update_prob=prob)
            middle = sum(config.steps) / 2 / (variant.update_prob * variant.dt)
            steps = max(1, round(middle))
            changed = replace(
                config,
                seed=(config.seed + SEED_STEP * (number + 1)) % 2**63,
                # One number of steps for each kind: one graph.
                steps=(steps, steps + 1),
            )
            other = TrainingCycle(
                task_entry(task_name).make(own, device),
                rule,
                changed,
                device,
                torch.Generator().manual_seed(changed.seed),
                _with_dt(variant.dt),
                beside=self,
            )
            self._others.append(other)
        self.meter = _Meters(self.batch, [other.meter for other in self._others])

    def run(self, iteration: int, share: float = 0.0) -> int:
        """Train for one iteration, and return the steps of its rollout, T.

        Args:
            iteration: Iterations done so far in the run.
            share: As for `TrainConfig.learning_rate_at`.
        """
        count = len(self._others)
        kind = int(torch.randint(2 * count, (), generator=self.random.schedule))
        if kind < count:
            return self._others[kind].run(iteration, share)
        return super().run(iteration, share)

    @property
    def pool_bytes(self) -> int:
        """Bytes of the pools' worlds, of this process."""
        return super().pool_bytes + sum(other.pool_bytes for other in self._others)

    def state_dict(self) -> dict[str, Any]:
        """Return all that changes but the rule, for a checkpoint."""
        others = {str(k): _own(other.state_dict()) for k, other in enumerate(self._others)}
        return super().state_dict() | {"variants": others}

    def state_like(self, iteration: int) -> dict[str, Any]:
        """Return what `state_dict` has after so many iterations, with other numbers in it."""
        others = {str(k): _own(o.state_like(iteration)) for k, o in enumerate(self._others)}
        return super().state_like(iteration) | {"variants": others}

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Go on after so many iterations from what `state_dict` returned; before the first one."""
        super().load_state_dict(state, iteration)
        for number, other in enumerate(self._others):
            other.load_state_dict(state | state["variants"][str(number)], iteration)


def _own(state: dict[str, Any]) -> dict[str, Any]:
    """Return what a kind of worlds does not share."""
    return {name: state[name] for name in ("pool", "meter", "random_states")}


def _with_dt(dt: float) -> Rollout:
    """Return the engine's rollout with a time step."""

    def rollout(
        rule: NPARule, x: Tensor, s: Tensor, steps: int, /, **options: Unpack[RolloutOptions]
    ) -> tuple[Tensor, Tensor, Tensor]:
        return npa_envs.world.rollout.rollout(rule, x, s, steps, dt=dt, **options)

    return rollout


class _Meters(LossMeter):
    """The meter of worlds as trained, with those of other kinds beside it."""

    def __init__(self, iteration: Any, others: Sequence[LossMeter]) -> None:
        super().__init__(iteration)
        self._others = others

    def send(self) -> None:
        """Let the interval's numbers go to the host, and start the next interval."""
        super().send()
        for other in self._others:
            other.send()

    def receive(self) -> Interval:
        """Return what `send` sent last, of all kinds together."""
        meters: list[LossMeter] = [*self._others]
        found = [super().receive(), *(meter.receive() for meter in meters)]
        counts = [self.sent_count, *(meter.sent_count for meter in meters)]
        total = max(sum(counts), 1)
        means = {
            name: sum(
                count * interval.means[name] for count, interval in zip(counts, found, strict=True)
            )
            / total
            for name in found[0].means
        }
        means["replaced_worlds"] = sum(interval.means["replaced_worlds"] for interval in found)
        bad = [i.bad_iteration for i in found if i.bad_iteration is not None]
        return Interval(means, min(bad, default=None))

    def bad_iteration(self) -> int | None:
        """Return the first iteration whose loss was not finite, or None; waits for the device."""
        first = self._first_bad()
        return None if first is None else first[0]

    def snapshot(self) -> dict[str, Any]:
        """Return what the first iteration with a bad loss saw, on the CPU."""
        first = self._first_bad()
        if first is None or first[1] is self:
            return super().snapshot()
        return first[1].snapshot()

    def _first_bad(self) -> tuple[int, LossMeter] | None:
        numbers = [(super().bad_iteration(), self), *((m.bad_iteration(), m) for m in self._others)]
        found = [(number, meter) for number, meter in numbers if number is not None]
        return min(found, key=lambda pair: pair[0], default=None)
