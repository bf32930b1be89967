"""Pairs of particles that never move: found and weighed once, then summed over in every step.

Centre i has an entry for each neighbour j, itself included: v_j W_ij, v_j K_ij and where j is in
the sorted order. A list that has no room for all neighbours is marked: its particle searches for
them, and weighs them again.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.access import (
    load_integer,
    make_read_channels,
    make_wide_load,
    make_wide_store,
    make_write_at,
)
from npa_envs.kernels.cpu import PAIRS, PARTICLES, in_ranges, make_add_scaled, make_sift, of_groups
from npa_envs.kernels.domain import domain_types, kernel_module, scalar_name
from npa_envs.kernels.mathematics import (
    MOMENT_THRESHOLD,
    log_scale_adjoint,
    log_scaled,
    make_smooth_inverse,
    smoothing,
    spiky_factor,
)

ENTRY_SIZE = 4
"""Numbers of an entry: weights of values and of differences along each axis, in 2D a place."""

SEARCHED = -1
"""Length of a list that has no room for all neighbours."""

_PACK = "union {{ {part} word; int number; }} both; both.word = 0; {do}"


@functools.cache
def packing(scalar: type) -> SimpleNamespace:
    """Return Warp functions that put an integer's bits into a scalar, and that read them there."""
    part = {"f32": "float", "f64": "double"}[scalar_name(scalar)]
    pack = _PACK.format(part=part, do="both.number = number; return both.word;")
    unpack = _PACK.format(part=part, do="both.word = word; return both.number;")

    @wp.func_native(pack)
    def packed(number: wp.int32) -> scalar: ...

    @wp.func_native(unpack)
    def unpacked(word: scalar) -> wp.int32: ...

    return SimpleNamespace(packed=packed, unpacked=unpacked)


@functools.cache
def make_weigh(space_dim: int, scalar: type) -> wp.Function:
    """Return a Warp function that weighs a pair, just as `perception` does."""
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain

    @wp.func
    def weigh(domain: Domain, offset: vector, volume: scalar):
        """Return v W and v K of a neighbour within eps, at an offset from the centre."""
        squared = wp.dot(offset, offset)
        weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
        kernel = offset * spiky_factor(wp.sqrt(squared), domain.inverse_eps, domain.spiky_norm)
        return volume * weight, volume * kernel

    return weigh


@functools.cache
def pair_kernels(
    space_dim: int, scalar: type, lanes: int, ahead: int, moment_inverse: str | None
) -> SimpleNamespace:
    """Return the kernels that make lists.

    Args:
        space_dim: Space dimension D.
        scalar: `wp.float32` or `wp.float64`.
        lanes: 1 on the CPU, more on CUDA.
        ahead: Lists are filled up to a multiple of this many entries.
        moment_inverse: How to invert moment matrices; None: not at all.
    """
    moment_correction = moment_inverse is not None
    smooth = moment_inverse == "smooth"
    types = domain_types(space_dim, scalar)
    vector, particle, Domain = types.vector, types.particle, types.Domain
    cell_of, segment_count, segment_cells = (
        types.cell_of,
        types.segment_count,
        types.segment_cells,
    )
    minimum_image, position_of = types.minimum_image, types.position_of
    wide = wp.types.vector(space_dim, wp.float64)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    entry_type = wp.types.vector(ENTRY_SIZE, scalar)
    flat = space_dim == 2
    sift, stride = make_sift(space_dim, scalar, particle, lanes)
    # Here every particle has one thread, which takes all sifts.
    stride //= lanes
    weigh = make_weigh(space_dim, scalar)
    packed = packing(scalar).packed
    store_entry = make_wide_store(entry_type, scalar)
    smooth_inverse = make_smooth_inverse(space_dim, scalar)
    topic = "pairs" if moment_correction else "uncorrected_pairs"
    topic = "smoothly_corrected_pairs" if smooth else topic
    module = kernel_module(f"{topic}_{ahead}", space_dim, scalar, 0, lanes)

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def count_pairs(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        # outputs
        lengths: wp.array(dtype=wp.int32),
    ):
        """Write how many entries the list of each particle shall have."""
        k = range_start + wp.tid()
        position = position_of(particles[k])
        base = (k / particle_count) * domain.cell_count
        cell = cell_of(domain, position)
        length = wp.int32(0)
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            end = starts[base + last]
            for begin in range(starts[base + first], end, wp.static(stride)):
                _near, count = sift(domain, particles, position, begin, end)
                length += count
        lengths[k] = (length + wp.static(ahead - 1)) / wp.static(ahead) * wp.static(ahead)

    @wp.func
    def put(
        weights: wp.array(dtype=entry_type),
        neighbours: wp.array(dtype=wp.int32),
        place: wp.int32,
        weight: scalar,
        weighted: vector,
        j: wp.int32,
    ):
        entry = entry_type()
        entry[0] = weight
        for d in range(wp.static(space_dim)):
            entry[d + 1] = weighted[d]
        if wp.static(flat):
            entry[3] = packed(j)
        else:
            neighbours[place] = j
        store_entry(weights, place, entry)

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def list_pairs(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        capacity: wp.int32,
        density_gradient: wp.int32,
        density_scale: wp.float64,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        gradients: wp.array(dtype=wide),
        ends: wp.array(dtype=wp.int32),
        # outputs
        weights: wp.array(dtype=entry_type),
        neighbours: wp.array(dtype=wp.int32),
        lengths: wp.array(dtype=wp.int32),
        kernel_sum: wp.array(dtype=vector),
        correction: wp.array(dtype=square),
        density_columns: wp.array(dtype=vector),
    ):
        """Write the list of each particle, and whatever else of it stays as it is.

        Lists have room for `capacity` entries each, or end where `ends` says unless it is empty.
        """
        k = range_start + wp.tid()
        position = position_of(particles[k])
        base = (k / particle_count) * domain.cell_count
        cell = cell_of(domain, position)
        first_place = k * capacity
        room = capacity
        if ends.shape[0] > 0:
            first_place = wp.int32(0)
            if k > 0:
                first_place = ends[k - 1]
            room = ends[k] - first_place
        length = wp.int32(0)
        total = vector()
        moment = square()
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            end = starts[base + last]
            for begin in range(starts[base + first], end, wp.static(stride)):
                near, count = sift(domain, particles, position, begin, end)
                for n in range(count):
                    j = near[n]
                    entry = particles[j]
                    offset = minimum_image(domain, position_of(entry) - position)
                    weight, weighted = weigh(domain, offset, entry[wp.static(space_dim)])
                    total += weighted
                    if wp.static(moment_correction):
                        moment += wp.outer(offset, weighted)
                    if length < room:
                        put(weights, neighbours, first_place + length, weight, weighted, j)
                    length += 1
        if length <= room:
            while length % wp.static(ahead) != 0:
                put(weights, neighbours, first_place + length, scalar(0.0), vector(), k)
                length += 1
        else:
            length = wp.int32(wp.static(SEARCHED))
        lengths[k] = length
        kernel_sum[k] = total
        if wp.static(moment_correction):
            inverse = square()
            if wp.static(smooth):
                inverse = smooth_inverse(moment)
            elif wp.abs(wp.determinant(moment)) >= scalar(wp.static(MOMENT_THRESHOLD)):
                inverse = wp.inverse(moment)
            else:
                for d in range(wp.static(space_dim)):
                    inverse[d, d] = scalar(1.0)
            correction[k] = inverse
        if density_gradient != 0:
            scaled = density_scale * gradients[k]
            scaled = log_scaled(scaled)
            columns = vector()
            for d in range(wp.static(space_dim)):
                columns[d] = scalar(scaled[d])
            density_columns[k] = columns

    return SimpleNamespace(count_pairs=count_pairs, list_pairs=list_pairs)


# Perception of particles that never move, over weighed pairs, and its adjoint: both gathers.
#
# A thread has a group of a particle's channels and runs through the whole list, in its order;
# adjacent threads have adjacent groups, so that they read a neighbour's state together. Adjoint,
# in the notation of `adjoint`: the list of k holds v_i W_ki and v_i K_ki = -v_i K_ik, so
# cotangents of row i are divided by v_i once, and s_k += v_k sum_i (v_i W_ki) (b_i / v_i) - (v_i
# K_ki) (G_i / v_i) - G_k sum_j v_j K_kj.


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


# Steps of particles that never move: which of them have rows, and the update of their states.


@functools.cache
def state_update_kernels(scalar: type, width: int) -> SimpleNamespace:
    """Return the kernels of one variant, for groups of `width` channels."""
    group = wp.types.vector(width, scalar)
    load_group = make_wide_load(group, scalar)
    store_group = make_wide_store(group, scalar)
    write_group = make_write_at(group, scalar)
    read_channels = make_read_channels(group, scalar)
    module = kernel_module("state_update", 0, scalar, width)

    @in_ranges(PARTICLES)
    @wp.kernel(enable_backward=False, module=module)
    def give_rows(
        range_start: wp.int32,
        total: wp.int32,
        row_capacity: wp.int32,
        active_before: wp.array(dtype=wp.int32),
        # outputs
        row_of: wp.array(dtype=wp.int32),
        row_place: wp.array(dtype=wp.int32),
    ):
        """Give the active particles of each step rows in their order.

        `active_before` counts each active particle itself.
        """
        t = range_start + wp.tid()
        step = t / total
        k = t - step * total
        count = load_integer(active_before, t)
        before = wp.int32(0)
        if k > 0:
            before = load_integer(active_before, t - 1)
        row = wp.int32(-1)
        if count > before and before < row_capacity:
            row = before
            row_place[step * row_capacity + row] = k
        row_of[t] = row

    @in_ranges(PARTICLES)
    @wp.kernel(enable_backward=False, module=module)
    def update_states(
        range_start: wp.int32,
        dt: scalar,
        state_dim: wp.int32,
        group_count: wp.int32,
        update_width: wp.int32,
        aligned: wp.int32,
        row_of: wp.array(dtype=wp.int32),
        update: wp.array(dtype=scalar),
        states: wp.array(dtype=group),
        # outputs
        new_states: wp.array(dtype=group),
    ):
        """Change the states of the particles that have a row; copy the others."""
        k, g = of_groups(range_start + wp.tid(), group_count)
        place = k * group_count + g
        state = load_group(states, place)
        row = k
        if row_of.shape[0] > 0:
            row = load_integer(row_of, k)
        if row >= 0:
            change = read_channels(update, update_width, aligned, row, g * wp.static(width))
            for c in range(wp.static(width)):
                # Updates may be padded with columns that nothing reads.
                if g * wp.static(width) + c < state_dim:
                    state[c] += dt * change[c]
        store_group(new_states, place, state)

    @in_ranges(PARTICLES)
    @wp.kernel(enable_backward=False, module=module)
    def pull_back_update(
        range_start: wp.int32,
        dt: scalar,
        state_dim: wp.int32,
        group_count: wp.int32,
        update_width: wp.int32,
        aligned: wp.int32,
        row_place: wp.array(dtype=wp.int32),
        active_before: wp.array(dtype=wp.int32),
        new_states_bar: wp.array(dtype=group),
        # outputs
        update_bar: wp.array(dtype=scalar),
    ):
        """Write the cotangent of every row's update, zero beyond the last active row."""
        parts = (update_width + wp.static(width - 1)) / wp.static(width)
        row, part = of_groups(range_start + wp.tid(), parts)
        k = row
        active = part < group_count
        if row_place.shape[0] > 0:
            active = active and row < load_integer(active_before, active_before.shape[0] - 1)
            if active:
                k = load_integer(row_place, row)
        first = part * wp.static(width)
        bar = group()
        if active:
            state_bar = load_group(new_states_bar, k * group_count + part)
            for c in range(wp.static(width)):
                if first + c < state_dim:
                    bar[c] = dt * state_bar[c]
        place = row * update_width + first
        if aligned != 0:
            write_group(update_bar, place, bar)
        else:
            for c in range(wp.static(width)):
                if first + c < update_width:
                    update_bar[place + c] = bar[c]

    return SimpleNamespace(
        give_rows=give_rows, update_states=update_states, pull_back_update=pull_back_update
    )
