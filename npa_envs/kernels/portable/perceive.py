"""The perception pass: the scaled perception vector of each active particle.

One thread serves a particle and a group of its state channels. Sums run over sorted particles, one
run of cells after the other, or over neighbour lists in the same order.

Source: arXiv 2601.16096, section 3. Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels.domain import group_types, kernel_module
from npa_envs.kernels.lanes_and_memory import make_add_scaled, make_wide_load
from npa_envs.kernels.mathematics import (
    log_scaled,
    make_corrected,
    perception_module_name,
    smoothing,
    spiky_factor,
)
from npa_envs.kernels.native_functions import PAIRS, in_ranges
from npa_envs.kernels.portable.search import make_search

PERCEIVE_REGISTERS = 128
"""Registers per thread of the perception pass: more threads at a time are worth a few spills."""


@cached_under_lock()
def perception_kernels(
    space_dim: int,
    scalar: type,
    width: int,
    on_cpu: bool,
    state_gradient: bool,
    moment_inverse: str | None,
    listed: bool = False,
) -> SimpleNamespace:
    """Return the kernels `perceive` and `gather_fields`, for groups of `width` channels.

    Without `state_gradient`, or without its correction by a `moment_inverse`, they leave out the
    sums that only these need. If `listed`, they read neighbour lists instead of cells.
    """
    moment_correction = moment_inverse is not None
    space = group_types(space_dim, scalar, width)
    vector, particle, Domain = space.vector, space.particle, space.Domain
    group, group_gradient, square = space.group, space.group_gradient, space.square
    name = perception_module_name(state_gradient, moment_inverse)
    options = {"width": width, "on_cpu": on_cpu, "listed": listed}
    module = kernel_module(name, space_dim, scalar, **options)
    search = make_search(space_dim, scalar, particle, on_cpu, listed)
    add_scaled = make_add_scaled(group)
    load_group = make_wide_load(group)
    corrected = make_corrected(space_dim, scalar, width, moment_inverse)

    @wp.func
    def sum_neighbours(
        domain: Domain,
        particle_count: int,
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        neighbours: wp.array[wp.int32],
        particles: wp.array[particle],
        states: wp.array[group],
        k: int,
        g: int,
        group_count: int,
    ):
        """Return sums over k's neighbours, of group g: smoothed state, gradient, v K, moments."""
        position = space.position_of(particles[k])
        own = load_group(states, k * group_count + g)
        smoothed = group()
        gradient = group_gradient()
        kernel_sum = vector()
        moment = square()
        base = (k / particle_count) * domain.cell_count
        cell = space.cell_of(domain, position)
        for r in range(search.run_count(domain, cell)):
            begin, end = search.run_range(domain, starts, ends, base, cell, k, r)
            for first in range(begin, end, wp.static(search.stride)):
                near, count = search.filter_near(
                    domain, particles, neighbours, position, first, end
                )
                for n in range(count):
                    j = near[n]
                    entry = particles[j]
                    offset = space.minimum_image(domain, space.position_of(entry) - position)
                    squared = wp.dot(offset, offset)
                    volume = entry[wp.static(space_dim)]
                    state = load_group(states, j * group_count + g)
                    weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
                    smoothed = add_scaled(smoothed, volume * weight, state)
                    if wp.static(state_gradient):
                        kernel = offset * spiky_factor(
                            wp.sqrt(squared), domain.inverse_eps, domain.spiky_norm
                        )
                        weighted = volume * kernel
                        kernel_sum += weighted
                        for d in range(wp.static(space_dim)):
                            gradient[d] = add_scaled(gradient[d], weighted[d], state - own)
                        if wp.static(moment_correction):
                            moment += wp.outer(offset, weighted)
        return smoothed, gradient, kernel_sum, moment

    @wp.func
    def clipped(value: scalar, limit: scalar):
        result = value
        if limit > scalar(0.0):
            result = wp.clamp(value, -limit, limit)
        return result

    @in_ranges(PAIRS)
    @wp.kernel(module=module, cuda_max_registers=PERCEIVE_REGISTERS)
    def perceive(
        range_start: int,
        domain: Domain,
        particle_count: int,
        state_dim: int,
        density_gradient: int,
        gradient_scale: scalar,
        density_scale: wp.float64,
        row_base: int,
        group_count: int,
        limit: scalar,
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        neighbours: wp.array[wp.int32],
        particles: wp.array[particle],
        states: wp.array[group],
        flat_states: wp.array2d[scalar],
        row_index: wp.array[wp.int32],
        row_destination: wp.array[wp.int32],
        density_gradients: wp.array[space.vector_f64],
        # outputs
        perception: wp.array2d[scalar],
        row_kernel_sum: wp.array[vector],
        rows: wp.array2d[scalar],
    ):
        """Write the perception vector of each active particle, then a one, then zeros, as a row.

        Rows beyond the last active one are zero. Row k is written to row `row_destination[k]`, or
        to row k if that array is empty. `limit`, unless 0, clips numbers to plus and minus it.
        What the backward pass reads of it is also written to row k of `rows`, unless that is empty.
        """
        row, g = wp.tid()
        row += range_start
        if row >= starts[starts.shape[0] - 1] - row_base:
            for column in range(g, perception.shape[1], group_count):
                perception[row, column] = scalar(0.0)
            return
        k = row
        if row_index.shape[0] > 0:
            k = row_index[row]
        to = row
        if row_destination.shape[0] > 0:
            to = row_destination[row]
        smoothed, gradient, kernel_sum, moment = sum_neighbours(
            domain, particle_count, starts, ends, neighbours, particles, states, k, g, group_count
        )
        if wp.static(state_gradient and moment_correction):
            gradient = corrected(gradient, moment)
        for c in range(wp.static(width)):
            channel = g * wp.static(width) + c
            if channel < state_dim:
                perception[to, channel] = clipped(flat_states[k, channel], limit)
                perception[to, state_dim + channel] = clipped(smoothed[c], limit)
                if wp.static(state_gradient):
                    along = vector()
                    for d in range(wp.static(space_dim)):
                        along[d] = gradient_scale * gradient[d, c]
                    along = log_scaled(along)
                    first_column = 2 * state_dim + channel * wp.static(space_dim)
                    for d in range(wp.static(space_dim)):
                        perception[to, first_column + d] = clipped(along[d], limit)
                        if rows.shape[0] > 0:
                            rows[row, first_column + d] = along[d]
        if g == 0:
            if row_kernel_sum.shape[0] > 0:
                row_kernel_sum[row] = kernel_sum
            column = 2 * state_dim
            if wp.static(state_gradient):
                column += state_dim * wp.static(space_dim)
            if density_gradient != 0:
                scaled = density_scale * density_gradients[k]
                scaled = log_scaled(scaled)
                for d in range(wp.static(space_dim)):
                    perception[to, column + d] = clipped(scalar(scaled[d]), limit)
                    if rows.shape[0] > 0:
                        rows[row, column + d] = scalar(scaled[d])
                column += wp.static(space_dim)
            for padding in range(column, perception.shape[1]):
                perception[to, padding] = wp.where(padding == column, scalar(1.0), scalar(0.0))

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def gather_fields(
        range_start: int,
        domain: Domain,
        particle_count: int,
        state_dim: int,
        group_count: int,
        starts: wp.array[wp.int32],
        particles: wp.array[particle],
        states: wp.array[group],
        original_index: wp.array[wp.int32],
        # outputs
        density: wp.array[scalar],
        smoothed_field: wp.array2d[scalar],
        gradient_field: wp.array3d[scalar],
        moment_field: wp.array[square],
        corrected_field: wp.array3d[scalar],
    ):
        """Write unscaled density, smoothed state, gradients and moments, in the caller's order."""
        k, g = wp.tid()
        k += range_start
        i = original_index[k]
        unused = starts  # in place of neighbour lists: all cells are searched
        smoothed, gradient, _kernel_sum, moment = sum_neighbours(
            domain, particle_count, starts, unused, unused, particles, states, k, g, group_count
        )
        straight = corrected(gradient, moment)
        for c in range(wp.static(width)):
            channel = g * wp.static(width) + c
            if channel < state_dim:
                smoothed_field[i, channel] = smoothed[c]
                for d in range(wp.static(space_dim)):
                    gradient_field[i, channel, d] = gradient[d, c]
                    corrected_field[i, channel, d] = straight[d, c]
        if g == 0:
            density[i] = scalar(1.0) / particles[k][wp.static(space_dim)]
            moment_field[i] = moment

    return SimpleNamespace(perceive=perceive, gather_fields=gather_fields)
