"""Particles that have lost the others: they see nobody, so nothing says where to stay.

A rule that was trained in whole worlds alone may let a lone particle walk on for ever, too slowly
to be seen in a picture. Throwing some out, and counting how far they walk, teaches it to rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.randomness import Randomness, check_generator
from npa_envs.tasks.damage import uniform
from npa_envs.tasks.seeds import uniform_ball

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
    chance = uniform(x, (world_count, particle_count, 1), generator)
    ball = uniform_ball(
        world_count, particle_count, space_dim, 1.0,
        generator=generator, device=x.device, dtype=x.dtype,
    )  # fmt: skip
    length = ball.norm(dim=-1, keepdim=True)
    thrown = ball * ((NEAREST + (FARTHEST - NEAREST) * length) / length.clamp_min(1e-12))
    return torch.where(chance < share, thrown, x)


def stray_motion(x: Tensor, path_length: Tensor) -> Tensor:
    """Return how far particles travelled that are outside of [-1, 1]^D, mean [length units], [].

    It is 0 where there are none.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        path_length: How far each particle travelled [length units], shape [B, N].
    """
    outside = (x.detach().abs().amax(dim=-1) > 1.0).to(x.dtype)
    return (outside * path_length).sum() / outside.sum().clamp_min(1.0)
