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
from typing import NamedTuple

import warp as wp

from npa_envs.kernels import native_functions as native
from npa_envs.kernels.cuda.density import RECORD, make_steps_at, step_of
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.mathematics import (
    inverse_root,
    log_scale_of_square,
    log_scaled_huge,
    make_corrected,
    perception_topic,
    smoothing,
    spiky_factor_f64,
    within,
)
from npa_envs.kernels.primitives import (
    CUDA_BLOCK,
    CUDA_LANES,
    any_in_warp,
    as_number,
    await_earlier,
    largest_in_warp,
    load_integer,
    make_lane_sum,
    make_wide_load,
    of_lane,
    sync_warp,
    thread_number,
)
from npa_envs.thread_lock import cached_under_lock

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

load_record = make_wide_load(RECORD)


class PerceptionVariant(NamedTuple):
    """Switches of the perception kernel; each combination is a kernel of its own."""

    space_dim: int
    width: int
    """Channels of a group."""
    state_gradient: bool
    moment_inverse: str | None
    periodic: bool
    grouped: bool
    """Whether there are several groups of channels."""
    capacity: int
    """Longest neighbour list."""
    for_adjoint: bool
    """Whether the rows' sums of v K are written."""
    teams: int
    """Teams of `CUDA_LANES` lanes that share a particle, so that few particles fill the GPU: each
    runs through its own part of the list, for all channels."""
    per_particle: bool = False
    """Whether there is a list for each sorted particle, not for each row."""
    tiled: bool = False
    """Whether lists have the layout of `tiled_density`."""

    @property
    def lanes(self) -> int:
        """Threads that share a particle."""
        return CUDA_LANES * self.teams

    @property
    def lane_width(self) -> int:
        """Channels of a group that one lane sums."""
        return self.width // CUDA_LANES

    @property
    def row_words(self) -> int:
        """Entries of a row that belong to a group of channels."""
        return self.width * (2 + self.space_dim * self.state_gradient)

    def module(self) -> wp.Module:
        """Return the Warp module of the variant."""
        topic = "listed_" + perception_topic(self.state_gradient, self.moment_inverse)
        topic += "_in_box" * self.periodic + "_grouped" * self.grouped + f"_{self.capacity}"
        topic += "_for_adjoint" * self.for_adjoint + "_by_place" * self.per_particle
        topic += "_tiled" * self.tiled
        return kernel_module(topic, self.space_dim, wp.float32, self.width, self.lanes)


def slot_functions(variant: PerceptionVariant, lane_channels: type) -> SimpleNamespace:
    """Return the functions on a particle's slot, on its neighbours' states and on its row."""
    space_dim, width, lanes = variant.space_dim, variant.width, variant.lanes
    row_words = variant.row_words
    vector = wp.types.vector(space_dim, wp.float32)
    entry_type = wp.types.vector(space_dim + 2, wp.float32)
    # The additional 16 bytes spread a warp's slots over the banks of shared memory.
    slot_bytes = max(SLOT_ENTRIES * (16 if space_dim == 2 else 20), 4 * row_words) + 16

    @native.func_native(slot_bytes, lanes, CUDA_BLOCK)
    def slot_address() -> wp.uint32: ...

    @native.func_native()
    def part_address(states: wp.array[lane_channels], part: int) -> wp.uint64: ...

    @native.func_native(lane_channels)
    def part_of_state(address: wp.uint64, part_count: int, number: int) -> lane_channels: ...

    @native.func_native(space_dim, SLOT_ENTRIES, lanes)
    def append_number(slot: wp.uint32, count: int, accepted: bool, number: int) -> int: ...

    @native.func_native(space_dim, SLOT_ENTRIES)
    def number_at(slot: wp.uint32, entry: int) -> int: ...

    @native.func_native(space_dim, SLOT_ENTRIES)
    def put_entry(slot: wp.uint32, entry: int, smooth: float, kernel: vector, number: int): ...

    @native.func_native(space_dim, SLOT_ENTRIES)
    def entry_at(slot: wp.uint32, entry: int) -> entry_type: ...

    @native.func_native(space_dim, width, lanes, row_words, slot_bytes, variant.grouped)
    def write_rows(
        slot: wp.uint32,
        destination: int,
        group: int,
        state_dim: int,
        limit: float,
        rows: wp.array2d[wp.float32],
    ): ...

    @wp.func
    def padded(count: int):
        """Return a number of neighbours, rounded up to a multiple of the lanes."""
        return (count + wp.static(lanes - 1)) & ~wp.int32(wp.static(lanes - 1))

    numbers = append_number, number_at, padded
    return native.named(
        slot_address, part_address, part_of_state, *numbers, put_entry, entry_at, write_rows
    )


def weighing_functions(variant: PerceptionVariant, slots: SimpleNamespace) -> SimpleNamespace:
    """Return the functions that write neighbours' weights to a slot of shared memory.

    They also add up the sums without state channels: of v K, the moment matrix and the density
    gradient. Each lane adds up those of its own neighbours.
    """
    scalar = wp.float32
    space_dim, lanes, periodic = variant.space_dim, variant.lanes, variant.periodic
    state_gradient, for_adjoint = variant.state_gradient, variant.for_adjoint
    moment_correction = variant.moment_inverse is not None
    flat = space_dim == 2
    steps_at = make_steps_at(variant.capacity, variant.tiled)
    types = domain_types(space_dim, scalar)
    vector, Domain, periodic_image = types.vector, types.Domain, types.periodic_image
    vector_f64 = wp.types.vector(space_dim, wp.float64)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    places_of_pair = wp.types.vector(PAIR, wp.int32)
    records_of_pair = wp.types.matrix((PAIR, 4), scalar)
    padded, number_at, put_entry = slots.padded, slots.number_at, slots.put_entry

    @wp.struct
    class Centre:
        """A row's particle, in the types that its pairs need: converted once, not for each pair."""

        position: vector
        precise: vector_f64
        inverse_eps: wp.float64

    @wp.struct
    class Sums:
        """A lane's sums over neighbours: v K, moment matrix, density gradient / `spiky_norm`."""

        kernel: vector
        moment: square
        density_gradient: vector_f64

    @wp.func
    def spiky_f64(domain: Domain, centre: Centre, neighbour: vector, squared: scalar):
        """Return a pair's spiky factor / `spiky_norm`, and its offset r, both in float64."""
        r = vector_f64()
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
        return spiky_factor_f64(exact, apart, centre.inverse_eps, wp.float64(1.0)), r

    @wp.func
    def weigh(
        domain: Domain,
        state_index: wp.array[wp.int32],
        slot: wp.uint32,
        entry: int,
        j: int,
        centre: Centre,
        record: RECORD,
        counts: bool,
        sums: Sums,
    ):
        """Write neighbour j's weights to the slot, and add its terms to this lane's `Sums`.

        Entries that only pad a list have `counts` False and the centre's position: they add 0.
        """
        number = j
        if wp.static(flat):
            number = as_number(record[3])
        elif state_index.shape[0] > 0:
            number = load_integer(state_index, j)
        neighbour = vector()
        for d in range(wp.static(space_dim)):
            neighbour[d] = record[d]
        volume = wp.where(counts, record[wp.static(space_dim)], scalar(0.0))
        offset = neighbour - centre.position
        if wp.static(periodic):
            offset = periodic_image(domain, offset)
        squared = wp.dot(offset, offset)
        weight = smoothing(squared, domain.inverse_squared_eps, volume * domain.smoothing_norm)
        factor, r = spiky_f64(domain, centre, neighbour, squared)
        sums.density_gradient += factor * r
        weighted = vector()
        if wp.static(state_gradient):
            weighted = (volume * domain.spiky_norm * scalar(factor)) * offset
            if wp.static(for_adjoint):
                sums.kernel += weighted
            if wp.static(moment_correction):
                for row in range(wp.static(space_dim)):
                    for column in range(row, wp.static(space_dim)):
                        sums.moment[row, column] += offset[row] * weighted[column]
        put_entry(slot, entry, weight, weighted, number)
        return sums

    @wp.func
    def weigh_found(
        domain: Domain,
        records: wp.array[RECORD],
        state_index: wp.array[wp.int32],
        lane: int,
        slot: wp.uint32,
        begin: int,
        count: int,
        k: int,
        centre: Centre,
        sums: Sums,
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
                sums = weigh(
                    domain,
                    state_index,
                    slot,
                    entry,
                    places[a],
                    centre,
                    found[a],
                    entry >= begin and entry < count,
                    sums,
                )
        sync_warp()
        return sums

    @wp.func
    def weigh_listed(
        domain: Domain,
        records: wp.array[RECORD],
        lists: wp.array3d[wp.int16],
        state_index: wp.array[wp.int32],
        lane: int,
        slot: wp.uint32,
        row: int,
        begin: int,
        length: int,
        k: int,
        centre: Centre,
        steps: int,
        sums: Sums,
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
                sums = weigh(
                    domain,
                    state_index,
                    slot,
                    first + a - begin,
                    places[a],
                    centre,
                    found[a],
                    first + a < length,
                    sums,
                )
        sync_warp()
        return steps, sums

    return SimpleNamespace(
        Centre=Centre, Sums=Sums, weigh_found=weigh_found, weigh_listed=weigh_listed
    )


def make_add_states(
    variant: PerceptionVariant, slots: SimpleNamespace, lane_channels: type, lane_gradient: type
) -> wp.Function:
    """Return the function that adds neighbours' states to the long sums, by a slot's weights."""
    scalar = wp.float32
    space_dim, lane_width, teams = variant.space_dim, variant.lane_width, variant.teams
    state_gradient = variant.state_gradient
    entries_together = wp.types.matrix((TOGETHER, space_dim + 2), scalar)
    states_together = wp.types.matrix((TOGETHER, lane_width), scalar)
    padded, entry_at, part_of_state = slots.padded, slots.entry_at, slots.part_of_state

    @wp.func
    def add_states(
        states: wp.uint64,
        part_count: int,
        first: int,
        slot: wp.uint32,
        count: int,
        own: lane_channels,
        blur: lane_channels,
        gradient: lane_gradient,
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
                        for c in range(wp.static(lane_width)):
                            gradient[d, c] += packed[a, d + 1] * difference[c]
        sync_warp()
        return blur, gradient

    return add_states


@cached_under_lock()
def listed_perception(variant: PerceptionVariant) -> wp.Kernel:
    """Return the perception kernel of a variant."""
    scalar = wp.float32
    space_dim, width, lanes, teams = variant.space_dim, variant.width, variant.lanes, variant.teams
    state_gradient, moment_correction = variant.state_gradient, variant.moment_inverse is not None
    periodic, grouped, capacity = variant.periodic, variant.grouped, variant.capacity
    for_adjoint, per_particle = variant.for_adjoint, variant.per_particle
    lane_width, team = variant.lane_width, CUDA_LANES
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain
    cell_at, segment_count = types.cell_at, types.segment_count
    segment_cells, periodic_image = types.segment_cells, types.periodic_image
    vector_f64 = wp.types.vector(space_dim, wp.float64)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    lane_channels = wp.types.vector(lane_width, scalar)
    lane_gradient = wp.types.matrix((space_dim, lane_width), scalar)
    lane_rows = wp.types.vector(lane_width * space_dim, scalar)
    cell_vector = wp.types.vector(space_dim, wp.int32)
    ahead = max(CANDIDATES // lanes, 1)
    candidates_ahead = wp.types.matrix((ahead, space_dim), scalar)
    registers = CUDA_REGISTERS[space_dim] if teams == 1 else TEAM_REGISTERS
    load_vector = make_wide_load(vector)
    add_vector = make_lane_sum(vector, lanes, whole_warps=True)
    add_square = make_lane_sum(square, lanes, whole_warps=True)
    add_f64 = make_lane_sum(vector_f64, lanes, whole_warps=True)
    add_channels = make_lane_sum(lane_channels, lanes, whole_warps=True, stride=team)
    add_gradient = make_lane_sum(lane_gradient, lanes, whole_warps=True, stride=team)
    steps_at = make_steps_at(capacity, variant.tiled)
    corrected = make_corrected(space_dim, scalar, lane_width, variant.moment_inverse)
    stage_channels, stage_rows = make_stage(lane_channels), make_stage(lane_rows)
    slots = slot_functions(variant, lane_channels)
    slot_address, append_number = slots.slot_address, slots.append_number
    part_address, part_of_state = slots.part_address, slots.part_of_state
    write_rows = slots.write_rows
    weighing = weighing_functions(variant, slots)
    Centre, Sums = weighing.Centre, weighing.Sums
    weigh_found, weigh_listed = weighing.weigh_found, weighing.weigh_listed
    add_states = make_add_states(variant, slots, lane_channels, lane_gradient)

    @wp.func
    def scale_huge(gradient_scale: scalar, gradient: lane_gradient, scaled: lane_rows):
        """Return scaled gradients, correct also where the squared length overflows."""
        result = scaled
        for c in range(wp.static(lane_width)):
            along = vector()
            for d in range(wp.static(space_dim)):
                along[d] = gradient_scale * gradient[d, c]
            if wp.isinf(wp.dot(along, along)):
                along = log_scaled_huge(along)
                for d in range(wp.static(space_dim)):
                    result[c * wp.static(space_dim) + d] = along[d]
        return result

    @wp.kernel(
        enable_backward=False,
        module=variant.module(),
        cuda_max_registers=registers,
        grid_stride=False,
    )
    def perceive(
        domain: Domain,
        state_dim: int,
        density_gradient: int,
        gradient_scale: scalar,
        density_scale: scalar,
        row_base: int,
        row_capacity: int,
        group_count: int,
        limit: scalar,
        starts: wp.array[wp.int32],
        sorted_cell: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        records: wp.array[RECORD],
        states: wp.array[lane_channels],
        state_index: wp.array[wp.int32],
        row_index: wp.array[wp.int32],
        row_destination: wp.array[wp.int32],
        lists: wp.array3d[wp.int16],
        list_lengths: wp.array[wp.int32],
        # outputs
        perception: wp.array2d[scalar],
        row_kernel_sum: wp.array[vector],
    ):
        """Write the perception vector of each row, as `perception_kernels` does.

        Threads are numbered by lanes, teams, groups and rows, in complete warps, some beyond the
        last row. `state_index` has the index of each sorted particle's state, by default (empty)
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
        blur = lane_channels()
        gradient = lane_gradient()
        sums = Sums()
        # Rows beyond the last one read the first particle, with no neighbours.
        safe_row = wp.where(present, row, wp.int32(0))
        k = safe_row
        if row_index.shape[0] > 0:
            k = wp.where(present, load_integer(row_index, safe_row), wp.int32(0))
        destination = wp.where(row < row_capacity, row, wp.int32(-1))
        if row_destination.shape[0] > 0:
            destination = wp.where(present, load_integer(row_destination, safe_row), destination)
        own_place = k
        if state_index.shape[0] > 0:
            own_place = load_integer(state_index, k)
        parts = part_address(states, part)
        own = part_of_state(parts, part_count, own_place)
        position = load_vector(sorted_positions, k)
        centre = Centre()
        centre.position = position
        for d in range(wp.static(space_dim)):
            centre.precise[d] = wp.float64(position[d])
        centre.inverse_eps = wp.float64(domain.inverse_eps)
        list_number = safe_row
        if wp.static(per_particle):
            list_number = k
        length = wp.where(present, load_integer(list_lengths, list_number), wp.int32(0))
        searching = length > wp.static(capacity)
        length = wp.where(searching, wp.int32(0), length)
        longest = largest_in_warp(length)
        steps = steps_at(lists, list_number, lane)
        for first_entry in range(0, longest, wp.static(SLOT_ENTRIES)):
            steps, sums = weigh_listed(
                domain,
                records,
                lists,
                state_index,
                lane,
                slot,
                list_number,
                first_entry,
                length,
                k,
                centre,
                steps,
                sums,
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
            cell = cell_at(domain, local)
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
            sums = weigh_found(
                domain, records, state_index, lane, slot, begin, count, k, centre, sums
            )
            blur, gradient = add_states(parts, part_count, first, slot, count, own, blur, gradient)
            begin = count & wp.static(lanes - 1)
        gradient_f64 = wp.float64(domain.spiky_norm) * add_f64(sums.density_gradient)
        if wp.static(teams > 1):
            blur = add_channels(blur)
            gradient = add_gradient(gradient)
        if wp.static(state_gradient and moment_correction):
            moment = add_square(sums.moment)
            for r in range(1, wp.static(space_dim)):
                for c in range(r):
                    moment[r, c] = moment[c, r]
            gradient = corrected(gradient, moment)
        mine = (lane & wp.static(team - 1)) * wp.static(lane_width)
        stage_channels(slot, mine, wp.where(present, own, lane_channels()))
        stage_channels(slot, wp.static(width) + mine, blur)
        if wp.static(state_gradient):
            scaled = lane_rows()
            largest_square = scalar(0.0)
            for c in range(wp.static(lane_width)):
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
            kernel_sum = add_vector(sums.kernel)
            if destination >= 0 and lane == 0 and g == 0:
                row_kernel_sum[row] = kernel_sum
        column = 2 * state_dim
        if wp.static(state_gradient):
            column += state_dim * wp.static(space_dim)
        if density_gradient != 0:
            along = vector()
            for d in range(wp.static(space_dim)):
                along[d] = scalar(gradient_f64[d]) * density_scale
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
    def stage(slot: wp.uint32, word: int, value: value_type): ...

    return stage
