"""Hand-written backward pass of perception: no float atomics, a fixed order of sums.

Notation: centre i perceives neighbour j at r = x_j - x_i, with smoothing W_ij, spiky gradient
K_ij = f r and volume v_j = 1 / ρ_j. x̄ (`x_bar`) = dL/dx, the gradient of the loss L: b̄_i by centre
i's smoothed state, Ḡ_i by its state gradient before the correction, q̄_i by its density gradient,
z̄_i by its own state in the perception vector. The moment correction is a stopped gradient, so it
has no adjoint. `kernels/portable/__init__.py` defines the arguments.

State:     s̄_k = z̄_k + v_k Σ_i (W_ik b̄_i + Ḡ_i K_ik) - Ḡ_k Σ_j v_j K_kj
Density:   ρ̄_k = -v_k² v̄_k,  v̄_k = Σ_i (W_ik s_k · b̄_i + (s_k - s_i) · Ḡ_i K_ik)
Positions: r̄_ij = (ρ̄_i + v_j s_j · b̄_i) dW/dr + (dK/dr)ᵀ (v_j Ḡ_iᵀ (s_j - s_i) + q̄_i)
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels.domain import group_types, kernel_module
from npa_envs.kernels.lanes_and_memory import make_add_scaled, make_wide_load
from npa_envs.kernels.mathematics import (
    log_scale_adjoint,
    smoothing,
    smoothing_slope,
    spiky_factor,
    spiky_radial_slope,
)
from npa_envs.kernels.native_functions import PAIRS, in_ranges
from npa_envs.kernels.portable.search import lowest_bit, make_search

STATE_REGISTERS = 64
"""Registers per thread of `gather_state_cotangents`, which mostly waits for memory."""


@cached_under_lock()
def adjoint_kernels(
    space_dim: int,
    scalar: type,
    width: int,
    on_cpu: bool,
    state_gradient: bool,
    listed: bool = False,
) -> SimpleNamespace:
    """Return the backward kernels of perception by name; arguments as for `perception_kernels`."""
    options = {"on_cpu": on_cpu, "gradient": state_gradient, "listed": listed}
    module = kernel_module("adjoint", space_dim, scalar, width=width, **options)
    space = group_types(space_dim, scalar, width)
    search = make_search(space_dim, scalar, space.vector, on_cpu, listed, of_rows=True)
    return SimpleNamespace(
        unscale_cotangents=unscaling_kernel(space, module, state_gradient),
        gather_state_cotangents=state_kernel(space, module, state_gradient, search),
        gather_density_cotangents=density_kernel(space, module, state_gradient),
        gather_position_cotangents=position_kernel(space, module),
    )


def unscaling_kernel(space: SimpleNamespace, module: wp.Module, state_gradient: bool) -> wp.Kernel:
    """Return the kernel that pulls gradients back through the logarithmic scaling."""
    space_dim, scalar, width, vector = space.space_dim, space.scalar, space.width, space.vector

    @wp.func
    def unscaled(
        perception: wp.array2d[scalar], perception_bar: wp.array2d[scalar], row: int, column: int
    ):
        """Return dL/dv of the vector v whose logarithmic scaling begins at `column`."""
        scaled = vector()
        bar = vector()
        for d in range(wp.static(space_dim)):
            scaled[d] = perception[row, column + d]
            bar[d] = perception_bar[row, column + d]
        return log_scale_adjoint(scaled, bar)

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def unscale_cotangents(
        range_start: int,
        state_dim: int,
        density_gradient: int,
        gradient_scale: scalar,
        density_scale: scalar,
        row_base: int,
        group_count: int,
        starts: wp.array[wp.int32],
        perception: wp.array2d[scalar],
        perception_bar: wp.array2d[scalar],
        bar_row: wp.array[wp.int32],
        # outputs
        smoothed_bar: wp.array[scalar],
        gradient_bar: wp.array[scalar],
        density_gradient_bar: wp.array[vector],
    ):
        """Write dL/d(smoothed states), dL/d(state gradients) and dL/d(density gradients)."""
        row, channel = wp.tid()
        row += range_start
        if row >= starts[starts.shape[0] - 1] - row_base:
            return
        from_row = row
        if bar_row.shape[0] > 0:
            from_row = bar_row[row]
        smoothed = scalar(0.0)
        gradient = vector()
        if channel < state_dim:
            smoothed = perception_bar[from_row, state_dim + channel]
            if wp.static(state_gradient):
                column = 2 * state_dim + channel * wp.static(space_dim)
                gradient = gradient_scale * unscaled(perception, perception_bar, from_row, column)
        entry = row * group_count + channel / wp.static(width)
        c = channel % wp.static(width)
        smoothed_bar[entry * wp.static(width) + c] = smoothed
        for d in range(wp.static(space_dim)):
            gradient_bar[(entry * wp.static(space_dim) + d) * wp.static(width) + c] = gradient[d]
        if channel == 0 and density_gradient_bar.shape[0] > 0:
            bar = vector()
            if density_gradient != 0:
                column = 2 * state_dim
                if wp.static(state_gradient):
                    column += state_dim * wp.static(space_dim)
                bar = density_scale * unscaled(perception, perception_bar, from_row, column)
            density_gradient_bar[row] = bar

    return unscale_cotangents


def state_kernel(
    space: SimpleNamespace, module: wp.Module, state_gradient: bool, search: Any
) -> wp.Kernel:
    """Return the kernel of dL/d(states), which finds rows by `search`."""
    space_dim, scalar, width, vector = space.space_dim, space.scalar, space.width, space.vector
    group, numbers, vectors = space.group, search.numbers, search.vectors
    together = search.together
    add_scaled = make_add_scaled(group)
    load_group, load_gradient = make_wide_load(group), make_wide_load(space.group_gradient)
    load_index = make_wide_load(wp.int32)

    @in_ranges(PAIRS // together)
    @wp.kernel(module=module, cuda_max_registers=STATE_REGISTERS)
    def gather_state_cotangents(
        range_start: int,
        domain: space.Domain,
        particle_count: int,
        state_dim: int,
        active_offset: int,
        row_base: int,
        row_capacity: int,
        group_count: int,
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        neighbours: wp.array[wp.int32],
        particles: wp.array[space.particle],
        original_index: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        row_positions: wp.array[vector],
        row_kernel_sum: wp.array[vector],
        perception_bar: wp.array2d[scalar],
        bar_row: wp.array[wp.int32],
        smoothed_bar: wp.array[space.group],
        gradient_bar: wp.array[space.group_gradient],
        flat_gradient_bar: wp.array[scalar],
        # outputs
        states_bar: wp.array2d[scalar],
    ):
        """Write dL/d(state) of each particle, a sum over the active particles around it.

        `flat_gradient_bar`: `gradient_bar` as scalars. With lists all arrays are in sorted order.
        """
        chunk, g = wp.tid()
        candidates = wp.zeros(shape=(wp.static(search.memory),), dtype=scalar)
        indices = wp.zeros(shape=(wp.static(search.room),), dtype=wp.int32)
        cursor = search.Cursor()
        first_k = (range_start + chunk) * wp.static(together)
        for k in range(first_k, wp.min(first_k + wp.static(together), particles.shape[0])):
            entry = particles[k]
            position = space.position_of(entry)
            total = group()
            base = active_offset + (k / particle_count) * domain.cell_count
            cursor = search.restart(cursor)
            while cursor.more != 0:
                cursor = search.collect(
                    domain, starts, ends, neighbours, row_of, row_base, row_capacity,
                    row_positions, base, position, k, cursor, candidates, indices,
                )  # fmt: skip
                for first in range(0, cursor.count, wp.static(search.block)):
                    offsets, squared = search.distances(domain, candidates, position, first)
                    weights = numbers()
                    kernels = vectors()
                    c = wp.int32(0)
                    while c < wp.static(search.block):
                        weights[c] = smoothing(
                            squared[c], domain.inverse_squared_eps, domain.smoothing_norm
                        )
                        if wp.static(state_gradient):
                            factor = spiky_factor(
                                wp.sqrt(squared[c]), domain.inverse_eps, domain.spiky_norm
                            )
                            for d in range(wp.static(space_dim)):
                                # From the row to this particle.
                                kernels[d, c] = -offsets[d, c] * factor
                        c += 1
                    near = search.below(squared, domain.squared_eps)
                    while near != wp.uint32(0):
                        c = lowest_bit(near)
                        near = near & (near - wp.uint32(1))
                        row = load_index(indices, first + c)
                        smoothed = load_group(smoothed_bar, row * group_count + g)
                        total = add_scaled(total, weights[c], smoothed)
                        if wp.static(state_gradient):
                            kernel = vector()
                            for d in range(wp.static(space_dim)):
                                kernel[d] = kernels[d, c]
                            total += kernel * load_gradient(gradient_bar, row * group_count + g)
            total = entry[wp.static(space_dim)] * total
            i = original_index[k]
            own_row = row_of[i]
            from_row = wp.where(bar_row.shape[0] > 0, i, own_row)
            for c in range(wp.static(width)):
                channel = g * wp.static(width) + c
                if channel < state_dim:
                    bar = total[c]
                    if own_row >= 0:
                        bar += perception_bar[from_row, channel]
                        if wp.static(state_gradient):
                            place = (own_row * group_count + g) * wp.static(space_dim)
                            for d in range(wp.static(space_dim)):
                                bar -= (
                                    row_kernel_sum[own_row][d]
                                    * flat_gradient_bar[(place + d) * wp.static(width) + c]
                                )
                    states_bar[i, channel] = bar

    return gather_state_cotangents


def density_kernel(space: SimpleNamespace, module: wp.Module, state_gradient: bool) -> wp.Kernel:
    """Return the kernel of dL/d(densities)."""
    space_dim, scalar = space.space_dim, space.scalar

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def gather_density_cotangents(
        range_start: int,
        domain: space.Domain,
        particle_count: int,
        group_count: int,
        starts: wp.array[wp.int32],
        particles: wp.array[space.particle],
        states: wp.array[space.group],
        original_index: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        smoothed_bar: wp.array[space.group],
        gradient_bar: wp.array[space.group_gradient],
        # outputs
        density_bar: wp.array[scalar],
    ):
        """Write dL/d(density) of each particle: its volume 1 / rho depends on the density."""
        k = range_start + wp.tid()
        entry = particles[k]
        position = space.position_of(entry)
        volume = entry[wp.static(space_dim)]
        volume_bar = scalar(0.0)
        base = (k / particle_count) * domain.cell_count
        cell = space.cell_of(domain, position)
        for segment in range(space.segment_count(domain, cell)):
            first, last = space.segment_cells(domain, cell, segment)
            for j in range(starts[base + first], starts[base + last]):
                offset = space.minimum_image(domain, position - space.position_of(particles[j]))
                squared = wp.dot(offset, offset)
                row = row_of[original_index[j]]
                if squared < domain.squared_eps and row >= 0:
                    weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
                    kernel = offset * spiky_factor(
                        wp.sqrt(squared), domain.inverse_eps, domain.spiky_norm
                    )
                    for g in range(group_count):
                        own_state = states[k * group_count + g]
                        index = row * group_count + g
                        volume_bar += weight * wp.dot(own_state, smoothed_bar[index])
                        if wp.static(state_gradient):
                            difference = own_state - states[j * group_count + g]
                            volume_bar += wp.dot(difference, kernel * gradient_bar[index])
        density_bar[k] = -volume * volume * volume_bar

    return gather_density_cotangents


def position_kernel(space: SimpleNamespace, module: wp.Module) -> wp.Kernel:
    """Return the kernel of dL/dx."""
    space_dim, scalar, vector = space.space_dim, space.scalar, space.vector

    @wp.func
    def pair_bar(
        domain: space.Domain,
        offset: vector,
        squared: scalar,
        smoothing_bar: scalar,
        kernel_bar: vector,
    ):
        """Return dL/dr of r = neighbour - centre, from dL/dW(r) and dL/dK(r)."""
        distance = wp.sqrt(squared)
        slope = smoothing_slope(squared, domain.inverse_squared_eps, domain.smoothing_norm)
        factor = spiky_factor(distance, domain.inverse_eps, domain.spiky_norm)
        offset_bar = smoothing_bar * slope * offset
        if distance > scalar(0.0):
            # For nearly coincident particles the large factor contributes only across r.
            direction = offset / distance
            fraction = wp.dot(direction, kernel_bar) / wp.dot(direction, direction)
            along = fraction * direction
            radial = spiky_radial_slope(distance, domain.inverse_eps, domain.spiky_norm)
            offset_bar += factor * (kernel_bar - along) + radial * along
        return offset_bar

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def gather_position_cotangents(
        range_start: int,
        domain: space.Domain,
        particle_count: int,
        group_count: int,
        starts: wp.array[wp.int32],
        particles: wp.array[space.particle],
        states: wp.array[space.group],
        original_index: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        density_bar: wp.array[scalar],
        smoothed_bar: wp.array[space.group],
        gradient_bar: wp.array[space.group_gradient],
        density_gradient_bar: wp.array[vector],
        # outputs
        positions_bar: wp.array[vector],
    ):
        """Write dL/dx of each particle: its terms as a neighbour of others, and as a centre."""
        k = range_start + wp.tid()
        entry = particles[k]
        position = space.position_of(entry)
        volume = entry[wp.static(space_dim)]
        own_row = row_of[original_index[k]]
        own_bar = vector()
        base = (k / particle_count) * domain.cell_count
        cell = space.cell_of(domain, position)
        for segment in range(space.segment_count(domain, cell)):
            first, last = space.segment_cells(domain, cell, segment)
            for j in range(starts[base + first], starts[base + last]):
                other = particles[j]
                offset = space.minimum_image(domain, position - space.position_of(other))
                squared = wp.dot(offset, offset)
                if squared < domain.squared_eps and j != k:
                    other_volume = other[wp.static(space_dim)]
                    row = row_of[original_index[j]]
                    as_neighbour = density_bar[j]
                    as_centre = density_bar[k]
                    neighbour_kernel = vector()
                    centre_kernel = vector()
                    if row >= 0:
                        neighbour_kernel = density_gradient_bar[row]
                    if own_row >= 0:
                        centre_kernel = density_gradient_bar[own_row]
                    for g in range(group_count):
                        own_state = states[k * group_count + g]
                        other_state = states[j * group_count + g]
                        if row >= 0:
                            index = row * group_count + g
                            as_neighbour += volume * wp.dot(own_state, smoothed_bar[index])
                            away = own_state - other_state
                            neighbour_kernel += volume * (gradient_bar[index] * away)
                        if own_row >= 0:
                            index = own_row * group_count + g
                            as_centre += other_volume * wp.dot(other_state, smoothed_bar[index])
                            away = other_state - own_state
                            centre_kernel += other_volume * (gradient_bar[index] * away)
                    own_bar += pair_bar(domain, offset, squared, as_neighbour, neighbour_kernel)
                    own_bar -= pair_bar(domain, -offset, squared, as_centre, centre_kernel)
        positions_bar[original_index[k]] = own_bar

    return gather_position_cotangents
