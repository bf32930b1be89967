"""Plans of robustness: conditions and their values, steps, shapes of seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.world.randomness import WorldRandom

# Seeds of other shapes than the trained one, as dense where their size allows it.

SIZE_FACTOR = 1.5
"""Ratio of a larger disk's radius, and its inverse that of a smaller one's."""

BLOB_DISTANCE = 1.25
"""From the origin to the centre of each of two blobs, in their radii (dimensionless)."""

Shape = Callable[[int, int, float, WorldRandom], Tensor]
"""Makes positions [B, N, D] of N, D, the disk's radius and randomness."""


def disk(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a disk, a ball in 3D, of radius R."""
    sizes = (random.world_count, particle_count, space_dim, radius)
    return uniform_ball(*sizes, generator=random, device=random.device)


def ring(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a ring around a disk of radius R, a hollow ball in 3D, of that disk's size."""
    x = disk(particle_count, space_dim, radius, random)
    distance: Tensor = torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp_min(1e-12)
    # What area the disk has within a particle's distance, the ring has as well.
    outer = (distance**space_dim + radius**space_dim) ** (1.0 / space_dim)
    return x * (outer / distance)


def square(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a square of the disk's area, in 3D a cube of its volume."""
    side = radius * (math.sqrt(math.pi) if space_dim == 2 else (4.0 * math.pi / 3.0) ** (1.0 / 3.0))
    sizes = (random.world_count, particle_count, (side,) * space_dim)
    return uniform_box(*sizes, generator=random, device=random.device)


def two_blobs(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return two disks side by side with the area of one, balls in 3D."""
    small = radius * 0.5 ** (1.0 / space_dim)
    x = disk(particle_count, space_dim, small, random)
    side = torch.arange(particle_count, device=x.device) % 2 * 2 - 1
    shift = torch.zeros_like(x)
    shift[..., 0] = BLOB_DISTANCE * small * side
    return x + shift


SHAPES: dict[str, Shape] = {
    "ring": ring,
    "square": square,
    "two blobs": two_blobs,
    "larger": lambda n, d, radius, random: disk(n, d, SIZE_FACTOR * radius, random),
    "smaller": lambda n, d, radius, random: disk(n, d, radius / SIZE_FACTOR, random),
}
"""Every other shape by its name."""

# Conditions and plans

CONDITIONS = {
    "eps": "perception radius ε over the trained one",
    "particles": "particles N over the trained number",
    "update_prob": "probability p of an update, for as many updates in all",
    "dt": "time step, for as much time in all",
    "noise": "noise of every position in each step, over the perception radius",
    "shape": "shape of the seed",
}
"""Conditions, varied one at a time, with a summary."""

TRAINED: Mapping[str, float | str] = {
    "eps": 1.0,
    "particles": 1.0,
    "dt": 1.0,
    "noise": 0.0,
    "shape": "trained",
}
"""The value of each condition as trained; that of `update_prob` is the task's."""


def trained_value(condition: str, update_prob: float) -> float | str:
    """Return the value of a condition at which a rule whose task has `update_prob` was trained."""
    return update_prob if condition == "update_prob" else TRAINED[condition]


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """Measurements of one rule: all steps are whole chunks, which CUDA records as a graph.

    `grow_steps` lead from the seed to the damage, and to the loss under each condition;
    `heal_steps` after the damage, from 0 on, losses are taken; `values` of each condition increase,
    the trained one among them.
    """

    grow_steps: int
    heal_steps: tuple[int, ...]
    chunk: int
    worlds_per_seed: int = 1
    values: Mapping[str, tuple[float | str, ...]]


_HEAL_STEPS = (0, 16, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024)

_VALUES: dict[str, tuple[float | str, ...]] = {
    "eps": (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0),
    "particles": (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0, 16.0),
    "update_prob": (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0),
    "dt": (0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
    "noise": (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0),
    "shape": ("trained", *SHAPES),
}

_MOVING = TrialPlan(grow_steps=512, heal_steps=_HEAL_STEPS, chunk=16, values=_VALUES)

PLANS = {
    "morphogenesis2d": _MOVING,
    "morphogenesis3d": replace(_MOVING, grow_steps=128, heal_steps=_HEAL_STEPS[:-2]),
    "texture": replace(_MOVING, grow_steps=1024),
    "point_classification": TrialPlan(
        grow_steps=64,
        heal_steps=(0, 8, 16, 24, 32, 48, 64, 96, 128),
        chunk=8,
        # Few clouds are wrong, and nearly all of their particles are.
        worlds_per_seed=128,
        # The shape of a cloud is its class.
        values={name: values for name, values in _VALUES.items() if name != "shape"},
    ),
}
"""What is measured of the rules of each task."""


def quick_plan(task_name: str) -> TrialPlan:
    """Return a plan of a task of `PLANS` that takes seconds: few steps, few values."""
    values: dict[str, tuple[float | str, ...]] = {
        "eps": (0.7, 1.0, 1.4),
        "particles": (0.5, 1.0),
        "update_prob": (0.2, 0.5, 1.0),
        "dt": (0.5, 1.0),
        "noise": (0.0, 1e-2),
        "shape": ("trained", "ring"),
    }
    full = PLANS[task_name]
    return replace(
        full,
        grow_steps=min(full.grow_steps, 48),
        heal_steps=(0, 16, 32),
        worlds_per_seed=min(full.worlds_per_seed, 4),
        values={name: values[name] for name in full.values},
    )
