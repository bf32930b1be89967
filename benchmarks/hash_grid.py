"""Perception with `wp.HashGrid` in two plain passes: a simple baseline in Warp alone.

It shares only the kernel functions W and K with the library's kernels.
"""

import contextlib
import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from npa_envs.kernels.domain import domain_types, make_domain, scalar_name
from npa_envs.kernels.mathematics import MOMENT_THRESHOLD, smoothing, spiky_factor
from npa_envs.ops.launch import SCALARS, launch, warp_device

GRID_CELLS = 128
"""Buckets of the hash grid along each axis; the third has one in 2D."""


class GridFields(NamedTuple):
    """Fields of every particle, unscaled, as those of the same names in `PerceptionFields`."""

    rho: Tensor
    blur: Tensor
    grad1: Tensor
    drho: Tensor


def grid_fields(x: Tensor, s: Tensor, eps: float) -> GridFields:
    """Return the fields of worlds x [B, N, D], s [B, N, C] in open space; not differentiable."""
    world_count, particle_count, space_dim = x.shape
    total, state_dim = world_count * particle_count, s.shape[2]
    scalar = SCALARS[x.dtype]
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
    """Return the cached hash grid of a kind, which each call rebuilds."""
    make: Any = wp.HashGrid
    return make(GRID_CELLS, GRID_CELLS, depth, device=warp_device(device), dtype=scalar)


def _built_grid(points: Tensor, world: Tensor, eps: float, space_dim: int) -> Any:
    """Return a hash grid of the points, one group for each world, built on torch's stream."""
    scalar = SCALARS[points.dtype]
    grid = _grid(points.device, scalar, GRID_CELLS if space_dim == 3 else 1)
    stream: contextlib.AbstractContextManager[Any] = contextlib.nullcontext()
    if points.is_cuda:
        current = torch.cuda.current_stream(points.device)
        stream = wp.ScopedStream(wp.stream_from_torch(current))  # type: ignore[no-untyped-call]
    array = wp.from_torch(points, dtype=wp.types.vector(3, scalar), requires_grad=False)
    with stream:
        grid.build(array, eps, groups=wp.from_torch(world, requires_grad=False))
    return grid


@functools.cache
def grid_kernels(space_dim: int, scalar: type, state_dim: int) -> SimpleNamespace:
    """Return the two kernels of one variant: density, then everything else."""
    Domain = domain_types(space_dim, scalar).Domain
    point = wp.types.vector(3, scalar)
    vector = wp.types.vector(space_dim, scalar)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    channels = wp.types.vector(state_dim, scalar)
    gradients = wp.types.matrix((state_dim, space_dim), scalar)
    module = wp.get_module(f"hash_grid_{space_dim}d_{scalar_name(scalar)}_c{state_dim}")

    @wp.kernel(enable_backward=False, module=module)
    def sum_density(
        domain: Domain,
        radius: scalar,
        grid: wp.uint64,
        points: wp.array(dtype=point),
        world: wp.array(dtype=wp.int32),
        # outputs
        density: wp.array(dtype=scalar),
    ):
        """Sum the smoothing kernel over the neighbours of each particle."""
        i = wp.tid()
        total = scalar(0.0)
        query = wp.hash_grid_query(grid, points[i], radius, world[i])
        for j in query:
            offset = points[j] - points[i]
            squared = wp.dot(offset, offset)
            if squared < domain.squared_eps:
                total += smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
        density[i] = total

    @wp.kernel(enable_backward=False, module=module)
    def sum_fields(
        domain: Domain,
        radius: scalar,
        grid: wp.uint64,
        points: wp.array(dtype=point),
        world: wp.array(dtype=wp.int32),
        density: wp.array(dtype=scalar),
        states: wp.array2d(dtype=scalar),
        # outputs
        blur: wp.array2d(dtype=scalar),
        gradient: wp.array3d(dtype=scalar),
        density_gradient: wp.array(dtype=vector),
    ):
        """Sum smoothed states, corrected state gradients and the density gradient."""
        i = wp.tid()
        smooth, slope = channels(), gradients()
        moment, rise = square(), vector()
        query = wp.hash_grid_query(grid, points[i], radius, world[i])
        for j in query:
            offset = points[j] - points[i]
            squared = wp.dot(offset, offset)
            if squared < domain.squared_eps:
                volume = scalar(1.0) / density[j]
                weight = volume * smoothing(
                    squared, domain.inverse_squared_eps, domain.smoothing_norm
                )
                factor = spiky_factor(wp.sqrt(squared), domain.inverse_eps, domain.spiky_norm)
                r = vector()
                for d in range(wp.static(space_dim)):
                    r[d] = offset[d]
                kernel = factor * r
                rise += kernel
                moment += volume * wp.outer(r, kernel)
                for c in range(wp.static(state_dim)):
                    smooth[c] += weight * states[j, c]
                    difference = volume * (states[j, c] - states[i, c])
                    for d in range(wp.static(space_dim)):
                        slope[c, d] += difference * kernel[d]
        if wp.abs(wp.determinant(moment)) >= scalar(wp.static(MOMENT_THRESHOLD)):
            slope = slope * wp.inverse(moment)
        density_gradient[i] = rise
        for c in range(wp.static(state_dim)):
            blur[i, c] = smooth[c]
            for d in range(wp.static(space_dim)):
                gradient[i, c, d] = slope[c, d]

    return SimpleNamespace(sum_density=sum_density, sum_fields=sum_fields)
