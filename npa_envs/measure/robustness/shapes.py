"""Seeds of other shapes than the trained one, as dense where their size allows it."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.world.randomness import WorldRandom

SIZE_FACTOR = 1.5
"""By how much a larger disk's radius is larger, and a smaller one's smaller."""

BLOB_DISTANCE = 1.25
"""From the origin to the centre of each of two blobs, in their radii (dimensionless)."""

Shape = Callable[[int, int, float, WorldRandom], Tensor]
"""Makes positions [length units], shape [B, N, D], of N, D, the disk's radius and randomness."""


def disk(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a disk, a ball in 3D.

    Args:
        particle_count: Particles in each world N.
        space_dim: Space dimension D.
        radius: Radius R [length units].
        random: Streams of B worlds.
    """
    return uniform_ball(
        random.world_count,
        particle_count,
        space_dim,
        radius,
        generator=random,
        device=random.device,
    )


def ring(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a ring around a disk of radius R, a hollow ball in 3D, of that disk's area or volume.

    For the arguments see `disk`.
    """
    x = disk(particle_count, space_dim, radius, random)
    distance: Tensor = torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp_min(1e-12)
    # What area the disk has within a particle's distance, the ring has as well.
    outer = (distance**space_dim + radius**space_dim) ** (1.0 / space_dim)
    return x * (outer / distance)


def square(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a square of the disk's area, in 3D a cube of its volume; arguments as of `disk`."""
    side = radius * (math.sqrt(math.pi) if space_dim == 2 else (4.0 * math.pi / 3.0) ** (1.0 / 3.0))
    return uniform_box(
        random.world_count,
        particle_count,
        (side,) * space_dim,
        generator=random,
        device=random.device,
    )


def two_blobs(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return two disks beside each other with the area of one, balls in 3D; arguments as of `disk`.

    Every other particle is in the left one.
    """
    small = radius * 0.5 ** (1.0 / space_dim)
    x = disk(particle_count, space_dim, small, random)
    side = torch.arange(particle_count, device=x.device) % 2 * 2 - 1
    shift = torch.zeros_like(x)
    shift[..., 0] = BLOB_DISTANCE * small * side
    return x + shift


def larger(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a disk, a ball in 3D, of `SIZE_FACTOR` times the radius; arguments as of `disk`."""
    return disk(particle_count, space_dim, SIZE_FACTOR * radius, random)


def smaller(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a disk, a ball in 3D, whose radius is divided by `SIZE_FACTOR`; see `disk`."""
    return disk(particle_count, space_dim, radius / SIZE_FACTOR, random)


SHAPES: dict[str, Shape] = {
    "ring": ring,
    "square": square,
    "two blobs": two_blobs,
    "larger": larger,
    "smaller": smaller,
}
"""Every other shape by its name."""
