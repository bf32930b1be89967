"""Particles that have lost the others: they see nobody, so nothing says where to stay.

A rule that was trained in whole worlds alone may let a lone particle walk on for ever, too slowly
to be seen in a picture. Throwing some out, and counting how far they walk, teaches it to rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.randomness import Randomness, WorldRandom, check_generator
from npa_envs.tasks.damage import erase_state, random_particle
from npa_envs.tasks.seeds import uniform_ball

NEAREST, FARTHEST = 2.0, 4.0
"""Distances from the origin between which particles are thrown [length units]."""


def hurt(
    x: Tensor, s: Tensor, *, damage_radius: float, stray_share: float, generator: Randomness
) -> tuple[Tensor, Tensor]:
    """Return worlds with the states around one random particle erased, and some thrown out.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states (dimensionless), shape [B, N, C].
        damage_radius: Radius of the ball whose states become zero [length units]; 0: none.
        stray_share: Probability of each particle to be thrown out (dimensionless); 0: none is.
        generator: Source of randomness, as for `scatter`.
    """
    if damage_radius > 0.0:
        s = erase_state(x, s, centre=random_particle(x, generator), radius=damage_radius)
    if stray_share > 0.0:
        x = scatter(x, share=stray_share, generator=generator)
    return x, s


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
    if isinstance(generator, WorldRandom):
        chance = generator.uniform(particle_count, 1, dtype=x.dtype)
    else:
        shape = (world_count, particle_count, 1)
        chance = torch.rand(shape, generator=generator, device=x.device, dtype=x.dtype)
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
