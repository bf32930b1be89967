"""The perception pass: the scaled perception vector of each active particle.

One thread serves a particle and a group of its state channels. Sums run over sorted particles, one
run of cells after the other, or over neighbour lists in the same order.

Source: arXiv 2601.16096, section 3. Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels.domain import group_types, kernel_module
from npa_envs.kernels.lanes_and_memory import make_add_outer, make_add_scaled, make_wide_load
from npa_envs.kernels.mathematics import (
    log_scaled,
    make_corrected,
    make_log_scaled,
    perception_module_name,
    smoothing,
    spiky_factor,
)
from npa_envs.kernels.native_functions import PAIRS, in_ranges
from npa_envs.kernels.portable.search import lowest_bit, make_search

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
    add_scaled, add_outer = make_add_scaled(group), make_add_outer(group_gradient, vector, group)
    load_group, load_index = make_wide_load(group), make_wide_load(wp.int32)
    load_scalar = make_wide_load(scalar)
    numbers, vectors, together = search.numbers, search.vectors, search.together
    log_scaled_gradient = make_log_scaled(space_dim, scalar, width)
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
        cursor: search.Cursor,
        candidates: wp.array[scalar],
        indices: wp.array[wp.int32],
    ):
        """Return sums over k's neighbours, of group g: smoothed state, gradient, v K, moments."""
        position = space.position_of(particles[k])
        own = load_group(states, k * group_count + g)
        smoothed = group()
        gradient = group_gradient()
        kernel_sum = vector()
        moment = square()
        base = (k / particle_count) * domain.cell_count
        cursor = search.restart(cursor)
        while cursor.more != 0:
            cursor = search.collect(
                domain, starts, ends, neighbours, starts, 0, 0, particles, base, position, k,
                cursor, candidates, indices,
            )  # fmt: skip
            for first in range(0, cursor.count, wp.static(search.block)):
                offsets, squared = search.distances(domain, candidates, position, first)
                weights = numbers()
                kernels = vectors()
                c = wp.int32(0)
                while c < wp.static(search.block):
                    place = wp.static(space_dim * search.room) + first + c
                    volume = load_scalar(candidates, place)
                    weights[c] = volume * smoothing(
                        squared[c], domain.inverse_squared_eps, domain.smoothing_norm
                    )
                    if wp.static(state_gradient):
                        factor = spiky_factor(
                            wp.sqrt(squared[c]), domain.inverse_eps, domain.spiky_norm
                        )
                        for d in range(wp.static(space_dim)):
                            kernels[d, c] = volume * (offsets[d, c] * factor)
                    c += 1
                near = search.below(squared, domain.squared_eps)
                while near != wp.uint32(0):
                    c = lowest_bit(near)
                    near = near & (near - wp.uint32(1))
                    state = load_group(states, load_index(indices, first + c) * group_count + g)
                    smoothed = add_scaled(smoothed, weights[c], state)
                    if wp.static(state_gradient):
                        weighted = vector()
                        offset = vector()
                        for d in range(wp.static(space_dim)):
                            weighted[d] = kernels[d, c]
                            offset[d] = offsets[d, c]
                        kernel_sum += weighted
                        gradient = add_outer(gradient, weighted, state - own)
                        if wp.static(moment_correction):
                            moment += wp.outer(offset, weighted)
        return smoothed, gradient, kernel_sum, moment, cursor

    @wp.func
    def clipped(value: scalar, limit: scalar):
        result = value
        if limit > scalar(0.0):
            result = wp.clamp(value, -limit, limit)
        return result

    @in_ranges(PAIRS // together)
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
        row_count: int,
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
    ):
        """Write the perception vector of each active particle, then a one, then zeros, as a row.

        Rows beyond the last active one are zero. Row k is written to row `row_destination[k]`, or
        to row k if that array is empty. `limit`, unless 0, clips numbers to plus and minus it.
        """
        chunk, g = wp.tid()
        candidates = wp.zeros(shape=(wp.static(search.memory),), dtype=scalar)
        indices = wp.zeros(shape=(wp.static(search.room),), dtype=wp.int32)
        cursor = search.Cursor()
        first_row = (range_start + chunk) * wp.static(together)
        active_count = starts[starts.shape[0] - 1] - row_base
        for row in range(first_row, wp.min(first_row + wp.static(together), row_count)):
            if row >= active_count:
                for column in range(g, perception.shape[1], group_count):
                    perception[row, column] = scalar(0.0)
                continue
            k = row
            if row_index.shape[0] > 0:
                k = row_index[row]
            to = row
            if row_destination.shape[0] > 0:
                to = row_destination[row]
            smoothed, gradient, kernel_sum, moment, cursor = sum_neighbours(
                domain, particle_count, starts, ends, neighbours, particles, states, k, g,
                group_count, cursor, candidates, indices,
            )  # fmt: skip
            if wp.static(state_gradient and moment_correction):
                gradient = corrected(gradient, moment)
            if wp.static(state_gradient):
                gradient = log_scaled_gradient(gradient_scale, gradient)
            first_channel = g * wp.static(width)
            c = wp.int32(0)
            while c < wp.min(wp.static(width), state_dim - first_channel):
                channel = first_channel + c
                perception[to, channel] = clipped(flat_states[k, channel], limit)
                perception[to, state_dim + channel] = clipped(smoothed[c], limit)
                if wp.static(state_gradient):
                    column = 2 * state_dim + channel * wp.static(space_dim)
                    for d in range(wp.static(space_dim)):
                        perception[to, column + d] = clipped(gradient[d, c], limit)
                c += 1
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
                    column += wp.static(space_dim)
                for padding in range(column, perception.shape[1]):
                    perception[to, padding] = wp.where(padding == column, scalar(1.0), scalar(0.0))

    @in_ranges(PAIRS // together)
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
        chunk, g = wp.tid()
        candidates = wp.zeros(shape=(wp.static(search.memory),), dtype=scalar)
        indices = wp.zeros(shape=(wp.static(search.room),), dtype=wp.int32)
        cursor = search.Cursor()
        first_k = (range_start + chunk) * wp.static(together)
        for k in range(first_k, wp.min(first_k + wp.static(together), particles.shape[0])):
            i = original_index[k]
            unused = starts  # in place of neighbour lists: all cells are searched
            smoothed, gradient, _kernel_sum, moment, cursor = sum_neighbours(
                domain, particle_count, starts, unused, unused, particles, states, k, g,
                group_count, cursor, candidates, indices,
            )  # fmt: skip
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
