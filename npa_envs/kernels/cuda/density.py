"""Density on CUDA in float32, and on the way to it lists of neighbours, for perception.

One thread of a particle finds its neighbours with far fewer instructions than several that must
agree on where they are in a list. A list holds the steps to neighbours in the sorted order, in 16
bits. It is gathered in fast memory and left in an array: 32 particles together, their first two
entries first. It has room for so many; of a longer one, only the length is known.

In small worlds in 2D a warp serves eight particles side by side, a tile, whose lists lie one behind
the other. They lie in one line of cells or two, so most of their candidates are the same. The warp
brings these into fast memory once. Four lanes of a particle then test every fourth of them: a test
takes ten instructions, no address is computed, and no end of a run of cells looked at. Whom a lane
has found near stands in the bits of a word, of which lists are made afterwards. It takes half the
time where neighbours are many and particles few. In sparse worlds tiles share few candidates, and
in worlds that fill a device a thread for each particle does as well. Worlds have at most 2^15
particles: steps of lists have 16 bits.
"""

import warp as wp

from npa_envs.kernels import native
from npa_envs.kernels.access import (
    WARP,
    as_word,
    await_earlier,
    load_integer,
    make_lane_sum,
    make_wide_load,
    make_wide_store,
    thread_number,
)
from npa_envs.kernels.domain import SLACK, TERMS_PER_SUM, domain_types, kernel_module
from npa_envs.kernels.mathematics import falloff_within, smoothing_of
from npa_envs.once import made_once

AHEAD, SHARED_AHEAD = 6, 5
"""Candidates that a thread looks at together: alone with a particle, and one of several lanes."""

LIST_BLOCK = 64
"""Threads of a block, few: one has fast memory for the lists of all of them."""

CUDA_REGISTERS = 80
"""Registers of a thread: told of none, the compiler takes half as many and loads one by one."""

RECORD = wp.types.vector(4, wp.float32)
"""What perception reads of a neighbour: position, volume, and in 2D where its state is."""

LONGEST_STEP = wp.constant(2**15 - 1)
"""Steps of a list's entry have 16 bits."""

SHARE_OF_LIST = 2
"""A lane of several has room for so many times its share of a list."""

LIST_END = wp.types.vector(2, wp.uint32)
"""Where the next entry of a list goes, and how far it is from there to the one after it."""

TILE = 8
"""Particles of a tile."""

TILE_LANES = WARP // TILE
"""Lanes of a warp that share a particle."""

SMALLEST_SIDE = 7
"""Cells along each side of the smallest periodic box: in smaller ones the images of a particle that
are nearest to its tile's particles may differ."""

TILE_REGISTERS = 64
"""Registers of a thread: 32 warps of a processor."""

store_record = make_wide_store(RECORD, wp.float32)


@made_once()
def listed_density(
    space_dim: int, lanes: int, periodic: bool, capacity: int, masked: bool
) -> wp.Kernel:
    """Return the density kernel of one variant.

    Launches of several lanes a particle come in whole warps, which leave their lists together.
    """
    scalar = wp.float32
    flat = space_dim == 2
    types = domain_types(space_dim, scalar)
    vector, particle, Domain = types.vector, types.particle, types.Domain
    cell_place, segment_count, segment_cells = (
        types.cell_place,
        types.segment_count,
        types.segment_cells,
    )
    periodic_image = types.periodic_image
    load_vector = make_wide_load(vector, scalar)
    add_scalar = make_lane_sum(scalar, scalar, lanes)
    many = AHEAD if lanes == 1 else SHARED_AHEAD
    positions_ahead = wp.types.matrix((many, space_dim), scalar)
    room = min(capacity, SHARE_OF_LIST * capacity // lanes)

    @native.func_native(room, many, LIST_BLOCK)
    def list_address() -> wp.uint32: ...

    @native.func_native(LIST_BLOCK)
    def list_end_of(address: wp.uint32, entries: wp.int32) -> LIST_END: ...

    @native.func_native(LIST_BLOCK)
    def append_step(end: LIST_END, weight: wp.float32, step: wp.int32) -> LIST_END: ...

    @native.func_native(room, LIST_BLOCK)
    def cut_off(address: wp.uint32, end: LIST_END) -> LIST_END: ...

    @native.func_native(room, LIST_BLOCK, capacity, lanes)
    def leave_list(
        address: wp.uint32,
        list_end: LIST_END,
        row: wp.int32,
        lists: wp.array(dtype=wp.int16, ndim=3),
    ) -> wp.int32: ...

    @wp.func
    def falloff_at(domain: Domain, offset: vector):
        """1 - r^2 / eps^2 of a candidate, 0 beyond eps."""
        nearest = offset
        if wp.static(periodic):
            nearest = periodic_image(domain, nearest)
        squared = wp.dot(nearest, nearest)
        return falloff_within(squared, domain.inverse_squared_eps)

    @wp.func
    def cells_beyond(within_cell: vector, line: wp.int32):
        """How many of the five cells of a line nobody near lies in: the first ones, the last ones.

        `within_cell` is where the particle lies in its cell, in parts of it; lines count from 0,
        the particle's own is 2.
        """
        across = wp.where(
            line < 2, within_cell[1] + scalar(1 - line), scalar(line - 2) - within_cell[1]
        )
        across = wp.where(line == 2, scalar(0.0), across)
        along = wp.sqrt(wp.max(scalar(wp.static(4.0 * SLACK)) - across * across, scalar(0.0)))
        first = wp.int32(wp.floor(within_cell[0] - along))
        last = wp.int32(wp.floor(within_cell[0] + along))
        return wp.max(first + 2, 0), wp.max(2 - last, 0)

    topic = "listed_density" + "_in_box" * periodic + f"_{capacity}" + "_of_rows" * masked

    @wp.kernel(
        enable_backward=False,
        module=kernel_module(topic, space_dim, scalar, 0, lanes),
        cuda_max_registers=CUDA_REGISTERS,
        grid_stride=False,
    )
    def compute_density(
        domain: Domain,
        starts: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        state_place: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.int32),
        row_of: wp.array(dtype=wp.int32),
        # outputs
        particles: wp.array(dtype=particle),
        records: wp.array(dtype=RECORD),
        lists: wp.array(dtype=wp.int16, ndim=3),
        list_lengths: wp.array(dtype=wp.int32),
    ):
        """Write every particle's record, and the list of each row's neighbours.

        Positions with volumes 1 / rho also go to `particles`, unless that is empty. A list's length
        is larger than the capacity where not all fits in.
        """
        await_earlier()
        thread = wp.tid()
        k = thread >> wp.static(lanes.bit_length() - 1)
        lane = thread & wp.static(lanes - 1)
        inside = k < sorted_positions.shape[0]
        k = wp.where(inside, k, wp.int32(0))
        position = load_vector(sorted_positions, k)
        index = load_integer(sorted_cell, k)
        local = wp.int32(wp.uint32(index) % wp.uint32(domain.cell_count))
        base = index - local
        cell = cell_place(domain, local)
        row = k
        if wp.static(masked):
            row = load_integer(row_of, load_integer(source, k))
        row = wp.where(inside and row < list_lengths.shape[0], row, wp.int32(-1))
        list_begin = list_address()
        # Of a particle without a row as if it were too long.
        list_end = list_end_of(list_begin, wp.where(row < 0, wp.static(room + 2), 0))
        far = wp.bool(False)
        earlier = scalar(0.0)
        total = scalar(0.0)
        segments = segment_count(domain, cell)
        within_cell = vector()
        if wp.static(flat and not periodic):
            for d in range(wp.static(space_dim)):
                scaled = wp.float64(position[d]) * domain.cell_scale[d]
                within_cell[d] = scalar(scaled - wp.floor(scaled))
        for segment in range(segments):
            first, last = segment_cells(domain, cell, segment)
            # Five lines of five cells each, none of them wrapped around the grid.
            if wp.static(flat and not periodic) and segments == 5 and domain.cell_reach == 2:
                before, behind = cells_beyond(within_cell, segment)
                first += before
                last -= behind
            begin = load_integer(starts, base + first)
            end = load_integer(starts, base + last)
            far = far or (begin < end and wp.max(k - begin, end - k) > LONGEST_STEP)
            j = begin + lane
            crowded = wp.bool(True)
            while crowded:
                stop = end
                crowded = wp.bool(False)
                if wp.static(lanes == 1):
                    # Worlds whose particles have several threads are not as large.
                    stop = wp.min(end, j + wp.static(TERMS_PER_SUM))
                    crowded = stop < end
                # Several positions are asked for before the first is used.
                while j + wp.static((many - 1) * lanes) < stop:
                    ahead = positions_ahead()
                    for a in range(wp.static(many)):
                        ahead[a] = load_vector(sorted_positions, j + a * wp.static(lanes))
                    for a in range(wp.static(many)):
                        step = j + a * wp.static(lanes) - k
                        falloff = falloff_at(domain, ahead[a] - position)
                        list_end = append_step(list_end, falloff, step)
                        total += smoothing_of(falloff, scalar(1.0))
                    list_end = cut_off(list_begin, list_end)
                    j += wp.static(many * lanes)
                if crowded:
                    earlier += total
                    total = scalar(0.0)
            if j < end:
                ahead = positions_ahead()
                for a in range(wp.static(many - 1)):
                    place = wp.min(j + a * wp.static(lanes), end - 1)
                    ahead[a] = load_vector(sorted_positions, place)
                for a in range(wp.static(many - 1)):
                    candidate = j + a * wp.static(lanes)
                    falloff = falloff_at(domain, ahead[a] - position)
                    falloff = wp.where(candidate < end, falloff, scalar(0.0))
                    list_end = append_step(list_end, falloff, candidate - k)
                    total += smoothing_of(falloff, scalar(1.0))
                list_end = cut_off(list_begin, list_end)
        # A particle always sees itself: a position that is not finite would otherwise have rho 0.
        total = wp.max(add_scalar(earlier + total), scalar(1.0))
        length = leave_list(list_begin, list_end, row, lists)
        if lane == 0 and row >= 0:
            list_lengths[row] = wp.where(far, wp.static(capacity + 1), length)
        if lane == 0 and inside:
            entry = particle()
            record = RECORD()
            for d in range(wp.static(space_dim)):
                entry[d] = position[d]
            entry[wp.static(space_dim)] = scalar(1.0) / (domain.smoothing_norm * total)
            if particles.shape[0] > 0:
                particles[k] = entry
            for d in range(wp.static(space_dim + 1)):
                record[d] = entry[d]
            if wp.static(flat):
                number = k
                if state_place.shape[0] > 0:
                    number = load_integer(state_place, k)
                record[3] = as_word(number)
            store_record(records, k, record)

    return compute_density


@made_once()
def make_steps_at(capacity: int, tiled: bool) -> wp.Function:
    """Return a Warp function that reads two steps of a row's list, as the density pass left it."""

    @native.func_native(capacity, tiled)
    def steps_at(
        lists: wp.array(dtype=wp.int16, ndim=3), row: wp.int32, pair: wp.int32
    ) -> wp.int32: ...

    return steps_at


@native.func_native()
def step_of(steps: wp.int32, entry: wp.int32) -> wp.int32:
    """The first or the second of two steps."""


@made_once()
def tiled_density(periodic: bool, capacity: int, masked: bool) -> wp.Kernel:
    """Return the density kernel of one variant. A block is a warp, and serves a tile."""
    types = domain_types(2, wp.float32)
    vector, particle, Domain = types.vector, types.particle, types.Domain
    load_vector = make_wide_load(vector, wp.float32)

    @native.func_native(capacity, periodic, TILE, SMALLEST_SIDE)
    def density_of_tile(
        domain: Domain,
        starts: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        base: wp.int32,
        first: wp.int32,
        k: wp.int32,
        inside: wp.bool,
        row: wp.int32,
        lists: wp.array(dtype=wp.int16, ndim=3),
        list_lengths: wp.array(dtype=wp.int32),
    ) -> wp.float32: ...

    topic = "tiled_density" + "_in_box" * periodic + f"_{capacity}" + "_of_rows" * masked

    @wp.kernel(
        enable_backward=False,
        module=kernel_module(topic, 2, wp.float32),
        cuda_max_registers=TILE_REGISTERS,
        grid_stride=False,
    )
    def compute_density(
        domain: Domain,
        particle_count: wp.int32,
        starts: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        state_place: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.int32),
        row_of: wp.array(dtype=wp.int32),
        # outputs
        particles: wp.array(dtype=particle),
        records: wp.array(dtype=RECORD),
        lists: wp.array(dtype=wp.int16, ndim=3),
        list_lengths: wp.array(dtype=wp.int32),
    ):
        """Write what `listed_density` writes, but each list as a whole, one behind the other."""
        await_earlier()
        thread = thread_number()
        tile = thread >> wp.static(WARP.bit_length() - 1)
        lane = thread & wp.static(WARP - 1)
        tiles = (particle_count + wp.static(TILE - 1)) / wp.static(TILE)
        world = wp.int32(wp.uint32(tile) / wp.uint32(tiles))
        # Tiles begin anew in each world: its sums are the same in every batch.
        first = world * particle_count + (tile - world * tiles) * wp.static(TILE)
        k = first + lane / wp.static(TILE_LANES)
        inside = k < (world + 1) * particle_count
        k = wp.where(inside, k, first)
        row = k
        if wp.static(masked):
            row = load_integer(row_of, load_integer(source, k))
        row = wp.where(inside and row < list_lengths.shape[0], row, wp.int32(-1))
        total = density_of_tile(
            domain,
            starts,
            sorted_cell,
            sorted_positions,
            world * domain.cell_count,
            first,
            k,
            inside,
            row,
            lists,
            list_lengths,
        )
        if inside and lane % wp.static(TILE_LANES) == 0:
            position = load_vector(sorted_positions, k)
            # A particle always sees itself: a position that is not finite would have rho 0.
            volume = 1.0 / (domain.smoothing_norm * wp.max(total, 1.0))
            if particles.shape[0] > 0:
                particles[k] = particle(position[0], position[1], volume)
            number = k
            if state_place.shape[0] > 0:
                number = load_integer(state_place, k)
            record = RECORD(position[0], position[1], volume, as_word(number))
            store_record(records, k, record)

    return compute_density
