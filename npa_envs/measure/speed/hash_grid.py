"""Perception over the neighbours that `wp.HashGrid` finds: two plain passes, no sorting of ours.

What one would write first with Warp alone. The fast kernels are measured against it, and it shares
with them only the kernel functions W and K.
"""

from __future__ import annotations

import contextlib
import functools
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from npa_envs.kernels.domain import make_domain
from npa_envs.measure.speed.grid_kernels import grid_kernels
from npa_envs.ops.launch import launch, scalar_type, warp_device

GRID_CELLS = 128
"""Buckets of the hash grid along each axis; the third has one in 2D."""


class GridFields(NamedTuple):
    """Fields of every particle, unscaled, as in `npa_envs.PerceptionFields`."""

    rho: Tensor
    """Density [1 / length^D], shape [B, N]."""
    blur: Tensor
    """Smoothed states, dimensionless, shape [B, N, C]."""
    grad1: Tensor
    """State gradients, corrected where |det M| >= 1e-3 [1 / length], shape [B, N, C, D]."""
    drho: Tensor
    """Density gradients [1 / length^(D+1)], shape [B, N, D]."""


def grid_fields(x: Tensor, s: Tensor, eps: float) -> GridFields:
    """Return the fields of worlds in open space; not differentiable.

    Args:
        x: Positions [length units], shape [B, N, D].
        s: States, dimensionless, shape [B, N, C].
        eps: Perception radius [length units].
    """
    world_count, particle_count, space_dim = x.shape
    total, state_dim = world_count * particle_count, s.shape[2]
    scalar = scalar_type(x.dtype)
    kernels = grid_kernels(space_dim, scalar, state_dim)
    domain = make_domain(space_dim, scalar, eps, None, particle_count)
    points = x.new_zeros(total, 3)
    points[:, :space_dim] = x.reshape(total, space_dim)
    world = torch.arange(world_count, dtype=torch.int32, device=x.device)
    world = world.repeat_interleave(particle_count)
    grid = _built_grid(points, world, eps, space_dim)
    rho = x.new_empty(total)
    neighbours = (domain, eps, grid.id, points, world)
    launch(kernels.sum_density, total, x.device, *neighbours, rho)
    blur, drho = x.new_empty(total, state_dim), x.new_empty(total, space_dim)
    gradient = x.new_empty(total, state_dim, space_dim)
    states = s.reshape(total, state_dim)
    launch(kernels.sum_fields, total, x.device, *neighbours, rho, states, blur, gradient, drho)
    shape = (world_count, particle_count)
    return GridFields(
        *(field.view(*shape, *field.shape[1:]) for field in (rho, blur, gradient, drho))
    )


@functools.cache
def _grid(device: torch.device, scalar: Any, depth: int) -> Any:
    """Return the hash grid of a kind, which every call fills anew."""
    make: Any = wp.HashGrid
    return make(GRID_CELLS, GRID_CELLS, depth, device=warp_device(device), dtype=scalar)


def _built_grid(points: Tensor, world: Tensor, eps: float, space_dim: int) -> Any:
    """Return a hash grid of the points, one group for each world, built on torch's stream."""
    scalar = scalar_type(points.dtype)
    grid = _grid(points.device, scalar, GRID_CELLS if space_dim == 3 else 1)
    stream: contextlib.AbstractContextManager[Any] = contextlib.nullcontext()
    if points.is_cuda:
        current = torch.cuda.current_stream(points.device)
        stream = wp.ScopedStream(wp.stream_from_torch(current))  # type: ignore[no-untyped-call]
    array = wp.from_torch(points, dtype=wp.types.vector(3, scalar), requires_grad=False)
    with stream:
        grid.build(array, eps, groups=wp.from_torch(world, requires_grad=False))
    return grid
