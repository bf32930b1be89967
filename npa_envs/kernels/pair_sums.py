"""Perception of particles that never move, over weighed pairs, and its adjoint: both gathers.

A thread has a group of a particle's channels and runs through the whole list, in its order;
adjacent threads have adjacent groups, so that they read a neighbour's state together.
Adjoint, in the notation of `adjoint`: the list of k holds v_i W_ki and v_i K_ki = -v_i K_ik, so
cotangents of row i are divided by v_i once, and
    s_k += v_k sum_i (v_i W_ki) (b_i / v_i) - (v_i K_ki) (G_i / v_i) - G_k sum_j v_j K_kj.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import (
    domain_types,
    kernel_module,
    log_scale_adjoint,
    log_scaled,
)
from npa_envs.kernels.groups import make_add_scaled, of_groups
from npa_envs.kernels.lanes import make_wide_load
from npa_envs.kernels.pairs import ENTRY_SIZE, make_weigh, packing
from npa_envs.kernels.ranges import PAIRS, in_ranges
from npa_envs.kernels.sifting import make_sift
from npa_envs.kernels.warps import load_integer
from npa_envs.kernels.wide import make_wide_store, make_write_at


@functools.cache
def pair_sum_kernels(
    space_dim: int,
    scalar: type,
    width: int,
    lanes: int,
    ahead: int,
    state_gradient: bool,
    moment_correction: bool,
    aligned: bool,
) -> SimpleNamespace:
    """Return the kernels of one variant.

    Args:
        space_dim: Space dimension D.
        scalar: `wp.float32` or `wp.float64`.
        width: Channels of a group.
        lanes: 1 on the CPU, more on CUDA.
        ahead: Entries that are asked for together; lists are multiples of it.
        state_gradient: Whether the state gradient is perceived.
        moment_correction: Whether it is corrected by the moment matrix.
        aligned: Whether all groups are full, and rows and groups in them begin at multiples of 16
            bytes.
    """
    types = domain_types(space_dim, scalar)
    vector, particle, Domain = types.vector, types.particle, types.Domain
    cell_of, segment_count, segment_cells = (
        types.cell_of,
        types.segment_count,
        types.segment_cells,
    )
    minimum_image, position_of = types.minimum_image, types.position_of
    group = wp.types.vector(width, scalar)
    group_gradient = wp.types.matrix((space_dim, width), scalar)
    group_columns = wp.types.vector(width * space_dim, scalar)
    kinds = 1 + space_dim * state_gradient
    cotangent = wp.types.matrix((kinds, width), scalar)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    entry_type = wp.types.vector(ENTRY_SIZE, scalar)
    entries_ahead = wp.types.matrix((ahead, ENTRY_SIZE), scalar)
    groups_ahead = wp.types.matrix((ahead, width), scalar)
    places_ahead = wp.types.vector(ahead, wp.int32)
    cotangents_ahead = wp.types.matrix((ahead * kinds, width), scalar)
    flat = space_dim == 2
    topic = "pair_smoothing"
    if state_gradient:
        topic = "pair_perception" if moment_correction else "uncorrected_pair_perception"
    topic += f"_{ahead}" + "_aligned" * aligned
    module = kernel_module(topic, space_dim, scalar, width, lanes)
    sift, stride = make_sift(space_dim, scalar, particle, lanes)
    stride //= lanes
    sifted = stride if ahead == 1 else 1
    sifted_places = wp.types.vector(sifted, wp.int32)
    weigh = make_weigh(space_dim, scalar)
    unpacked = packing(scalar).unpacked
    add_scaled = make_add_scaled(group, scalar)
    load_group = make_wide_load(group, scalar)
    load_cotangent = make_wide_load(cotangent, scalar)
    load_entry = make_wide_load(entry_type, scalar)
    store_group = make_wide_store(group, scalar)
    store_cotangent = make_wide_store(cotangent, scalar)
    write_group = make_write_at(group, scalar)
    write_columns = make_write_at(group_columns, scalar)

    @wp.func
    def neighbour_of(entry: entry_type, neighbours: wp.array(dtype=wp.int32), place: wp.int32):
        if wp.static(not flat):
            return load_integer(neighbours, place)
        return unpacked(entry[3])

    @wp.func
    def row_at(
        weights: wp.array(dtype=entry_type),
        neighbours: wp.array(dtype=wp.int32),
        row_of: wp.array(dtype=wp.int32),
        place: wp.int32,
    ):
        """Return the row of a listed neighbour, -1 where it has none."""
        row = neighbour_of(load_entry(weights, place), neighbours, place)
        if row_of.shape[0] > 0:
            row = load_integer(row_of, row)
        return row

    @wp.func
    def add_state(
        entry: entry_type, state: group, own: group, blur: group, gradient: group_gradient
    ):
        """Add a weighed neighbour's state to the sums."""
        blur = add_scaled(blur, entry[0], state)
        if wp.static(state_gradient):
            difference = state - own
            for d in range(wp.static(space_dim)):
                gradient[d] = add_scaled(gradient[d], entry[d + 1], difference)
        return blur, gradient

    @wp.func
    def add_cotangent(entry: entry_type, bar: cotangent, total: group):
        """Add what a weighed neighbour pulls at a state."""
        total = add_scaled(total, entry[0], bar[0])
        if wp.static(state_gradient):
            for d in range(wp.static(space_dim)):
                total = add_scaled(total, -entry[d + 1], bar[d + 1])
        return total

    @wp.func
    def weighed(domain: Domain, particles: wp.array(dtype=particle), position: vector, j: wp.int32):
        """Return the entry of a neighbour that is not listed."""
        other = particles[j]
        offset = minimum_image(domain, position_of(other) - position)
        weight, along = weigh(domain, offset, other[wp.static(space_dim)])
        entry = entry_type()
        entry[0] = weight
        for d in range(wp.static(space_dim)):
            entry[d + 1] = along[d]
        return entry

    @wp.func
    def sum_searched(
        domain: Domain,
        base: wp.int32,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        position: vector,
        states: wp.array(dtype=group),
        group_count: wp.int32,
        g: wp.int32,
        own: group,
    ):
        """Return the smoothed state and the state gradient of a particle without a list."""
        blur = group()
        gradient = group_gradient()
        cell = cell_of(domain, position)
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            end = starts[base + last]
            for begin in range(starts[base + first], end, wp.static(stride)):
                near, count = sift(domain, particles, position, begin, end)
                for n in range(count):
                    j = near[n]
                    entry = weighed(domain, particles, position, j)
                    state = load_group(states, j * group_count + g)
                    blur, gradient = add_state(entry, state, own, blur, gradient)
        return blur, gradient

    @wp.func
    def gather_searched(
        domain: Domain,
        base: wp.int32,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        position: vector,
        row_of: wp.array(dtype=wp.int32),
        cotangents: wp.array(dtype=cotangent),
        group_count: wp.int32,
        g: wp.int32,
    ):
        """Return what rows pull at the state of a particle without a list."""
        total = group()
        cell = cell_of(domain, position)
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            end = starts[base + last]
            for begin in range(starts[base + first], end, wp.static(stride)):
                near, count = sift(domain, particles, position, begin, end)
                for n in range(count):
                    row = near[n]
                    entry = weighed(domain, particles, position, row)
                    if row_of.shape[0] > 0:
                        row = row_of[row]
                    if row >= 0:
                        bar = load_cotangent(cotangents, row * group_count + g)
                        total = add_cotangent(entry, bar, total)
        return total

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def perceive(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        capacity: wp.int32,
        state_dim: wp.int32,
        group_count: wp.int32,
        row_width: wp.int32,
        density_gradient: wp.int32,
        gradient_scale: scalar,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        weights: wp.array(dtype=entry_type),
        neighbours: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        lengths: wp.array(dtype=wp.int32),
        correction: wp.array(dtype=square),
        density_columns: wp.array(dtype=vector),
        row_place: wp.array(dtype=wp.int32),
        active_before: wp.array(dtype=wp.int32),
        states: wp.array(dtype=group),
        # outputs
        perception: wp.array(dtype=scalar),
    ):
        """Write the perception vector of each row, a one and zeros up to the row's width.

        Rows beyond the last active one are zero.
        """
        row, g = of_groups(range_start + wp.tid(), group_count)
        row_begin = row * row_width
        k = row
        if row_place.shape[0] > 0:
            if row >= load_integer(active_before, active_before.shape[0] - 1):
                for column in range(g, row_width, group_count):
                    perception[row_begin + column] = scalar(0.0)
                return
            k = load_integer(row_place, row)
        own = load_group(states, k * group_count + g)
        length = load_integer(lengths, k)
        blur = group()
        gradient = group_gradient()
        if length >= 0:
            place = k * capacity
            if ends.shape[0] > 0:
                place = ends[k] - length
            for first in range(place, place + length, wp.static(ahead)):
                entries = entries_ahead()
                others = places_ahead()
                neighbour_states = groups_ahead()
                for a in range(wp.static(ahead)):
                    entries[a] = load_entry(weights, first + a)
                    others[a] = neighbour_of(entries[a], neighbours, first + a)
                for a in range(wp.static(ahead)):
                    neighbour_states[a] = load_group(states, others[a] * group_count + g)
                for a in range(wp.static(ahead)):
                    blur, gradient = add_state(entries[a], neighbour_states[a], own, blur, gradient)
        else:
            blur, gradient = sum_searched(
                domain,
                (k / particle_count) * domain.cell_count,
                starts,
                particles,
                position_of(particles[k]),
                states,
                group_count,
                g,
                own,
            )
        columns = group_columns()
        if wp.static(state_gradient):
            if wp.static(moment_correction):
                gradient = correction[k] * gradient
            for c in range(wp.static(width)):
                along = vector()
                for d in range(wp.static(space_dim)):
                    along[d] = gradient_scale * gradient[d, c]
                along = log_scaled(along)
                for d in range(wp.static(space_dim)):
                    columns[c * wp.static(space_dim) + d] = along[d]
        mine = g * wp.static(width)
        gradient_begin = row_begin + 2 * state_dim + mine * wp.static(space_dim)
        if wp.static(aligned):
            write_group(perception, row_begin + mine, own)
            write_group(perception, row_begin + state_dim + mine, blur)
            if wp.static(state_gradient):
                write_columns(perception, gradient_begin, columns)
        else:
            for c in range(wp.static(width)):
                if mine + c < state_dim:
                    perception[row_begin + mine + c] = own[c]
                    perception[row_begin + state_dim + mine + c] = blur[c]
                    if wp.static(state_gradient):
                        for d in range(wp.static(space_dim)):
                            place = c * wp.static(space_dim) + d
                            perception[gradient_begin + place] = columns[place]
        if g == group_count - 1:
            column = wp.static(1 + kinds) * state_dim
            if density_gradient != 0:
                for d in range(wp.static(space_dim)):
                    perception[row_begin + column + d] = density_columns[k][d]
                column += wp.static(space_dim)
            for padding in range(column, row_width):
                perception[row_begin + padding] = wp.where(
                    padding == column, scalar(1.0), scalar(0.0)
                )

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def unscale_cotangents(
        range_start: wp.int32,
        state_dim: wp.int32,
        group_count: wp.int32,
        row_width: wp.int32,
        gradient_scale: scalar,
        particles: wp.array(dtype=particle),
        row_place: wp.array(dtype=wp.int32),
        active_before: wp.array(dtype=wp.int32),
        perception: wp.array(dtype=scalar),
        perception_bar: wp.array(dtype=scalar),
        # outputs
        cotangents: wp.array(dtype=cotangent),
    ):
        """Pull the cotangents of rows back through their scaling, and divide them by volumes."""
        row, g = of_groups(range_start + wp.tid(), group_count)
        k = row
        if row_place.shape[0] > 0:
            if row >= load_integer(active_before, active_before.shape[0] - 1):
                return
            k = load_integer(row_place, row)
        density = scalar(1.0) / particles[k][wp.static(space_dim)]
        mine = g * wp.static(width)
        begin = row * row_width + 2 * state_dim + mine * wp.static(space_dim)
        result = cotangent()
        for c in range(wp.static(width)):
            if mine + c < state_dim:
                result[0, c] = density * perception_bar[row * row_width + state_dim + mine + c]
                if wp.static(state_gradient):
                    scaled = vector()
                    bar = vector()
                    for d in range(wp.static(space_dim)):
                        place = begin + c * wp.static(space_dim) + d
                        scaled[d] = perception[place]
                        bar[d] = perception_bar[place]
                    bar = (density * gradient_scale) * log_scale_adjoint(scaled, bar)
                    for d in range(wp.static(space_dim)):
                        result[1 + d, c] = bar[d]
        store_cotangent(cotangents, row * group_count + g, result)

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def gather_state_cotangents(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        capacity: wp.int32,
        state_dim: wp.int32,
        group_count: wp.int32,
        row_width: wp.int32,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        weights: wp.array(dtype=entry_type),
        neighbours: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        lengths: wp.array(dtype=wp.int32),
        kernel_sum: wp.array(dtype=vector),
        row_of: wp.array(dtype=wp.int32),
        perception_bar: wp.array(dtype=scalar),
        cotangents: wp.array(dtype=cotangent),
        # outputs
        states_bar: wp.array(dtype=group),
    ):
        """Write the cotangent of every particle's state, from the active rows around it."""
        k, g = of_groups(range_start + wp.tid(), group_count)
        length = load_integer(lengths, k)
        volume = particles[k][wp.static(space_dim)]
        total = group()
        if length >= 0:
            place = k * capacity
            if ends.shape[0] > 0:
                place = ends[k] - length
            if wp.static(sifted > 1):
                # Whether a neighbour has a row is often predicted wrongly: those are listed first.
                rows = sifted_places()
                places = sifted_places()
                for first in range(place, place + length, wp.static(sifted)):
                    count = wp.int32(0)
                    for at in range(first, wp.min(first + wp.static(sifted), place + length)):
                        row = row_at(weights, neighbours, row_of, at)
                        rows[count] = row
                        places[count] = at
                        count += wp.where(row >= 0, 1, 0)
                    for n in range(count):
                        bar = load_cotangent(cotangents, rows[n] * group_count + g)
                        total = add_cotangent(load_entry(weights, places[n]), bar, total)
            else:
                for first in range(place, place + length, wp.static(ahead)):
                    entries = entries_ahead()
                    seen = places_ahead()
                    for a in range(wp.static(ahead)):
                        entries[a] = load_entry(weights, first + a)
                        seen[a] = neighbour_of(entries[a], neighbours, first + a)
                    if row_of.shape[0] > 0:
                        for a in range(wp.static(ahead)):
                            seen[a] = load_integer(row_of, seen[a])
                    bars = cotangents_ahead()
                    for a in range(wp.static(ahead)):
                        if seen[a] >= 0:
                            bar = load_cotangent(cotangents, seen[a] * group_count + g)
                            for kind in range(wp.static(kinds)):
                                bars[a * wp.static(kinds) + kind] = bar[kind]
                    for a in range(wp.static(ahead)):
                        bar = cotangent()
                        for kind in range(wp.static(kinds)):
                            bar[kind] = bars[a * wp.static(kinds) + kind]
                        total = add_cotangent(entries[a], bar, total)
        else:
            total = gather_searched(
                domain,
                (k / particle_count) * domain.cell_count,
                starts,
                particles,
                position_of(particles[k]),
                row_of,
                cotangents,
                group_count,
                g,
            )
        row = k
        if row_of.shape[0] > 0:
            row = load_integer(row_of, k)
        if wp.static(state_gradient) and row >= 0:
            own = load_cotangent(cotangents, row * group_count + g)
            along = kernel_sum[k]
            for d in range(wp.static(space_dim)):
                total = add_scaled(total, -along[d], own[d + 1])
        total = volume * total
        if row >= 0:
            mine = g * wp.static(width)
            for c in range(wp.static(width)):
                if mine + c < state_dim:
                    total[c] += perception_bar[row * row_width + mine + c]
        store_group(states_bar, k * group_count + g, total)

    return SimpleNamespace(
        perceive=perceive,
        unscale_cotangents=unscale_cotangents,
        gather_state_cotangents=gather_state_cotangents,
    )
