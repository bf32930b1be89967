"""Warp kernels over the neighbours that `wp.HashGrid` finds: density, then everything else."""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import domain_types, scalar_name
from npa_envs.kernels.mathematics import MOMENT_THRESHOLD, smoothing, spiky_factor


@functools.cache
def grid_kernels(space_dim: int, scalar: type, state_dim: int) -> SimpleNamespace:
    """Return the two kernels of one variant: density, then everything else."""
    Domain = domain_types(space_dim, scalar).Domain
    point = wp.types.vector(3, scalar)
    vector = wp.types.vector(space_dim, scalar)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    channels = wp.types.vector(state_dim, scalar)
    gradients = wp.types.matrix((state_dim, space_dim), scalar)
    module = wp.get_module(
        f"npa_envs.measure.speed.hash_grid_{space_dim}d_{scalar_name(scalar)}_c{state_dim}"
    )

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
