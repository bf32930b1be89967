"""Perception on CUDA in float32, from the neighbour lists of the density pass.

The sums are those of the portable kernel, in another order of work. Some adjacent threads, called
the particle's lanes, share a particle: one team of `CUDA_LANES` lanes, or several teams. Each
particle has a part of shared memory, its scratch. With neighbours n0, n1, ..., two teams and 16
channels:

    team  lane   1. writes weights of      2. adds states of   channels
     0     0      n0  n1  n16 n17           n0 n2 n4 ...        0 to 3
     0     1      n2  n3  n18 n19           n0 n2 n4 ...        4 to 7
     ...
     1     7      n14 n15 n30 n31           n1 n3 n5 ...        12 to 15

    scratch | weight, weighted kernel and index of n0 | of n1 | ... | of n31 |

So each weight is computed once, only for neighbours, and adjacent lanes read a neighbour's state
once. Finished rows also go through the scratch, to be written in full transactions. Particles with
more neighbours than a list has room for search the cells again.
"""

import math
from types import SimpleNamespace
from typing import NamedTuple

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.cuda.density import RECORD
from npa_envs.kernels.domain import group_types, kernel_module
from npa_envs.kernels.lanes_and_memory import (
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
from npa_envs.kernels.mathematics import (
    inverse_root,
    make_corrected,
    perception_module_name,
    scaling_functions,
    smoothing,
    spiky_factor_f64,
    within,
)

PERCEIVE_REGISTERS, TEAM_REGISTERS = {2: 80, 3: 112}, 128
"""Registers per thread: for one team per particle, by space dimension, and for several teams."""

PAIR = 2
"""Listed neighbours whose weights a lane computes at a time: list entries of 16 bits, in a word."""

TOGETHER = 4
"""Neighbours whose states a lane loads at a time; a divisor of `SCRATCH_ENTRIES`."""

SCRATCH_ENTRIES = 32
"""Neighbours of a full scratch, a multiple of `PAIR` times the lanes; more take several rounds."""

CANDIDATES = 16
"""Candidates that all lanes of a particle load together in a search."""

load_record = make_wide_load(RECORD)

stage = native.function("stage", untyped="scratch word value")
"""Write a value to the scratch, at an offset `word` in 32-bit words."""


class PerceptionVariant(NamedTuple):
    """Options of the perception kernel; each combination has its own kernel."""

    space_dim: int
    width: int
    """Number of channels in a group."""
    state_gradient: bool
    moment_inverse: str | None
    periodic: bool
    grouped: bool
    """Whether there are several groups of channels."""
    capacity: int
    """Maximum number of neighbours in a list."""
    for_adjoint: bool
    """Whether the backward pass follows: the kernel then also writes each row's sum of v K."""
    teams: int
    """Number of teams of `CUDA_LANES` lanes that share a particle. Several teams let few particles
    fill the GPU. Each team sums all channels of its own part of the list."""
    per_particle: bool = False
    """Whether each sorted particle has a list; if not, each row has one."""
    tiled: bool = False
    """Whether the lists are stored one after the other, as `tiled_density` writes them."""
    twice: bool = False
    """Whether rows are also written in their own order, to an array for the backward pass."""

    @property
    def lanes(self) -> int:
        """Number of threads that share a particle."""
        return CUDA_LANES * self.teams

    @property
    def lane_width(self) -> int:
        """Number of channels that one thread sums."""
        return self.width // CUDA_LANES

    @property
    def row_words(self) -> int:
        """Number of entries of a perception row that one group of channels fills."""
        return self.width * (2 + self.space_dim * self.state_gradient)

    def module(self) -> wp.Module:
        """Return the Warp module for the kernel with these options."""
        options = self._asdict()
        space_dim = options.pop("space_dim")
        gradient = options.pop("state_gradient"), options.pop("moment_inverse")
        name = "listed_" + perception_module_name(*gradient)
        return kernel_module(name, space_dim, wp.float32, **options)


def thread_types(variant: PerceptionVariant) -> SimpleNamespace:
    """Return `group_types` of the channels that a lane sums, and the structs `Lane` and `Sums`."""
    space = group_types(variant.space_dim, wp.float32, variant.lane_width)

    @wp.struct
    class Lane:
        """A lane, and its particle: sorted index k, address of the scratch, position.

        `state` has the lane's channels of the particle's state. `first` is the first scratch entry
        of its team. `states` and `part_count` are arguments of `part_of_state`.
        """

        k: int
        lane: int
        first: int
        scratch: wp.uint32
        states: wp.uint64
        part_count: int
        state: space.group
        position: space.vector
        precise: space.vector_f64
        inverse_eps: wp.float64

    @wp.struct
    class Sums:
        """A lane's sums over neighbours; `kernel` is the sum of v K, volume times spiky kernel.

        `density_gradient` is still to be multiplied by `spiky_norm`.
        """

        smoothed: space.group
        gradient: space.group_gradient
        kernel: space.vector
        moment: space.square
        density_gradient: space.vector_f64

    return SimpleNamespace(**vars(space), Lane=Lane, Sums=Sums)


def scratch_functions(variant: PerceptionVariant, space: SimpleNamespace) -> SimpleNamespace:
    """Return all of `space`, plus the functions that access states and a particle's scratch."""
    space_dim, width, lanes = variant.space_dim, variant.width, variant.lanes
    row_words, lane_channels, vector = variant.row_words, space.group, space.vector
    entry_type = wp.types.vector(space_dim + 2, wp.float32)
    # The additional 16 bytes spread a warp's scratches over the banks of shared memory.
    scratch_bytes = max(SCRATCH_ENTRIES * (16 if space_dim == 2 else 20), 4 * row_words) + 16

    scratch_address = native.function(
        "scratch_address", scratch_bytes, lanes, CUDA_BLOCK, returns=wp.uint32
    )
    part_address = native.function(
        "part_address", states=wp.array[lane_channels], part=int, returns=wp.uint64
    )
    state = {"address": wp.uint64, "part_count": int, "number": int}
    part_of_state = native.function("part_of_state", lane_channels, **state, returns=lane_channels)
    layout, entry = (space_dim, SCRATCH_ENTRIES), {"scratch": wp.uint32, "entry": int}
    found = {"scratch": wp.uint32, "count": int, "accepted": bool, "number": int}
    append_number = native.function("append_number", *layout, lanes, **found, returns=int)
    number_at = native.function("number_at", *layout, **entry, returns=int)
    weights = {"smooth": float, "kernel": vector, "number": int}
    put_entry = native.function("put_entry", *layout, **entry, **weights)
    entry_at = native.function("entry_at", *layout, **entry, returns=entry_type)
    sizes = space_dim, width, lanes, row_words, scratch_bytes, variant.grouped
    write_rows = native.function(
        "write_rows", *sizes, untyped="scratch destination group state_dim limit rows"
    )

    @wp.func
    def padded(count: int):
        """Return a number of neighbours, rounded up to a multiple of the threads of a particle."""
        return (count + wp.static(lanes - 1)) & ~wp.int32(wp.static(lanes - 1))

    return native.namespace(locals(), **vars(space))


def weighing_functions(variant: PerceptionVariant, space: SimpleNamespace) -> SimpleNamespace:
    """Return the functions that write weights to the scratch, and add terms without states."""
    space_dim, lanes, periodic = variant.space_dim, variant.lanes, variant.periodic
    state_gradient, moment_correction = variant.state_gradient, variant.moment_inverse is not None
    scalar, vector, vector_f64 = space.scalar, space.vector, space.vector_f64
    Domain, Lane, Sums = space.Domain, space.Lane, space.Sums
    indices_of_pair = wp.types.vector(PAIR, wp.int32)
    records_of_pair = wp.types.matrix((PAIR, 4), scalar)

    # A list's entry is the neighbour's sorted index minus the particle's.
    place = {"lists": wp.array3d[wp.int16], "row": int, "number": int}
    pair_at = native.function("pair_at", variant.capacity, variant.tiled, **place, returns=int)
    entry_of = native.function("entry_of", pair=int, number=int, returns=int)

    @wp.func
    def spiky_f64(domain: Domain, own: Lane, neighbour: vector, squared: scalar):
        """Return f / `spiky_norm` of the spiky kernel f r of a neighbour, and r, in float64."""
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
        """Write neighbour j's kernel weights to a scratch `entry`; return `sums` plus its terms.

        If not `is_neighbour`, the entry only pads the list: it repeats the particle, and adds 0.
        """
        number = j
        if wp.static(space_dim == 2):
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
            if wp.static(variant.for_adjoint):
                sums.kernel += weighted
            if wp.static(moment_correction):
                for row in range(wp.static(space_dim)):
                    for column in range(row, wp.static(space_dim)):
                        sums.moment[row, column] += offset[row] * weighted[column]
        space.put_entry(own.scratch, entry, weight, weighted, number)
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
        """Return `sums` plus terms of the neighbours in scratch entries `begin` to `count` - 1."""
        sync_warp()
        for first in range(own.lane, space.padded(count), wp.static(PAIR * lanes)):
            indices = indices_of_pair()
            loaded = records_of_pair()
            for a in range(wp.static(PAIR)):
                entry = first + a * wp.static(lanes)
                listed = entry >= begin and entry < count
                indices[a] = wp.where(listed, space.number_at(own.scratch, entry), own.k)
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
        """Write weights of up to `SCRATCH_ENTRIES` neighbours of a list, from number `begin` on.

        Return the next `pair`, and `sums` plus their terms. `pair` has the next two list entries of
        the lane, which are loaded before the previous ones are used.
        """
        end = begin + space.padded(wp.clamp(length - begin, 0, wp.static(SCRATCH_ENTRIES)))
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

    return native.namespace(locals())


def make_add_states(variant: PerceptionVariant, space: SimpleNamespace) -> wp.Function:
    """Return the function that adds neighbours' states to sums, times their weights in the scratch.

    A lane adds its own channels of all neighbours of its team.
    """
    space_dim, lane_width, teams = variant.space_dim, variant.lane_width, variant.teams
    state_gradient, Lane, Sums = variant.state_gradient, space.Lane, space.Sums
    entries_together = wp.types.matrix((TOGETHER, space_dim + 2), space.scalar)
    states_together = wp.types.matrix((TOGETHER, lane_width), space.scalar)

    @wp.func
    def add_states(own: Lane, count: int, sums: Sums):
        """Return `sums` plus weighted states of the team's part of `count` scratch entries."""
        for entry in range(own.first, space.padded(count), wp.static(teams * TOGETHER)):
            packed = entries_together()
            loaded = states_together()
            for a in range(wp.static(TOGETHER)):
                weights = space.entry_at(own.scratch, entry + a * wp.static(teams))
                for n in range(wp.static(space_dim + 2)):
                    packed[a, n] = weights[n]
            for a in range(wp.static(TOGETHER)):
                number = as_number(packed[a, wp.static(space_dim + 1)])
                loaded[a] = space.part_of_state(own.states, own.part_count, number)
            for a in range(wp.static(TOGETHER)):
                sums.smoothed += packed[a, 0] * loaded[a]
                if wp.static(state_gradient):
                    difference = loaded[a] - own.state
                    for d in range(wp.static(space_dim)):
                        for c in range(wp.static(lane_width)):
                            sums.gradient[d, c] += packed[a, d + 1] * difference[c]
        sync_warp()
        return sums

    return add_states


def make_add_searched(
    variant: PerceptionVariant,
    space: SimpleNamespace,
    weigh_searched: wp.Function,
    add_states: wp.Function,
) -> wp.Function:
    """Return the function that searches the cells for neighbours that do not fit into a list."""
    space_dim, lanes = variant.space_dim, variant.lanes
    vector, cell_vector, Domain = space.vector, space.cell_vector, space.Domain
    Lane, Sums = space.Lane, space.Sums
    load_vector = make_wide_load(vector)
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
        """Return first and last + 1 particle of cells' run number `run`; none from `runs` on."""
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
        """Append neighbours among this lane's next candidates to the scratch; return its length."""
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
            total = space.append_number(own.scratch, total, candidate < end and near, candidate)
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
        """Return `sums` plus neighbours' terms of `searching` particles; whole warps call it."""
        world_cell = wp.int32(0)
        cell = cell_vector()
        particle_runs = wp.int32(0)
        if any_in_warp(searching):
            index = load_integer(sorted_cell, own.k)
            local = wp.int32(wp.uint32(index) % wp.uint32(domain.cell_count))
            world_cell = index - local
            cell = space.cell_at(domain, local)
            particle_runs = wp.where(searching, space.segment_count(domain, cell), wp.int32(0))
        # A warp goes through all its particles' runs of cells side by side; `next_run` is the next
        # one of `warp_runs`. Each lane looks up one of its particle's next runs, from `lane_begin`
        # to before `lane_end`. Of the current run, which ends before `end`, a lane tests every
        # `lanes`-th particle, next `candidate`.
        warp_runs = largest_in_warp(particle_runs)
        next_run = wp.int32(0)
        lane_begin = wp.int32(0)
        lane_end = wp.int32(0)
        candidate = own.lane
        end = wp.int32(0)
        # A round fills the scratch from `begin` to before `count`. The next round leaves as many
        # entries free as this one has beyond a multiple of the lanes: a neighbour's lane then
        # depends only on its index, not on the warp's other particles.
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
                crowded = any_in_warp(count > wp.static(SCRATCH_ENTRIES - ahead * lanes))
                filling = unfinished and not crowded
            sums = weigh_searched(domain, records, state_index, begin, count, own, sums)
            sums = add_states(own, count, sums)
            begin = count & wp.static(lanes - 1)
        return sums

    return add_searched


@cached_under_lock()
def listed_perception(variant: PerceptionVariant) -> wp.Kernel:
    """Return the perception kernel for neighbour lists, with these options."""
    space_dim, lanes, teams = variant.space_dim, variant.lanes, variant.teams
    state_gradient, moment_correction = variant.state_gradient, variant.moment_inverse is not None
    grouped, capacity, for_adjoint = variant.grouped, variant.capacity, variant.for_adjoint
    width, lane_width, team = variant.width, variant.lane_width, CUDA_LANES
    space = scratch_functions(variant, thread_types(variant))
    scalar, vector, lane_channels, Domain = space.scalar, space.vector, space.group, space.Domain
    registers = PERCEIVE_REGISTERS[space_dim] if teams == 1 else TEAM_REGISTERS
    load_vector = make_wide_load(vector)
    add_vector = make_lane_sum(vector, lanes, whole_warps=True)
    add_square = make_lane_sum(space.square, lanes, whole_warps=True)
    add_f64 = make_lane_sum(space.vector_f64, lanes, whole_warps=True)
    add_channels = make_lane_sum(lane_channels, lanes, whole_warps=True, stride=team)
    add_gradient = make_lane_sum(space.group_gradient, lanes, whole_warps=True, stride=team)
    corrected = make_corrected(space_dim, scalar, lane_width, variant.moment_inverse)
    weighing = weighing_functions(variant, space)
    add_states = make_add_states(variant, space)
    add_searched = make_add_searched(variant, space, weighing.weigh_searched, add_states)
    scaling = scaling_functions(space)

    @wp.kernel(module=variant.module(), cuda_max_registers=registers, grid_stride=False)
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
        rows: wp.array2d[scalar],
    ):
        """Write the perception vector of each active particle, as the portable kernel does.

        A launch has a thread for each row, channel group and lane, in complete warps. `state_index`
        has the index of each sorted particle's state, if it is empty the same index; in 2D it is in
        `records`. Row k is written to row `row_destination[k]`, if that is empty to row k. Numbers
        are clipped to plus and minus `limit` unless it is 0.
        """
        wait_for_previous_kernel()
        thread = thread_number()
        lane = thread & wp.static(lanes - 1)
        row = thread >> wp.static(lanes.bit_length() - 1)
        g = wp.int32(0)
        if wp.static(grouped):
            g = row % group_count
            row = row / group_count
        own = space.Lane()
        own.lane = lane
        own.scratch = space.scratch_address()
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
        own_place = wp.where(row < row_capacity, row, wp.int32(-1))
        destination = own_place
        if row_destination.shape[0] > 0:
            destination = wp.where(present, load_integer(row_destination, safe_row), destination)
        own_index = k
        if state_index.shape[0] > 0:
            own_index = load_integer(state_index, k)
        own.k = k
        own.states = space.part_address(states, part)
        own.state = space.part_of_state(own.states, own.part_count, own_index)
        own.position = load_vector(sorted_positions, k)
        for d in range(wp.static(space_dim)):
            own.precise[d] = wp.float64(own.position[d])
        own.inverse_eps = wp.float64(domain.inverse_eps)
        list_number = safe_row
        if wp.static(variant.per_particle):
            list_number = k
        length = wp.where(present, load_integer(list_lengths, list_number), wp.int32(0))
        unlisted = length > wp.static(capacity)
        length = wp.where(unlisted, wp.int32(0), length)
        longest = largest_in_warp(length)
        sums = space.Sums()
        pair = weighing.pair_at(lists, list_number, lane)
        for begin in range(0, longest, wp.static(SCRATCH_ENTRIES)):
            pair, sums = weighing.weigh_listed(
                domain, records, lists, state_index, list_number, begin, length, own, pair, sums
            )
            count = wp.clamp(length - begin, 0, wp.static(SCRATCH_ENTRIES))
            sums = add_states(own, count, sums)
        sums = add_searched(
            domain, starts, sorted_cell, sorted_positions, records, state_index, unlisted, own, sums
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
        stage(own.scratch, channel, wp.where(present, own.state, lane_channels()))
        stage(own.scratch, wp.static(width) + channel, smoothed)
        if wp.static(state_gradient):
            scaled = scaling.scaled_gradient(gradient_scale, gradient)
            stage(own.scratch, wp.static(2 * width) + channel * wp.static(space_dim), scaled)
        bound = wp.where(limit > scalar(0.0), limit, scalar(wp.static(math.nan)))
        space.write_rows(own.scratch, destination, g, state_dim, bound, perception)
        if wp.static(variant.twice):
            space.write_rows(own.scratch, own_place, g, state_dim, bound, rows)
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
                    if wp.static(variant.twice):
                        rows[row, column + d] = along[d]
            column += wp.static(space_dim)
        if column < perception.shape[1] and destination >= 0 and g == 0:
            for padding in range(column + lane, perception.shape[1], wp.static(lanes)):
                perception[destination, padding] = wp.where(
                    padding == column and present, scalar(1.0), scalar(0.0)
                )

    return perceive
