"""Perception on CUDA in float32, from the neighbour lists of the density pass.

The same sums as the portable kernel, in another order of work. Threads that share a particle are
its lanes: one team of `CUDA_LANES`, or several. Their part of shared memory is the particle's slot.
With neighbours n0, n1, ..., two teams and 16 channels:

    team  lane   1. writes weights of      2. adds states of   channels
     0     0      n0  n1  n16 n17           n0 n2 n4 ...        0 to 3
     0     1      n2  n3  n18 n19           n0 n2 n4 ...        4 to 7
     ...
     1     7      n14 n15 n30 n31           n1 n3 n5 ...        12 to 15

    slot   | weight, weighted kernel and index of n0 | of n1 | ... | of n31 |

So weights are computed once, only for neighbours, and a neighbour's state is read once, by adjacent
lanes. Finished rows are also written through the slot, in full transactions. Particles with more
neighbours than a list has room for search for all of them again.
"""

import math
from types import SimpleNamespace
from typing import NamedTuple

import warp as wp

from npa_envs.kernels import native_functions as native
from npa_envs.kernels.cuda.density import RECORD
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.mathematics import (
    inverse_root,
    log_scale_of_square,
    log_scaled_huge,
    make_corrected,
    perception_module_name,
    smoothing,
    spiky_factor_f64,
    within,
)
from npa_envs.kernels.primitives import (
    CUDA_BLOCK,
    CUDA_LANES,
    any_in_warp,
    as_number,
    largest_in_warp,
    load_integer,
    make_lane_sum,
    make_wide_load,
    of_lane,
    sync_warp,
    thread_number,
    wait_for_previous_kernel,
)
from npa_envs.thread_lock import cached_under_lock

CUDA_REGISTERS, TEAM_REGISTERS = {2: 80, 3: 112}, 128
"""Registers per thread: with one team for a particle, by dimension, and with several."""

PAIR = 2
"""Listed neighbours that a lane processes at a time: their entries are packed in 32 bits."""

TOGETHER = 4
"""Neighbours whose states are loaded at a time; a divisor of `SLOT_ENTRIES`."""

SLOT_ENTRIES = 32
"""Neighbours of a full slot, a multiple of `PAIR` times the lanes; more take several rounds."""

CANDIDATES = 16
"""Candidates of a particle that are loaded at a time in a search."""

load_record = make_wide_load(RECORD)

stage = native.function("stage", untyped="slot word value")
"""Write a value to a slot, at an offset of 32-bit words."""


class PerceptionVariant(NamedTuple):
    """Options of the perception kernel; each combination is another kernel."""

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
        """Channels that one thread sums, of a group of channels."""
        return self.width // CUDA_LANES

    @property
    def row_words(self) -> int:
        """Numbers of a perception row for one group of channels."""
        return self.width * (2 + self.space_dim * self.state_gradient)

    def module(self) -> wp.Module:
        """Return the Warp module of the kernel with these options."""
        options = self._asdict()
        space_dim = options.pop("space_dim")
        gradient = options.pop("state_gradient"), options.pop("moment_inverse")
        name = "listed_" + perception_module_name(*gradient)
        return kernel_module(name, space_dim, wp.float32, **options)


def slot_functions(variant: PerceptionVariant, lane_channels: type) -> SimpleNamespace:
    """Return the functions that access a particle's slot, its part of shared memory, and states."""
    space_dim, width, lanes = variant.space_dim, variant.width, variant.lanes
    row_words = variant.row_words
    vector = wp.types.vector(space_dim, wp.float32)
    entry_type = wp.types.vector(space_dim + 2, wp.float32)
    # The additional 16 bytes spread a warp's slots over the banks of shared memory.
    slot_bytes = max(SLOT_ENTRIES * (16 if space_dim == 2 else 20), 4 * row_words) + 16

    slot_address = native.function("slot_address", slot_bytes, lanes, CUDA_BLOCK, returns=wp.uint32)
    part_address = native.function(
        "part_address", states=wp.array[lane_channels], part=int, returns=wp.uint64
    )
    state = {"address": wp.uint64, "part_count": int, "number": int}
    part_of_state = native.function("part_of_state", lane_channels, **state, returns=lane_channels)
    layout, entry = (space_dim, SLOT_ENTRIES), {"slot": wp.uint32, "entry": int}
    found = {"slot": wp.uint32, "count": int, "accepted": bool, "number": int}
    append_number = native.function("append_number", *layout, lanes, **found, returns=int)
    number_at = native.function("number_at", *layout, **entry, returns=int)
    weights = {"smooth": float, "kernel": vector, "number": int}
    put_entry = native.function("put_entry", *layout, **entry, **weights)
    entry_at = native.function("entry_at", *layout, **entry, returns=entry_type)
    sizes = space_dim, width, lanes, row_words, slot_bytes, variant.grouped
    write_rows = native.function(
        "write_rows", *sizes, untyped="slot destination group state_dim limit rows"
    )

    @wp.func
    def padded(count: int):
        """Return a number of neighbours, rounded up to a multiple of the threads of a particle."""
        return (count + wp.static(lanes - 1)) & ~wp.int32(wp.static(lanes - 1))

    return native.namespace(locals())


def sum_functions(
    variant: PerceptionVariant, slots: SimpleNamespace, lane_channels: type, lane_gradient: type
) -> SimpleNamespace:
    """Return the functions that write neighbours' kernel weights to the slot, and add up sums.

    A lane adds up what has channels for all of its team's neighbours, the rest for its own ones.
    """
    scalar = wp.float32
    space_dim, lanes, periodic = variant.space_dim, variant.lanes, variant.periodic
    lane_width, teams = variant.lane_width, variant.teams
    entries_together = wp.types.matrix((TOGETHER, space_dim + 2), scalar)
    states_together = wp.types.matrix((TOGETHER, lane_width), scalar)
    state_gradient, for_adjoint = variant.state_gradient, variant.for_adjoint
    moment_correction = variant.moment_inverse is not None
    flat = space_dim == 2
    space = domain_types(space_dim, scalar)
    vector, Domain = space.vector, space.Domain
    vector_f64 = wp.types.vector(space_dim, wp.float64)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    indices_of_pair = wp.types.vector(PAIR, wp.int32)
    records_of_pair = wp.types.matrix((PAIR, 4), scalar)

    # A list's entry is the neighbour's sorted index minus the particle's.
    place = {"lists": wp.array3d[wp.int16], "row": int, "number": int}
    pair_at = native.function("pair_at", variant.capacity, variant.tiled, **place, returns=int)
    entry_of = native.function("entry_of", pair=int, number=int, returns=int)

    @wp.struct
    class Lane:
        """A lane and its particle: sorted index k, slot, position, the lane's channels of `state`.

        `states`, `part_count`: arguments of `part_of_state`. `first`: first neighbour of its team.
        """

        k: int
        lane: int
        first: int
        slot: wp.uint32
        states: wp.uint64
        part_count: int
        state: lane_channels
        position: vector
        precise: vector_f64
        inverse_eps: wp.float64

    @wp.struct
    class Sums:
        """A lane's sums over neighbours; `kernel`: of v K, volume times spiky kernel.

        `density_gradient` has no factor `spiky_norm` yet.
        """

        smoothed: lane_channels
        gradient: lane_gradient
        kernel: vector
        moment: square
        density_gradient: vector_f64

    @wp.func
    def spiky_f64(domain: Domain, own: Lane, neighbour: vector, squared: scalar):
        """Return a pair's spiky factor f / `spiky_norm` and its offset r, in float64."""
        r = vector_f64()
        start = squared
        for d in range(wp.static(space_dim)):
            r[d] = wp.float64(neighbour[d]) - own.precise[d]
        if wp.static(periodic):
            for d in range(wp.static(space_dim)):
                r[d] -= space.boxes_f64(domain, d, neighbour[d] - own.position[d])
            start = scalar(wp.dot(r, r))
        exact = wp.dot(r, r)
        apart = wp.where(start > scalar(0.0), inverse_root(start), scalar(0.0))
        return spiky_factor_f64(exact, apart, own.inverse_eps, wp.float64(1.0)), r

    @wp.func
    def weigh(
        domain: Domain,
        state_index: wp.array[wp.int32],
        entry: int,
        j: int,
        own: Lane,
        record: RECORD,
        is_neighbour: bool,
        sums: Sums,
    ):
        """Write neighbour j's kernel weights to shared memory; add its terms to this thread's sums.

        An entry that only pads the list is no neighbour: it repeats the particle, and adds 0.
        """
        number = j
        if wp.static(flat):
            number = as_number(record[3])
        elif state_index.shape[0] > 0:
            number = load_integer(state_index, j)
        neighbour = vector()
        for d in range(wp.static(space_dim)):
            neighbour[d] = record[d]
        volume = wp.where(is_neighbour, record[wp.static(space_dim)], scalar(0.0))
        offset = neighbour - own.position
        if wp.static(periodic):
            offset = space.periodic_image(domain, offset)
        squared = wp.dot(offset, offset)
        weight = smoothing(squared, domain.inverse_squared_eps, volume * domain.smoothing_norm)
        factor, r = spiky_f64(domain, own, neighbour, squared)
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
        slots.put_entry(own.slot, entry, weight, weighted, number)
        return sums

    @wp.func
    def weigh_searched(
        domain: Domain,
        records: wp.array[RECORD],
        state_index: wp.array[wp.int32],
        begin: int,
        count: int,
        own: Lane,
        sums: Sums,
    ):
        """Weigh the neighbours `begin` to `count` of those whose indices a search has written."""
        sync_warp()
        for first in range(own.lane, slots.padded(count), wp.static(PAIR * lanes)):
            indices = indices_of_pair()
            loaded = records_of_pair()
            for a in range(wp.static(PAIR)):
                entry = first + a * wp.static(lanes)
                listed = entry >= begin and entry < count
                indices[a] = wp.where(listed, slots.number_at(own.slot, entry), own.k)
            for a in range(wp.static(PAIR)):
                loaded[a] = load_record(records, indices[a])
            for a in range(wp.static(PAIR)):
                entry = first + a * wp.static(lanes)
                is_neighbour = entry >= begin and entry < count
                sums = weigh(
                    domain, state_index, entry, indices[a], own, loaded[a], is_neighbour, sums
                )
        sync_warp()
        return sums

    @wp.func
    def weigh_listed(
        domain: Domain,
        records: wp.array[RECORD],
        lists: wp.array3d[wp.int16],
        state_index: wp.array[wp.int32],
        row: int,
        begin: int,
        length: int,
        own: Lane,
        pair: int,
        sums: Sums,
    ):
        """Weigh a neighbour list's entries from `begin` on, at most `SLOT_ENTRIES` of them.

        `pair` has this lane's next two entries, loaded before the current ones are used.
        """
        end = begin + slots.padded(wp.clamp(length - begin, 0, wp.static(SLOT_ENTRIES)))
        for first in range(begin + wp.static(PAIR) * own.lane, end, wp.static(PAIR * lanes)):
            indices = indices_of_pair()
            loaded = records_of_pair()
            for a in range(wp.static(PAIR)):
                indices[a] = own.k + wp.where(first + a < length, entry_of(pair, a), wp.int32(0))
            for a in range(wp.static(PAIR)):
                loaded[a] = load_record(records, indices[a])
            pair = pair_at(lists, row, (first >> 1) + wp.static(lanes))
            for a in range(wp.static(PAIR)):
                entry = first + a - begin
                is_neighbour = first + a < length
                sums = weigh(
                    domain, state_index, entry, indices[a], own, loaded[a], is_neighbour, sums
                )
        sync_warp()
        return pair, sums

    @wp.func
    def add_states(own: Lane, count: int, sums: Sums):
        """Return `sums` plus weighted states of this team's part of the slot's `count` entries."""
        for entry in range(own.first, slots.padded(count), wp.static(teams * TOGETHER)):
            packed = entries_together()
            loaded = states_together()
            for a in range(wp.static(TOGETHER)):
                weights = slots.entry_at(own.slot, entry + a * wp.static(teams))
                for n in range(wp.static(space_dim + 2)):
                    packed[a, n] = weights[n]
            for a in range(wp.static(TOGETHER)):
                number = as_number(packed[a, wp.static(space_dim + 1)])
                loaded[a] = slots.part_of_state(own.states, own.part_count, number)
            for a in range(wp.static(TOGETHER)):
                sums.smoothed += packed[a, 0] * loaded[a]
                if wp.static(state_gradient):
                    difference = loaded[a] - own.state
                    for d in range(wp.static(space_dim)):
                        for c in range(wp.static(lane_width)):
                            sums.gradient[d, c] += packed[a, d + 1] * difference[c]
        sync_warp()
        return sums

    return native.namespace(locals(), Lane=Lane, Sums=Sums)


def make_add_searched(
    variant: PerceptionVariant, slots: SimpleNamespace, summing: SimpleNamespace
) -> wp.Function:
    """Return the function that searches cells for neighbours of particles with too long a list."""
    space_dim, lanes = variant.space_dim, variant.lanes
    Lane, Sums = summing.Lane, summing.Sums
    space = domain_types(space_dim, wp.float32)
    vector, Domain = space.vector, space.Domain
    load_vector = make_wide_load(vector)
    cell_vector = wp.types.vector(space_dim, wp.int32)
    ahead = max(CANDIDATES // lanes, 1)
    candidates_ahead = wp.types.matrix((ahead, space_dim), wp.float32)

    @wp.func
    def look_up_run(
        domain: Domain,
        starts: wp.array[wp.int32],
        world_cell: int,
        cell: cell_vector,
        runs: int,
        run: int,
    ):
        """Return first and last + 1 particle of the cells' run `run`; none from `runs` on."""
        first_cell, last_cell = space.segment_cells(
            domain, cell, wp.min(run, wp.max(runs - 1, wp.int32(0)))
        )
        begin = load_integer(starts, world_cell + first_cell)
        end = load_integer(starts, world_cell + last_cell)
        return begin, wp.where(run < runs, end, wp.int32(0))

    @wp.func
    def append_near(
        domain: Domain,
        sorted_positions: wp.array[vector],
        own: Lane,
        first: int,
        end: int,
        count: int,
    ):
        """Append neighbours among this thread's next candidates to the slot; return its count."""
        loaded = candidates_ahead()
        total = wp.int32(count)
        for a in range(wp.static(ahead)):
            candidate = first + a * wp.static(lanes)
            index = wp.where(candidate < end, candidate, wp.int32(0))
            loaded[a] = load_vector(sorted_positions, index)
        for a in range(wp.static(ahead)):
            candidate = first + a * wp.static(lanes)
            offset = loaded[a] - own.position
            if wp.static(variant.periodic):
                offset = space.periodic_image(domain, offset)
            near = wp.dot(offset, offset) < domain.squared_eps
            total = slots.append_number(own.slot, total, candidate < end and near, candidate)
        return total

    @wp.func
    def add_searched(
        domain: Domain,
        starts: wp.array[wp.int32],
        sorted_cell: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        records: wp.array[RECORD],
        state_index: wp.array[wp.int32],
        searching: bool,
        own: Lane,
        sums: Sums,
    ):
        """Add the neighbours of particles that are `searching`; a complete warp calls it."""
        world_cell = wp.int32(0)
        cell = cell_vector()
        particle_runs = wp.int32(0)
        if any_in_warp(searching):
            index = load_integer(sorted_cell, own.k)
            local = wp.int32(wp.uint32(index) % wp.uint32(domain.cell_count))
            world_cell = index - local
            cell = space.cell_at(domain, local)
            particle_runs = wp.where(searching, space.segment_count(domain, cell), wp.int32(0))
        # Each lane looks up one run of cells; all lanes then go through the runs in order.
        warp_runs = largest_in_warp(particle_runs)
        next_run = wp.int32(0)
        lane_begin = wp.int32(0)
        lane_end = wp.int32(0)
        candidate = own.lane
        end = wp.int32(0)
        # The next round leaves as many entries free as this one has beyond a multiple of the lanes:
        # a neighbour's lane then depends only on its index, not on the rest of the warp.
        begin = wp.int32(0)
        unfinished = warp_runs > 0
        while unfinished:
            count = wp.int32(begin)
            filling = wp.bool(True)
            while filling:
                while next_run < warp_runs and not any_in_warp(candidate - own.lane < end):
                    if next_run % wp.static(lanes) == 0:
                        lane_begin, lane_end = look_up_run(
                            domain, starts, world_cell, cell, particle_runs, next_run + own.lane
                        )
                    from_lane = next_run % wp.static(lanes)
                    candidate = of_lane(lane_begin, from_lane, wp.uint32(lanes)) + own.lane
                    end = of_lane(lane_end, from_lane, wp.uint32(lanes))
                    next_run += 1
                count = append_near(domain, sorted_positions, own, candidate, end, count)
                candidate += wp.static(ahead * lanes)
                unfinished = next_run < warp_runs or any_in_warp(candidate - own.lane < end)
                crowded = any_in_warp(count > wp.static(SLOT_ENTRIES - ahead * lanes))
                filling = unfinished and not crowded
            sums = summing.weigh_searched(domain, records, state_index, begin, count, own, sums)
            sums = summing.add_states(own, count, sums)
            begin = count & wp.static(lanes - 1)
        return sums

    return add_searched


def scaling_functions(variant: PerceptionVariant) -> SimpleNamespace:
    """Return the functions that scale sums logarithmically."""
    scalar = wp.float32
    space_dim, lane_width = variant.space_dim, variant.lane_width
    vector = wp.types.vector(space_dim, scalar)
    lane_gradient = wp.types.matrix((space_dim, lane_width), scalar)
    lane_rows = wp.types.vector(lane_width * space_dim, scalar)

    @wp.func
    def scale_huge(gradient_scale: scalar, gradient: lane_gradient, scaled: lane_rows):
        """Return `scaled`, corrected where the squared length of a gradient overflows."""
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

    @wp.func
    def scaled_gradient(gradient_scale: scalar, gradient: lane_gradient):
        """Return the logarithmic scaling of a thread's state gradients, channel after channel."""
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
        return scaled

    @wp.func
    def scaled_vector(v: vector):
        """Return the logarithmic scaling L(v) of a vector."""
        result = v
        squared = wp.dot(v, v)
        if wp.isinf(squared):
            result = log_scaled_huge(v)
        else:
            result *= log_scale_of_square(squared)
        return result

    return native.namespace(locals())


@cached_under_lock()
def listed_perception(variant: PerceptionVariant) -> wp.Kernel:
    """Return the kernel that perceives by neighbour lists, with these options."""
    scalar = wp.float32
    space_dim, lanes, teams = variant.space_dim, variant.lanes, variant.teams
    state_gradient, moment_correction = variant.state_gradient, variant.moment_inverse is not None
    grouped, capacity = variant.grouped, variant.capacity
    for_adjoint, per_particle = variant.for_adjoint, variant.per_particle
    width, lane_width, team = variant.width, variant.lane_width, CUDA_LANES
    space = domain_types(space_dim, scalar)
    vector, Domain = space.vector, space.Domain
    vector_f64 = wp.types.vector(space_dim, wp.float64)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    lane_channels = wp.types.vector(lane_width, scalar)
    lane_gradient = wp.types.matrix((space_dim, lane_width), scalar)
    registers = CUDA_REGISTERS[space_dim] if teams == 1 else TEAM_REGISTERS
    load_vector = make_wide_load(vector)
    add_vector = make_lane_sum(vector, lanes, whole_warps=True)
    add_square = make_lane_sum(square, lanes, whole_warps=True)
    add_f64 = make_lane_sum(vector_f64, lanes, whole_warps=True)
    add_channels = make_lane_sum(lane_channels, lanes, whole_warps=True, stride=team)
    add_gradient = make_lane_sum(lane_gradient, lanes, whole_warps=True, stride=team)
    corrected = make_corrected(space_dim, scalar, lane_width, variant.moment_inverse)
    slots = slot_functions(variant, lane_channels)
    summing = sum_functions(variant, slots, lane_channels, lane_gradient)
    add_searched = make_add_searched(variant, slots, summing)
    scaling = scaling_functions(variant)

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
        """Write the perception vector of each active particle, as the portable kernel does.

        Thread numbers count a particle's lanes and teams, channel groups and rows, in complete
        warps, some beyond the last row. `state_index` has the index of each sorted particle's
        state, by default (empty) the same index; in 2D it is in `records`. Row k is written to row
        `row_destination[k]`, by default to row k. Numbers are clipped to plus and minus `limit`
        unless it is 0.
        """
        wait_for_previous_kernel()
        thread = thread_number()
        lane = thread & wp.static(lanes - 1)
        row = thread >> wp.static(lanes.bit_length() - 1)
        g = wp.int32(0)
        if wp.static(grouped):
            g = row % group_count
            row = row / group_count
        own = summing.Lane()
        own.lane = lane
        own.slot = slots.slot_address()
        part = lane & wp.static(team - 1)
        own.first = lane >> wp.static(team.bit_length() - 1)
        own.part_count = wp.int32(wp.static(team))
        if wp.static(grouped):
            part += g * wp.static(team)
            own.part_count = group_count * wp.static(team)
        row_count = load_integer(starts, starts.shape[0] - 1) - row_base
        present = row < wp.min(row_count, row_capacity)
        # Rows beyond the last one read the first particle, with no neighbours.
        safe_row = wp.where(present, row, wp.int32(0))
        k = safe_row
        if row_index.shape[0] > 0:
            k = wp.where(present, load_integer(row_index, safe_row), wp.int32(0))
        destination = wp.where(row < row_capacity, row, wp.int32(-1))
        if row_destination.shape[0] > 0:
            destination = wp.where(present, load_integer(row_destination, safe_row), destination)
        own_index = k
        if state_index.shape[0] > 0:
            own_index = load_integer(state_index, k)
        own.k = k
        own.states = slots.part_address(states, part)
        own.state = slots.part_of_state(own.states, own.part_count, own_index)
        own.position = load_vector(sorted_positions, k)
        for d in range(wp.static(space_dim)):
            own.precise[d] = wp.float64(own.position[d])
        own.inverse_eps = wp.float64(domain.inverse_eps)
        list_number = safe_row
        if wp.static(per_particle):
            list_number = k
        length = wp.where(present, load_integer(list_lengths, list_number), wp.int32(0))
        searching = length > wp.static(capacity)
        length = wp.where(searching, wp.int32(0), length)
        longest = largest_in_warp(length)
        sums = summing.Sums()
        pair = summing.pair_at(lists, list_number, lane)
        for begin in range(0, longest, wp.static(SLOT_ENTRIES)):
            pair, sums = summing.weigh_listed(
                domain, records, lists, state_index, list_number, begin, length, own, pair, sums
            )
            count = wp.clamp(length - begin, 0, wp.static(SLOT_ENTRIES))
            sums = summing.add_states(own, count, sums)
        sums = add_searched(
            domain,
            starts,
            sorted_cell,
            sorted_positions,
            records,
            state_index,
            searching,
            own,
            sums,
        )
        smoothed = sums.smoothed
        gradient = sums.gradient
        gradient_f64 = wp.float64(domain.spiky_norm) * add_f64(sums.density_gradient)
        if wp.static(teams > 1):
            smoothed = add_channels(smoothed)
            gradient = add_gradient(gradient)
        if wp.static(state_gradient and moment_correction):
            moment = add_square(sums.moment)
            for r in range(1, wp.static(space_dim)):
                for c in range(r):
                    moment[r, c] = moment[c, r]
            gradient = corrected(gradient, moment)
        channel = (lane & wp.static(team - 1)) * wp.static(lane_width)
        stage(own.slot, channel, wp.where(present, own.state, lane_channels()))
        stage(own.slot, wp.static(width) + channel, smoothed)
        if wp.static(state_gradient):
            scaled = scaling.scaled_gradient(gradient_scale, gradient)
            stage(own.slot, wp.static(2 * width) + channel * wp.static(space_dim), scaled)
        bound = wp.where(limit > scalar(0.0), limit, scalar(wp.static(math.nan)))
        slots.write_rows(own.slot, destination, g, state_dim, bound, perception)
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
            along = scaling.scaled_vector(along)
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
