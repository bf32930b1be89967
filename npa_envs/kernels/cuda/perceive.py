"""Perception on CUDA in float32, from the neighbour lists of the density pass.

The same sums as the portable kernel, in another order of work. First each lane of a particle
computes the weights of other neighbours, and stores them in a slot, the particle's part of shared
memory. Then all lanes run through the slot together, each for a few channels. So weights are
computed once, only for neighbours, and a neighbour's state is read once, by adjacent lanes. Rows
are also written through shared memory, in full transactions. Neighbours of a list beyond the
capacity are searched for again.
"""

import math
from types import SimpleNamespace

import warp as wp

from npa_envs.kernel_lock import cached_under_lock
from npa_envs.kernels import native
from npa_envs.kernels.access import (
    CUDA_BLOCK,
    any_in_warp,
    as_number,
    await_earlier,
    largest_in_warp,
    load_integer,
    make_lane_sum,
    make_wide_load,
    of_lane,
    share_type,
    sync_warp,
    thread_number,
)
from npa_envs.kernels.cuda.density import RECORD, make_steps_at, step_of
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.mathematics import (
    inverse_root,
    log_scale_of_square,
    log_scaled_huge,
    make_corrected,
    smoothing,
    spiky_factor_wide,
    within,
)

CUDA_REGISTERS, TEAM_REGISTERS = {2: 80, 3: 112}, 128
"""Registers per thread: with one team for a particle, by dimension, and with several."""

PAIR = 2
"""Listed neighbours that a lane processes at a time: their steps are packed in 32 bits."""

TOGETHER = 4
"""Neighbours whose states are loaded at a time; a divisor of `SLOT_ENTRIES`."""

SLOT_ENTRIES = 32
"""Neighbours of a full slot, a multiple of `PAIR` times the lanes; more take several rounds."""

CANDIDATES = 16
"""Candidates of a particle that are loaded at a time in a search."""

load_record = make_wide_load(RECORD, wp.float32)


def slot_functions(
    space_dim: int, width: int, lanes: int, share: type, row_words: int, grouped: bool
) -> SimpleNamespace:
    """Return the functions on a particle's slot, on its neighbours' states and on its row."""
    vector = wp.types.vector(space_dim, wp.float32)
    entry_type = wp.types.vector(space_dim + 2, wp.float32)
    # The additional 16 bytes spread a warp's slots over the banks of shared memory.
    slot_bytes = max(SLOT_ENTRIES * (16 if space_dim == 2 else 20), 4 * row_words) + 16

    @native.func_native(slot_bytes, lanes, CUDA_BLOCK)
    def slot_address() -> wp.uint32: ...
    @native.func_native()
    def part_address(states: wp.array(dtype=share), part: wp.int32) -> wp.uint64: ...

    @native.func_native(share)
    def part_of_state(address: wp.uint64, part_count: wp.int32, number: wp.int32) -> share: ...

    @native.func_native(space_dim, SLOT_ENTRIES, lanes)
    def append_number(
        slot: wp.uint32, count: wp.int32, accepted: wp.bool, number: wp.int32
    ) -> wp.int32: ...

    @native.func_native(space_dim, SLOT_ENTRIES)
    def number_at(slot: wp.uint32, entry: wp.int32) -> wp.int32: ...

    @native.func_native(space_dim, SLOT_ENTRIES)
    def put_entry(
        slot: wp.uint32, entry: wp.int32, smooth: wp.float32, kernel: vector, number: wp.int32
    ): ...

    @native.func_native(space_dim, SLOT_ENTRIES)
    def entry_at(slot: wp.uint32, entry: wp.int32) -> entry_type: ...

    @native.func_native(space_dim, width, lanes, row_words, slot_bytes, grouped)
    def write_rows(
        slot: wp.uint32,
        destination: wp.int32,
        group: wp.int32,
        state_dim: wp.int32,
        limit: wp.float32,
        rows: wp.array(dtype=wp.float32, ndim=2),
    ): ...

    @wp.func
    def padded(count: wp.int32):
        """Return a number of neighbours, rounded up to a multiple of the lanes."""
        return (count + wp.static(lanes - 1)) & ~wp.int32(wp.static(lanes - 1))

    numbers = append_number, number_at, padded
    return native.named(
        slot_address, part_address, part_of_state, *numbers, put_entry, entry_at, write_rows
    )


def weighing_functions(
    space_dim: int,
    lanes: int,
    slots: SimpleNamespace,
    steps_at: wp.Function,
    state_gradient: bool,
    moment_correction: bool,
    for_adjoint: bool,
    periodic: bool,
) -> SimpleNamespace:
    """Return the functions that put neighbours' weights into a slot and add up the short sums.

    These are sums whose terms have no channels: of v K, of the moment matrix, and of the density
    gradient. Each lane sums its own neighbours.
    """
    scalar = wp.float32
    flat = space_dim == 2
    types = domain_types(space_dim, scalar)
    vector, Domain, periodic_image = types.vector, types.Domain, types.periodic_image
    wide = wp.types.vector(space_dim, wp.float64)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    places_of_pair = wp.types.vector(PAIR, wp.int32)
    records_of_pair = wp.types.matrix((PAIR, 4), scalar)
    padded, number_at, put_entry = slots.padded, slots.number_at, slots.put_entry

    @wp.struct
    class Centre:
        """A row's particle, in the types that its pairs need: converted once, not for each pair."""

        position: vector
        precise: wide
        inverse_eps: wp.float64

    @wp.func
    def spiky_wide(domain: Domain, centre: Centre, neighbour: vector, squared: scalar):
        """Return a pair's spiky factor with norm 1, and its offset r, both in float64."""
        r = wide()
        start = squared
        for d in range(wp.static(space_dim)):
            r[d] = wp.float64(neighbour[d]) - centre.precise[d]
        if wp.static(periodic):
            for d in range(wp.static(space_dim)):
                images = wp.round((neighbour[d] - centre.position[d]) * domain.inverse_box[d])
                r[d] -= wp.float64(images) * wp.float64(domain.box[d])
            start = scalar(wp.dot(r, r))
        exact = wp.dot(r, r)
        apart = wp.where(start > scalar(0.0), inverse_root(start), scalar(0.0))
        return spiky_factor_wide(exact, apart, centre.inverse_eps, wp.float64(1.0)), r

    @wp.func
    def weigh(
        domain: Domain,
        state_place: wp.array(dtype=wp.int32),
        slot: wp.uint32,
        entry: wp.int32,
        j: wp.int32,
        centre: Centre,
        record: RECORD,
        counts: wp.bool,
        kernel_sum: vector,
        moment: square,
        density_gradient: wide,
    ):
        """Put neighbour j's weights into the slot, and add its terms to this lane's short sums.

        Entries that only pad a list have `counts` False and the centre's position: they add 0.
        """
        number = j
        if wp.static(flat):
            number = as_number(record[3])
        elif state_place.shape[0] > 0:
            number = load_integer(state_place, j)
        neighbour = vector()
        for d in range(wp.static(space_dim)):
            neighbour[d] = record[d]
        volume = wp.where(counts, record[wp.static(space_dim)], scalar(0.0))
        offset = neighbour - centre.position
        if wp.static(periodic):
            offset = periodic_image(domain, offset)
        squared = wp.dot(offset, offset)
        weight = smoothing(squared, domain.inverse_squared_eps, volume * domain.smoothing_norm)
        factor, r = spiky_wide(domain, centre, neighbour, squared)
        density_gradient += factor * r
        weighted = vector()
        if wp.static(state_gradient):
            weighted = (volume * domain.spiky_norm * scalar(factor)) * offset
            if wp.static(for_adjoint):
                kernel_sum += weighted
            if wp.static(moment_correction):
                for row in range(wp.static(space_dim)):
                    for column in range(row, wp.static(space_dim)):
                        moment[row, column] += offset[row] * weighted[column]
        put_entry(slot, entry, weight, weighted, number)
        return kernel_sum, moment, density_gradient

    @wp.func
    def weigh_found(
        domain: Domain,
        records: wp.array(dtype=RECORD),
        state_place: wp.array(dtype=wp.int32),
        lane: wp.int32,
        slot: wp.uint32,
        begin: wp.int32,
        count: wp.int32,
        k: wp.int32,
        centre: Centre,
        kernel_sum: vector,
        moment: square,
        density_gradient: wide,
    ):
        """Call `weigh` for neighbours whose indices are in the slot, from `begin` to `count`."""
        sync_warp()
        for first in range(lane, padded(count), wp.static(PAIR * lanes)):
            places = places_of_pair()
            found = records_of_pair()
            for a in range(wp.static(PAIR)):
                entry = first + a * wp.static(lanes)
                listed = entry >= begin and entry < count
                places[a] = wp.where(listed, number_at(slot, entry), k)
            for a in range(wp.static(PAIR)):
                found[a] = load_record(records, places[a])
            for a in range(wp.static(PAIR)):
                entry = first + a * wp.static(lanes)
                kernel_sum, moment, density_gradient = weigh(
                    domain,
                    state_place,
                    slot,
                    entry,
                    places[a],
                    centre,
                    found[a],
                    entry >= begin and entry < count,
                    kernel_sum,
                    moment,
                    density_gradient,
                )
        sync_warp()
        return kernel_sum, moment, density_gradient

    @wp.func
    def weigh_listed(
        domain: Domain,
        records: wp.array(dtype=RECORD),
        lists: wp.array(dtype=wp.int16, ndim=3),
        state_place: wp.array(dtype=wp.int32),
        lane: wp.int32,
        slot: wp.uint32,
        row: wp.int32,
        begin: wp.int32,
        length: wp.int32,
        k: wp.int32,
        centre: Centre,
        steps: wp.int32,
        kernel_sum: vector,
        moment: square,
        density_gradient: wide,
    ):
        """Call `weigh` for a list's entries from `begin` on, up to a full slot.

        The steps of a lane's next pair are loaded before the current ones are used.
        """
        end = begin + padded(wp.clamp(length - begin, 0, wp.static(SLOT_ENTRIES)))
        for first in range(begin + wp.static(PAIR) * lane, end, wp.static(PAIR * lanes)):
            places = places_of_pair()
            found = records_of_pair()
            for a in range(wp.static(PAIR)):
                places[a] = k + wp.where(first + a < length, step_of(steps, a), wp.int32(0))
            for a in range(wp.static(PAIR)):
                found[a] = load_record(records, places[a])
            steps = steps_at(lists, row, (first >> 1) + wp.static(lanes))
            for a in range(wp.static(PAIR)):
                kernel_sum, moment, density_gradient = weigh(
                    domain,
                    state_place,
                    slot,
                    first + a - begin,
                    places[a],
                    centre,
                    found[a],
                    first + a < length,
                    kernel_sum,
                    moment,
                    density_gradient,
                )
        sync_warp()
        return steps, kernel_sum, moment, density_gradient

    return SimpleNamespace(Centre=Centre, weigh_found=weigh_found, weigh_listed=weigh_listed)


def make_add_states(
    space_dim: int,
    share_width: int,
    teams: int,
    slots: SimpleNamespace,
    share: type,
    share_gradient: type,
    state_gradient: bool,
) -> wp.Function:
    """Return the function that adds neighbours' states to the long sums, by a slot's weights."""
    scalar = wp.float32
    entries_together = wp.types.matrix((TOGETHER, space_dim + 2), scalar)
    states_together = wp.types.matrix((TOGETHER, share_width), scalar)
    padded, entry_at, part_of_state = slots.padded, slots.entry_at, slots.part_of_state

    @wp.func
    def add_states(
        states: wp.uint64,
        part_count: wp.int32,
        first: wp.int32,
        slot: wp.uint32,
        count: wp.int32,
        own: share,
        blur: share,
        gradient: share_gradient,
    ):
        """Add weighted states of this team's neighbours, from `first` on, to the long sums."""
        for entry in range(first, padded(count), wp.static(teams * TOGETHER)):
            packed = entries_together()
            found = states_together()
            for a in range(wp.static(TOGETHER)):
                weighed = entry_at(slot, entry + a * wp.static(teams))
                for n in range(wp.static(space_dim + 2)):
                    packed[a, n] = weighed[n]
            for a in range(wp.static(TOGETHER)):
                number = as_number(packed[a, wp.static(space_dim + 1)])
                found[a] = part_of_state(states, part_count, number)
            for a in range(wp.static(TOGETHER)):
                blur += packed[a, 0] * found[a]
                if wp.static(state_gradient):
                    difference = found[a] - own
                    for d in range(wp.static(space_dim)):
                        for c in range(wp.static(share_width)):
                            gradient[d, c] += packed[a, d + 1] * difference[c]
        sync_warp()
        return blur, gradient

    return add_states


@cached_under_lock()
def listed_perception(
    space_dim: int,
    width: int,
    lanes: int,
    state_gradient: bool,
    moment_inverse: str | None,
    periodic: bool,
    grouped: bool,
    capacity: int,
    for_adjoint: bool,
    teams: int,
    by_place: bool = False,
    tiled: bool = False,
) -> wp.Kernel:
    """Return the perception kernel of one variant.

    Args:
        lanes: Lanes of a team, which share the channels of a group.
        grouped: Whether there are several groups of channels.
        teams: Teams of lanes that share a particle, so that few particles fill the GPU: each runs
            through its own part of the list, for all channels.
        by_place: Whether there is a list for each sorted particle, not for each row.
        tiled: Whether lists have the layout of `tiled_density`.
    """
    scalar = wp.float32
    moment_correction = moment_inverse is not None
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain
    cell_place, segment_count = types.cell_place, types.segment_count
    segment_cells = types.segment_cells
    periodic_image = types.periodic_image
    wide = wp.types.vector(space_dim, wp.float64)
    group = wp.types.vector(width, scalar)
    share = share_type(group, scalar, lanes)
    share_gradient = share_type(wp.types.matrix((space_dim, width), scalar), scalar, lanes)
    share_width = width // lanes
    share_rows = wp.types.vector(share_width * space_dim, scalar)
    team = lanes
    lanes *= teams
    ahead = max(CANDIDATES // lanes, 1)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    cell_vector = wp.types.vector(space_dim, wp.int32)
    topic = "listed_smoothing"
    if state_gradient:
        topic = "listed_perception" if moment_correction else "listed_uncorrected_perception"
        topic = "listed_smoothly_corrected_perception" if moment_inverse == "smooth" else topic
    topic += "_in_box" * periodic + "_grouped" * grouped
    topic += f"_{capacity}" + "_for_adjoint" * for_adjoint + "_by_place" * by_place
    topic += "_tiled" * tiled
    module = kernel_module(topic, space_dim, scalar, width, lanes)
    registers = CUDA_REGISTERS[space_dim] if teams == 1 else TEAM_REGISTERS
    load_vector = make_wide_load(vector, scalar)
    add_vector = make_lane_sum(vector, scalar, lanes, whole_warps=True)
    add_square = make_lane_sum(square, scalar, lanes, whole_warps=True)
    add_wide = make_lane_sum(wide, wp.float64, lanes, whole_warps=True)
    add_share = make_lane_sum(share, scalar, lanes, whole_warps=True, stride=team)
    add_gradient = make_lane_sum(share_gradient, scalar, lanes, whole_warps=True, stride=team)
    steps_at = make_steps_at(capacity, tiled)
    candidates_ahead = wp.types.matrix((ahead, space_dim), scalar)
    corrected = make_corrected(space_dim, scalar, share_width, moment_inverse)
    stage_share, stage_rows = make_stage(share), make_stage(share_rows)
    row_words = width * (2 + space_dim * state_gradient)
    slots = slot_functions(space_dim, width, lanes, share, row_words, grouped)
    slot_address, append_number = slots.slot_address, slots.append_number
    part_address, part_of_state = slots.part_address, slots.part_of_state
    write_rows = slots.write_rows
    options = state_gradient, moment_correction, for_adjoint, periodic
    weighing = weighing_functions(space_dim, lanes, slots, steps_at, *options)
    Centre, weigh_found = weighing.Centre, weighing.weigh_found
    weigh_listed = weighing.weigh_listed
    add_states = make_add_states(
        space_dim, share_width, teams, slots, share, share_gradient, state_gradient
    )

    @wp.func
    def scale_huge(gradient_scale: scalar, gradient: share_gradient, scaled: share_rows):
        """Return scaled gradients, correct also where the squared length overflows."""
        result = scaled
        for c in range(wp.static(share_width)):
            along = vector()
            for d in range(wp.static(space_dim)):
                along[d] = gradient_scale * gradient[d, c]
            if wp.isinf(wp.dot(along, along)):
                along = log_scaled_huge(along)
                for d in range(wp.static(space_dim)):
                    result[c * wp.static(space_dim) + d] = along[d]
        return result

    @wp.kernel(
        enable_backward=False, module=module, cuda_max_registers=registers, grid_stride=False
    )
    def perceive(
        domain: Domain,
        state_dim: wp.int32,
        density_gradient: wp.int32,
        gradient_scale: scalar,
        density_scale: scalar,
        row_base: wp.int32,
        row_capacity: wp.int32,
        group_count: wp.int32,
        limit: scalar,
        starts: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        records: wp.array(dtype=RECORD),
        states: wp.array(dtype=share),
        state_place: wp.array(dtype=wp.int32),
        row_place: wp.array(dtype=wp.int32),
        row_destination: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int16, ndim=3),
        list_lengths: wp.array(dtype=wp.int32),
        # outputs
        perception: wp.array(dtype=scalar, ndim=2),
        row_kernel_sum: wp.array(dtype=vector),
    ):
        """Write the perception vector of each row, as `perception_kernels` does.

        Threads are numbered by lanes, teams, groups and rows, in complete warps, some beyond the
        last row. `state_place` has the index of each sorted particle's state, by default (empty)
        the same index; in 2D it is in `records`. Row k is written to row `row_destination[k]`, by
        default to row k. Entries are clipped to plus and minus `limit` unless it is 0.
        """
        await_earlier()
        thread = thread_number()
        lane = thread & wp.static(lanes - 1)
        row = thread >> wp.static(lanes.bit_length() - 1)
        g = wp.int32(0)
        if wp.static(grouped):
            g = row % group_count
            row = row / group_count
        slot = slot_address()
        # This lane's channels, and the first of its team's neighbours.
        part = lane & wp.static(team - 1)
        first = lane >> wp.static(team.bit_length() - 1)
        part_count = wp.int32(wp.static(team))
        if wp.static(grouped):
            part += g * wp.static(team)
            part_count = group_count * wp.static(team)
        row_count = load_integer(starts, starts.shape[0] - 1) - row_base
        present = row < wp.min(row_count, row_capacity)
        blur = share()
        gradient = share_gradient()
        kernel_sum = vector()
        moment = square()
        wide_sum = wide()
        # Rows beyond the last one read the first particle, with no neighbours.
        safe_row = wp.where(present, row, wp.int32(0))
        k = safe_row
        if row_place.shape[0] > 0:
            k = wp.where(present, load_integer(row_place, safe_row), wp.int32(0))
        destination = wp.where(row < row_capacity, row, wp.int32(-1))
        if row_destination.shape[0] > 0:
            destination = wp.where(present, load_integer(row_destination, safe_row), destination)
        own_place = k
        if state_place.shape[0] > 0:
            own_place = load_integer(state_place, k)
        parts = part_address(states, part)
        own = part_of_state(parts, part_count, own_place)
        position = load_vector(sorted_positions, k)
        centre = Centre()
        centre.position = position
        for d in range(wp.static(space_dim)):
            centre.precise[d] = wp.float64(position[d])
        centre.inverse_eps = wp.float64(domain.inverse_eps)
        list_number = safe_row
        if wp.static(by_place):
            list_number = k
        length = wp.where(present, load_integer(list_lengths, list_number), wp.int32(0))
        searching = length > wp.static(capacity)
        length = wp.where(searching, wp.int32(0), length)
        longest = largest_in_warp(length)
        steps = steps_at(lists, list_number, lane)
        for first_entry in range(0, longest, wp.static(SLOT_ENTRIES)):
            steps, kernel_sum, moment, wide_sum = weigh_listed(
                domain,
                records,
                lists,
                state_place,
                lane,
                slot,
                list_number,
                first_entry,
                length,
                k,
                centre,
                steps,
                kernel_sum,
                moment,
                wide_sum,
            )
            fetched = wp.clamp(length - first_entry, 0, wp.static(SLOT_ENTRIES))
            blur, gradient = add_states(
                parts, part_count, first, slot, fetched, own, blur, gradient
            )
        base = wp.int32(0)
        cell = cell_vector()
        segments = wp.int32(0)
        if any_in_warp(searching):
            index = load_integer(sorted_cell, k)
            local = wp.int32(wp.uint32(index) % wp.uint32(domain.cell_count))
            base = index - local
            cell = cell_place(domain, local)
            segments = wp.where(searching, segment_count(domain, cell), wp.int32(0))
        # Each lane looks up one run of cells; all lanes then go through the runs in order.
        run_count = largest_in_warp(segments)
        run = wp.int32(0)
        run_begin = wp.int32(0)
        run_end = wp.int32(0)
        j = lane
        end = wp.int32(0)
        # The next round leaves as many entries free as this one has beyond a multiple of the lanes:
        # a neighbour's lane then depends only on its index, not on the rest of the warp.
        begin = wp.int32(0)
        working = run_count > 0
        while working:
            count = wp.int32(begin)
            filling = wp.bool(True)
            while filling:
                while run < run_count and not any_in_warp(j - lane < end):
                    if run % wp.static(lanes) == 0:
                        mine = wp.min(run + lane, wp.max(segments - 1, wp.int32(0)))
                        first_cell, last_cell = segment_cells(domain, cell, mine)
                        run_begin = load_integer(starts, base + first_cell)
                        run_end = load_integer(starts, base + last_cell)
                        run_end = wp.where(run + lane < segments, run_end, wp.int32(0))
                    turn = run % wp.static(lanes)
                    j = of_lane(run_begin, turn, wp.uint32(lanes)) + lane
                    end = of_lane(run_end, turn, wp.uint32(lanes))
                    run += 1
                seen = candidates_ahead()
                for a in range(wp.static(ahead)):
                    candidate = j + a * wp.static(lanes)
                    place = wp.where(candidate < end, candidate, wp.int32(0))
                    seen[a] = load_vector(sorted_positions, place)
                for a in range(wp.static(ahead)):
                    candidate = j + a * wp.static(lanes)
                    offset = seen[a] - position
                    if wp.static(periodic):
                        offset = periodic_image(domain, offset)
                    near = wp.dot(offset, offset) < domain.squared_eps
                    count = append_number(slot, count, candidate < end and near, candidate)
                j += wp.static(ahead * lanes)
                working = run < run_count or any_in_warp(j - lane < end)
                crowded = any_in_warp(count > wp.static(SLOT_ENTRIES - ahead * lanes))
                filling = working and not crowded
            kernel_sum, moment, wide_sum = weigh_found(
                domain,
                records,
                state_place,
                lane,
                slot,
                begin,
                count,
                k,
                centre,
                kernel_sum,
                moment,
                wide_sum,
            )
            blur, gradient = add_states(parts, part_count, first, slot, count, own, blur, gradient)
            begin = count & wp.static(lanes - 1)
        wide_sum = wp.float64(domain.spiky_norm) * add_wide(wide_sum)
        if wp.static(teams > 1):
            blur = add_share(blur)
            gradient = add_gradient(gradient)
        if wp.static(state_gradient and moment_correction):
            moment = add_square(moment)
            for r in range(1, wp.static(space_dim)):
                for c in range(r):
                    moment[r, c] = moment[c, r]
            gradient = corrected(gradient, moment)
        mine = (lane & wp.static(team - 1)) * wp.static(share_width)
        stage_share(slot, mine, wp.where(present, own, share()))
        stage_share(slot, wp.static(width) + mine, blur)
        if wp.static(state_gradient):
            scaled = share_rows()
            largest_square = scalar(0.0)
            for c in range(wp.static(share_width)):
                along = vector()
                for d in range(wp.static(space_dim)):
                    along[d] = gradient_scale * gradient[d, c]
                squared = wp.dot(along, along)
                largest_square = wp.max(largest_square, squared)
                along *= log_scale_of_square(squared)
                for d in range(wp.static(space_dim)):
                    scaled[c * wp.static(space_dim) + d] = along[d]
            if wp.isinf(largest_square):
                scaled = scale_huge(gradient_scale, gradient, scaled)
            stage_rows(slot, wp.static(2 * width) + mine * wp.static(space_dim), scaled)
        bound = wp.where(limit > scalar(0.0), limit, scalar(wp.static(math.nan)))
        write_rows(slot, destination, g, state_dim, bound, perception)
        if wp.static(for_adjoint):
            kernel_sum = add_vector(kernel_sum)
            if destination >= 0 and lane == 0 and g == 0:
                row_kernel_sum[row] = kernel_sum
        column = 2 * state_dim
        if wp.static(state_gradient):
            column += state_dim * wp.static(space_dim)
        if density_gradient != 0:
            along = vector()
            for d in range(wp.static(space_dim)):
                along[d] = scalar(wide_sum[d]) * density_scale
            squared = wp.dot(along, along)
            if wp.isinf(squared):
                along = log_scaled_huge(along)
            else:
                along *= log_scale_of_square(squared)
            if destination >= 0 and lane == 0 and g == 0:
                for d in range(wp.static(space_dim)):
                    perception[destination, column + d] = within(along[d], bound)
            column += wp.static(space_dim)
        if column < perception.shape[1] and destination >= 0 and g == 0:
            for padding in range(column + lane, perception.shape[1], wp.static(lanes)):
                perception[destination, padding] = wp.where(
                    padding == column and present, scalar(1.0), scalar(0.0)
                )

    return perceive


@cached_under_lock()
def make_stage(value_type: type) -> wp.Function:
    """Return a Warp function that writes a value to a slot, at an offset of 32-bit words."""

    @native.func_native()
    def stage(slot: wp.uint32, word: wp.int32, value: value_type): ...

    return stage
