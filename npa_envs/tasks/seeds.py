"""Where worlds begin."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.sph.checks import check_generator


def uniform_ball(
    world_count: int,
    particle_count: int,
    space_dim: int,
    radius: float,
    *,
    generator: torch.Generator | None = None,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Return points uniform in a ball around the origin [length units], shape [B, N, D].

    Args:
        world_count: Worlds B.
        particle_count: Particles in each world N.
        space_dim: Space dimension D.
        radius: Radius of the ball [length units].
        generator: Source of randomness, on `device`.
        device: Where the points are made.
        dtype: Their floating dtype.

    Raises:
        NPAError: The generator is on another device.
    """
    check_generator(generator, torch.device(device))
    shape = (world_count, particle_count)
    direction = torch.randn(*shape, space_dim, generator=generator, device=device, dtype=dtype)
    # randn is never exactly zero in all coordinates in practice; the floor keeps 0 / 0 away.
    direction /= direction.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    distance = torch.rand(*shape, 1, generator=generator, device=device, dtype=dtype)
    return radius * distance ** (1.0 / space_dim) * direction
