"""Density on CUDA in float32; the same pass lists neighbours for perception.

`listed_density`: one thread finds a particle's neighbours with far fewer instructions than several,
which would have to agree on positions in the list. A list has the differences of sorted indices
from the particle to its neighbours, in 16 bits. It is made in shared memory and written to an array
in which the lists of 32 particles are interleaved, two entries at a time.

`tiled_density`, for small worlds in 2D: a warp serves a tile of eight consecutive particles, whose
lists are stored one after the other. They are in one or two lines of cells, so most candidates are
the same, and the warp copies these into shared memory once. Each of a particle's four lanes (the
threads that share it) tests every fourth candidate: ten instructions, without addresses or ends of
runs. It stores the results as bits, from which lists are made afterwards. That halves the time for
few particles with many neighbours. In sparse worlds tiles share few candidates, and worlds that
fill a GPU need only a thread for each particle. Worlds have at most 2^15 particles.
"""

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import SLACK, TERMS_PER_SUM, domain_types, kernel_module
from npa_envs.kernels.lanes_and_memory import (
    WARP,
    as_word,
    load_integer,
    make_lane_sum,
    make_wide_load,
    thread_number,
    wait_for_previous_kernel,
    wide_store,
)
from npa_envs.kernels.mathematics import falloff_within, smoothing_of

AHEAD, SHARED_AHEAD = 6, 5
"""Candidates that a thread loads at a time: if a particle has one thread, and if it has several."""

LIST_BLOCK = 64
"""Threads of a block: few, as their lists have to fit into shared memory."""

LIST_REGISTERS, TILE_REGISTERS = 80, 64
"""Registers per thread of `listed_density` (with the default, half as many, loads come singly) and
of `tiled_density`, for 32 warps on a multiprocessor."""

RECORD = wp.types.vector(4, wp.float32)
"""A neighbour's data for perception: position, volume, and in 2D the index of its state."""

MAX_STEP = wp.constant(2**15 - 1)
"""Largest difference of sorted indices in a list: its entries have 16 bits."""

SHARE_OF_LIST = 2
"""Room for the entries of each of several lanes, as a multiple of an equal part of a list."""

LIST_END = wp.types.vector(2, wp.uint32)
"""Address of a list's next entry, and the distance [bytes] from it to the one after."""

TILE_PARTICLES, TILE_LANES, MIN_SIDE = native.constants(
    "cuda/density.cuh", "TILE_PARTICLES", "TILE_LANES", "MIN_SIDE"
)
"""Particles of a tile, lanes of a warp that share one, and cells along each side of the smallest
periodic box that is divided into tiles."""


@cached_under_lock()
def listed_density(
    space_dim: int, lanes: int, periodic: bool, capacity: int, masked: bool
) -> wp.Kernel:
    """Return the kernel that computes densities and lists neighbours, `lanes` threads per particle.

    `capacity` is the maximum length of a list. If `masked`, only active particles get lists. With
    several lanes, launches have complete warps, whose threads write lists together.
    """
    scalar = wp.float32
    flat = space_dim == 2
    space = domain_types(space_dim, scalar)
    vector, particle, Domain = space.vector, space.particle, space.Domain
    load_vector = make_wide_load(vector)
    add_scalar = make_lane_sum(scalar, lanes)
    many = AHEAD if lanes == 1 else SHARED_AHEAD
    positions_ahead = wp.types.matrix((many, space_dim), scalar)
    room = min(capacity, SHARE_OF_LIST * capacity // lanes)

    list_address = native.function("list_address", room, many, LIST_BLOCK, returns=wp.uint32)
    list_end_of = native.function(
        "list_end_of", LIST_BLOCK, address=wp.uint32, entries=int, returns=LIST_END
    )
    append_step = native.function(
        "append_step", LIST_BLOCK, end=LIST_END, weight=float, step=int, returns=LIST_END
    )
    bounds = {"address": wp.uint32, "end": LIST_END}
    cut_off = native.function("cut_off", room, LIST_BLOCK, **bounds, returns=LIST_END)
    sizes = room, LIST_BLOCK, capacity, lanes
    lists_type = wp.array3d[wp.int16]
    leave_list = native.function(
        "leave_list", *sizes, **bounds, row=int, lists=lists_type, returns=int
    )

    @wp.func
    def falloff_at(domain: Domain, offset: vector):
        """Return 1 - r^2 / eps^2 for an offset r, 0 beyond eps."""
        nearest = offset
        if wp.static(periodic):
            nearest = space.periodic_image(domain, nearest)
        squared = wp.dot(nearest, nearest)
        return falloff_within(squared, domain.inverse_squared_eps)

    @wp.func
    def cells_beyond(within_cell: vector, line: int):
        """Return the numbers of cells beyond eps at the beginning and at the end of a line of five.

        The five lines around a particle have numbers 0 to 4; the particle is in line 2.
        `within_cell` is its position in its cell, in units of a cell.
        """
        across = wp.where(
            line < 2, within_cell[1] + scalar(1 - line), scalar(line - 2) - within_cell[1]
        )
        across = wp.where(line == 2, scalar(0.0), across)
        along = wp.sqrt(wp.max(scalar(wp.static(4.0 * SLACK)) - across * across, scalar(0.0)))
        first = wp.int32(wp.floor(within_cell[0] - along))
        last = wp.int32(wp.floor(within_cell[0] + along))
        return wp.max(first + 2, 0), wp.max(2 - last, 0)

    options = {"lanes": lanes, "periodic": periodic, "capacity": capacity, "masked": masked}
    module = kernel_module("listed_density", space_dim, scalar, **options)

    @wp.kernel(module=module, cuda_max_registers=LIST_REGISTERS, grid_stride=False)
    def compute_density(
        domain: Domain,
        starts: wp.array[wp.int32],
        sorted_cell: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        state_index: wp.array[wp.int32],
        original_index: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        # outputs
        particles: wp.array[particle],
        records: wp.array[RECORD],
        lists: wp.array3d[wp.int16],
        list_lengths: wp.array[wp.int32],
    ):
        """Write each particle's position and volume 1 / ρ, and neighbour lists of active ones.

        Positions and volumes go to `records`, in 2D with the index of the particle's state, and to
        `particles` unless it is empty. Of a list beyond the capacity only the length is written.
        """
        wait_for_previous_kernel()
        thread = wp.tid()
        k = thread >> wp.static(lanes.bit_length() - 1)
        lane = thread & wp.static(lanes - 1)
        inside = k < sorted_positions.shape[0]
        k = wp.where(inside, k, wp.int32(0))
        position = load_vector(sorted_positions, k)
        index = load_integer(sorted_cell, k)
        local = wp.int32(wp.uint32(index) % wp.uint32(domain.cell_count))
        base = index - local
        cell = space.cell_at(domain, local)
        row = k
        if wp.static(masked):
            row = load_integer(row_of, load_integer(original_index, k))
        row = wp.where(inside and row < list_lengths.shape[0], row, wp.int32(-1))
        list_begin = list_address()
        # A particle without a row is treated as if its list were too long.
        list_end = list_end_of(list_begin, wp.where(row < 0, wp.static(room + 2), 0))
        far = wp.bool(False)
        earlier = scalar(0.0)
        total = scalar(0.0)
        segments = space.segment_count(domain, cell)
        within_cell = vector()
        if wp.static(flat and not periodic):
            for d in range(wp.static(space_dim)):
                scaled = wp.float64(position[d]) * domain.cell_scale[d]
                within_cell[d] = scalar(scaled - wp.floor(scaled))
        for segment in range(segments):
            first, last = space.segment_cells(domain, cell, segment)
            # Five lines of five cells each, without wrapping around the grid.
            if wp.static(flat and not periodic) and segments == 5 and domain.cells_per_eps == 2:
                before, behind = cells_beyond(within_cell, segment)
                first += before
                last -= behind
            begin = load_integer(starts, base + first)
            end = load_integer(starts, base + last)
            far = far or (begin < end and wp.max(k - begin, end - k) > MAX_STEP)
            j = begin + lane
            # Candidates j to `end`; while `crowded`, terms after `stop` get a new sum.
            crowded = wp.bool(True)
            while crowded:
                stop = end
                crowded = wp.bool(False)
                if wp.static(lanes == 1):
                    # Worlds whose particles have several threads are smaller.
                    stop = wp.min(end, j + wp.static(TERMS_PER_SUM))
                    crowded = stop < end
                # `ahead`: positions, all loaded before the first is used.
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
            # The rest, fewer than `many`: those from `end` on count 0.
            if j < end:
                ahead = positions_ahead()
                for a in range(wp.static(many - 1)):
                    candidate = wp.min(j + a * wp.static(lanes), end - 1)
                    ahead[a] = load_vector(sorted_positions, candidate)
                for a in range(wp.static(many - 1)):
                    candidate = j + a * wp.static(lanes)
                    falloff = falloff_at(domain, ahead[a] - position)
                    falloff = wp.where(candidate < end, falloff, scalar(0.0))
                    list_end = append_step(list_end, falloff, candidate - k)
                    total += smoothing_of(falloff, scalar(1.0))
                list_end = cut_off(list_begin, list_end)
        # Its own term is added without a search, so that rho is not 0 for positions that are NaN.
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
                if state_index.shape[0] > 0:
                    number = load_integer(state_index, k)
                record[3] = as_word(number)
            wide_store(records, k, record)

    return compute_density


@cached_under_lock()
def tiled_density(periodic: bool, capacity: int, masked: bool) -> wp.Kernel:
    """Return the kernel that computes densities and lists neighbours in 2D, a warp for 8 particles.

    `capacity` is the maximum length of a list. If `masked`, only active particles get lists.
    """
    space = domain_types(2, wp.float32)
    vector, particle, Domain = space.vector, space.particle, space.Domain
    load_vector, integers = make_wide_load(vector), wp.array[wp.int32]
    cells = {"starts": integers, "sorted_cell": integers, "sorted_positions": wp.array[vector]}
    place = {"base": int, "first": int, "k": int, "inside": bool, "row": int}
    arguments = {"domain": Domain, **cells, **place, "lists": wp.array3d[wp.int16]}
    arguments["list_lengths"] = integers
    density_of_tile = native.function(
        "density_of_tile", capacity, periodic, **arguments, returns=float
    )
    options = {"periodic": periodic, "capacity": capacity, "masked": masked}
    module = kernel_module("tiled_density", 2, wp.float32, **options)

    @wp.kernel(module=module, cuda_max_registers=TILE_REGISTERS, grid_stride=False)
    def compute_density(
        domain: Domain,
        particle_count: int,
        starts: wp.array[wp.int32],
        sorted_cell: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        state_index: wp.array[wp.int32],
        original_index: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        # outputs
        particles: wp.array[particle],
        records: wp.array[RECORD],
        lists: wp.array3d[wp.int16],
        list_lengths: wp.array[wp.int32],
    ):
        """Write positions, volumes and lists as `listed_density` does; each list is contiguous."""
        wait_for_previous_kernel()
        thread = thread_number()
        tile = thread >> wp.static(WARP.bit_length() - 1)
        lane = thread & wp.static(WARP - 1)
        tiles = (particle_count + wp.static(TILE_PARTICLES - 1)) / wp.static(TILE_PARTICLES)
        world = wp.int32(wp.uint32(tile) / wp.uint32(tiles))
        # Each world begins with a new tile, so its sums are the same in every batch.
        first = world * particle_count + (tile - world * tiles) * wp.static(TILE_PARTICLES)
        k = first + lane / wp.static(TILE_LANES)
        inside = k < (world + 1) * particle_count
        k = wp.where(inside, k, first)
        row = k
        if wp.static(masked):
            row = load_integer(row_of, load_integer(original_index, k))
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
            # Its own term is added without a search, so that rho is not 0 for NaN.
            volume = 1.0 / (domain.smoothing_norm * wp.max(total, 1.0))
            if particles.shape[0] > 0:
                particles[k] = particle(position[0], position[1], volume)
            number = k
            if state_index.shape[0] > 0:
                number = load_integer(state_index, k)
            record = RECORD(position[0], position[1], volume, as_word(number))
            wide_store(records, k, record)

    return compute_density
