"""Seeds: random start positions, uniform in a ball or a box; and random choices for each world."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.checks import DTYPES, as_list, check_device, checked_count, checked_finite
from npa_envs.errors import NPAError, shown
from npa_envs.ops.sort import MAX_INDEX
from npa_envs.world.randomness import (
    Randomness,
    WorldRandom,
    check_generator,
    normal_draws,
    uniform_draws,
)


def uniform_ball(
    world_count: int,
    particle_count: int,
    space_dim: int,
    radius: float,
    *,
    generator: Randomness | None = None,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Return points uniform in a ball around the origin [length units], shape [B, N, D]."""
    space_dim = checked_count("space_dim", space_dim)
    if space_dim < 1:
        raise NPAError(f"space_dim must be at least 1, got {shown(space_dim)}: give 2 or 3")
    radius = checked_finite("radius", radius, " [length units]")
    if radius < 0.0:
        raise NPAError(f"radius must not be negative [length units], got {radius:g}")
    shape, like = _checked_shape(world_count, particle_count, space_dim, generator, device, dtype)
    direction = normal_draws(generator, shape, like)
    if isinstance(generator, WorldRandom):
        # Added one by one and without a root of the distance: the same bits on every device.
        squares = direction * direction
        length = sum(squares.unbind(dim=-1), torch.zeros_like(squares[..., 0])).sqrt()
        distance = generator.uniform(*shape[1:], dtype=dtype).amax(dim=-1)
        return radius * (direction * (distance / length.clamp_min(1e-12))[..., None])
    # randn is never exactly zero in all coordinates in practice; the floor keeps 0 / 0 away.
    direction /= direction.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    distance = uniform_draws(generator, (*shape[:2], 1), like)
    return radius * distance ** (1.0 / space_dim) * direction


def uniform_box(
    world_count: int,
    particle_count: int,
    box: tuple[float, ...],
    *,
    generator: Randomness | None = None,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Return points uniform in a box of D sides around the origin [length units], [B, N, D]."""
    values = as_list(box)
    if not values:
        raise NPAError(
            f"box must hold a side for each dimension, got {shown(box)}: give (2.0, 2.0)"
        )
    sides = [checked_finite("a side of box", side, " [length units]") for side in values]
    shape, like = _checked_shape(world_count, particle_count, len(sides), generator, device, dtype)
    fraction = uniform_draws(generator, shape, like)
    return torch.stack([side * (fraction[..., d] - 0.5) for d, side in enumerate(sides)], dim=-1)


def drawn_indices(
    count: int, world_count: int, generator: Randomness | None, device: torch.device
) -> Tensor:
    """Return one random index in [0, count) for each world, int64, shape [B]."""
    if isinstance(generator, WorldRandom):
        return generator.integers(count, 1)[:, 0]
    return torch.randint(count, (world_count,), generator=generator, device=device)


def drawn_worlds(x: Tensor, generator: Randomness, probability: float) -> Tensor:
    """Return a random bool for each world of positions x, True with `probability`, shape [B]."""
    single = x.new_empty(0, dtype=torch.float32)
    return uniform_draws(generator, (len(x), 1), single)[:, 0] < probability


def spread_points(points: Tensor, count: int) -> Tensor:
    """Return `count` of points [M, D], each the farthest from those before it, [count, D].

    The first one is random, and the same for equally many points.
    """
    first = int(torch.randint(len(points), (1,), generator=torch.Generator().manual_seed(1)))
    chosen = [points[first]]
    distance = torch.full_like(points[:, 0], torch.inf)
    while len(chosen) < count:
        away = torch.linalg.vector_norm(points - chosen[-1], dim=-1)
        distance = torch.minimum(distance, away)
        chosen.append(points[distance.argmax()])
    return torch.stack(chosen)


def _checked_shape(
    world_count: int,
    particle_count: int,
    space_dim: int,
    generator: Randomness | None,
    device: str | torch.device,
    dtype: torch.dtype,
) -> tuple[tuple[int, int, int], Tensor]:
    """Return the shape [B, N, D] of points, and an empty tensor of their device and dtype.

    It raises NPAError if an argument is wrong.
    """
    device = check_device(device)
    world_count = checked_count("world_count", world_count)
    particle_count = checked_count("particle_count", particle_count)
    if dtype not in DTYPES:
        raise NPAError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
    number_count = world_count * particle_count * space_dim
    if number_count > MAX_INDEX:
        raise NPAError(
            f"coordinates must be at most {MAX_INDEX} in one batch, got {shown(number_count)}: "
            "make fewer worlds or particles"
        )
    check_generator(generator, device, world_count)
    return (world_count, particle_count, space_dim), torch.empty(0, device=device, dtype=dtype)
