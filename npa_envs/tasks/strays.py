"""Particles that have lost the others: they see nobody, so nothing says where to stay.

A rule that was trained in whole worlds alone may let a lone particle walk on for ever, too slowly
to be seen in a picture. Throwing some out, and counting how far they walk, teaches it to rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.tasks.damage import random_particle
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.randomness import Randomness, check_generator, uniform_draws

NEAREST, FARTHEST = 2.0, 4.0
"""Distances from the origin between which particles are thrown [length units]."""


def scatter(x: Tensor, *, share: float, generator: Randomness | None = None) -> Tensor:
    """Return the positions with some particles thrown out, far from the others, on all sides.

    Nothing waits for the device.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        share: Probability of each particle to be thrown out (dimensionless).
        generator: Source of randomness, on the device of `x`; a `WorldRandom` of B worlds throws in
            each world what it would throw alone.

    Raises:
        NPAError: The generator is on another device or for another number of worlds.
    """
    world_count, particle_count, space_dim = x.shape
    check_generator(generator, x.device, world_count)
    chance = uniform_draws(generator, (world_count, particle_count, 1), x)
    ball = uniform_ball(
        world_count, particle_count, space_dim, 1.0,
        generator=generator, device=x.device, dtype=x.dtype,
    )  # fmt: skip
    return torch.where(chance < share, _outside(ball), x)


def tear(x: Tensor, *, radius: float, chance: float, generator: Randomness | None = None) -> Tensor:
    """Return the positions with a flake of some worlds torn off and thrown out, as a whole.

    Particles that leave together see each other, and may walk on where a lone one has learned to
    rest. Nothing waits for the device.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        radius: Flakes are disks (balls in 3D) around random particles, of any radius up to this
            [length units].
        chance: Probability of a world to lose one (dimensionless).
        generator: Source of randomness, as for `scatter`.

    Raises:
        NPAError: The generator is on another device or for another number of worlds.
    """
    world_count, _, space_dim = x.shape
    centre = random_particle(x, generator)
    draws = uniform_draws(generator, (world_count, 2), x)
    reach = torch.where(draws[:, :1] < chance, radius * draws[:, 1:], -1.0)
    place = uniform_ball(
        world_count, 1, space_dim, 1.0, generator=generator, device=x.device, dtype=x.dtype
    )[:, 0]
    torn = (x - centre[:, None]).norm(dim=-1) <= reach
    return torch.where(torn[..., None], x + (_outside(place) - centre)[:, None], x)


def _outside(ball: Tensor) -> Tensor:
    """Return places between `NEAREST` and `FARTHEST` for places in the unit ball, [..., D]."""
    length: Tensor = ball.norm(dim=-1, keepdim=True)
    return ball * ((NEAREST + (FARTHEST - NEAREST) * length) / length.clamp_min(1e-12))


def stray_motion(x: Tensor, path_length: Tensor) -> Tensor:
    """Return how far particles travelled that are outside of [-1, 1]^D, mean [length units], [].

    It is 0 where there are none.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        path_length: How far each particle travelled [length units], shape [B, N].
    """
    outside = (x.detach().abs().amax(dim=-1) > 1.0).to(x.dtype)
    return (outside * path_length).sum() / outside.sum().clamp_min(1.0)
