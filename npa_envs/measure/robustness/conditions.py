"""How worlds grow where something is not as it was in training."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch

from npa_envs.measure.robustness.grounds import Ground, Home, courses
from npa_envs.measure.robustness.plans import trained_value
from npa_envs.world.randomness import Purpose

MOST_PARTICLES = {"cpu": 1 << 17, "cuda": 1 << 21}
"""Particles of all worlds together; where there would be more, a value is left out."""


@dataclass(frozen=True)
class Response:
    """The losses of all seeds under one condition."""

    condition: str
    """What was varied."""
    value: float | str
    """Its value."""
    steps: int
    """Steps from the seed."""
    losses: tuple[float, ...]
    """Loss of each seed, NaN where a world is not finite; none where it was left out."""
    note: str = ""
    """Why it was left out."""

    def mean(self) -> float:
        """Return the mean loss of the seeds; NaN where one is not finite, or there are none."""
        return math.fsum(self.losses) / len(self.losses) if self.losses else math.nan


def grow(ground: Ground, condition: str = "", value: float | str = 1.0) -> tuple[Home, Response]:
    """Grow worlds from their seeds under a condition, and take their losses.

    Args:
        ground: The rule, and for how long to grow it.
        condition: What is varied; nothing by default.
        value: Its value.

    Returns:
        The worlds as they are then, and what came of them.
    """
    home = ground.home(
        share=float(value) if condition == "particles" else 1.0,
        shape=str(value) if condition == "shape" else "trained",
    )
    changed: dict[str, Any] = {}
    pace = 1.0
    if condition in ("update_prob", "dt"):
        changed[condition] = value
        # As many updates, or as much time, as trained.
        pace = float(value) / (ground.task.update_prob if condition == "update_prob" else 1.0)
    elif condition in ("eps", "noise"):
        name = "eps" if condition == "eps" else "position_noise"
        changed[name] = float(value) * ground.task.eps
    # In whole chunks: what is left over would refuse worlds that are not finite any more.
    chunk = ground.plan.chunk
    steps = chunk * max(1, round(ground.plan.grow_steps / pace / chunk))
    run = ground.run(home, ground.random(Purpose.GROWTH), **changed)
    losses = ground.by_seed(courses(home, run, (steps,))[0]).tolist()
    return home.with_worlds(run.x, run.s), Response(condition, value, steps, tuple(losses))


@torch.no_grad()
def responses(
    ground: Ground, trained: Response, most_particles: int, *, done: int = 0
) -> Iterator[Response]:
    """Yield what comes of each value of each condition.

    Args:
        ground: The rule, and what is measured.
        trained: What comes of worlds as trained; it is not measured again.
        most_particles: Particles of all worlds; where there would be more, a value is left out.
        done: Values that are measured already, the first in order.
    """
    every = [(name, value) for name, values in ground.plan.values.items() for value in values]
    for condition, value in every[done:]:
        if value == trained_value(condition, ground.task.update_prob):
            yield Response(condition, value, trained.steps, trained.losses)
            continue
        share = float(value) if condition == "particles" else 1.0
        total = ground.world_count * ground.particles(share)
        if total > max(most_particles, ground.world_count * ground.particle_count):
            yield Response(condition, value, 0, (), note=f"{total} particles in all")
            continue
        try:
            yield grow(ground, condition, value)[1]
        except torch.OutOfMemoryError:
            yield Response(condition, value, 0, (), note=f"no memory for {total} particles")
