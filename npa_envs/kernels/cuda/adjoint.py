"""Backward pass of perception, for states, on CUDA in float32, by tiles of particles.

The sums are those of the portable `gather_state_cotangents`, in another order. A warp serves
eight consecutive particles of the sorted order: it lists the rows within eps of their bounding box,
and multiplies the rows' cotangents by the weights of all eight on tensor cores. So a row's
cotangents are read once for eight particles.
Names: `x_bar` = dL/dx, the gradient of the loss L with respect to x.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import SLACK, TERMS_PER_SUM, group_types, kernel_module
from npa_envs.kernels.lanes_and_memory import (
    CUDA_BLOCK,
    WARP,
    allow_next_launch,
    any_in_warp,
    as_word,
    first_in_warp,
    largest_in_warp,
    load_integer,
    load_scalar,
    make_wide_load,
    of_warp,
    scalar_of_warp,
    sum_up_to,
    thread_of,
    vote_of_warp,
    wait_for_previous_kernel,
    wide_store,
)

TILE_PARTICLES = 8
"""Particles that a warp serves together, and rows of one matrix product."""

LIST_ENTRIES = 96
"""Rows of a full list; more rows are summed in several rounds."""

ENTRY = FOUR_CHANNELS = wp.types.vector(4, wp.float32)
"""A listed row: the position of its particle, last the index of its channels; or four channels."""

STATE_REGISTERS = 64
"""Registers per thread of `gather_state_cotangents`."""

THREAD_CHANNELS = 4
"""Adjacent channels of a row whose gradients one thread of `unscale_cotangents` computes."""

MAX_LENGTH = 3.4028234663852886e38
"""The largest float32, a bound on any coordinate [length units]."""

load_channels = make_wide_load(FOUR_CHANNELS)

row_list_address = native.function(
    "row_list_address", CUDA_BLOCK // WARP, LIST_ENTRIES, returns=wp.uint32
)
"""The address in shared memory of this warp's list of nearby rows."""


@cached_under_lock()
def make_read_columns(count: int) -> Any:
    """Return a Warp function that reads `count` adjacent columns of a row; 0 from `end` on."""
    place = {"values": wp.array2d[wp.float32], "row": int, "column": int, "end": int}
    result_type = wp.types.vector(count, wp.float32)
    return native.function("read_columns", count, **place, returns=result_type)


read_channels = make_read_columns(THREAD_CHANNELS)

write_columns = native.function("write_columns", untyped="values row column numbers")
"""Write four adjacent numbers of a matrix row, except those beyond its end."""

append_entry = native.function(
    "append_entry", address=wp.uint32, count=int, accepted=bool, entry=ENTRY, returns=int
)
"""Append the entries of threads with `accepted` to a list of `count`; return its new length."""

pad_list = native.function("pad_list", address=wp.uint32, count=int, entry=ENTRY, returns=int)
"""Pad a list of `count` entries with `entry` to a multiple of 8; return its new length."""

keep_unsummed = native.function("keep_unsummed", untyped="address summed_count count")
"""Move a list's entries from `summed_count` to `count`, at most seven, to its beginning."""

prefetch_columns = native.function("prefetch_columns", untyped="values row column")
"""Load the memory at a row and column of a matrix into the L2 cache, for a later read."""

regroup_tile = native.function("regroup_tile", total=FOUR_CHANNELS, returns=FOUR_CHANNELS)
"""Exchange sums between threads: from two channels of two particles to four channels of one."""

smallest_in_tile = native.function("smallest_in_tile", value=float, returns=float)
"""The smallest value among a warp's 8 particles, each of which has four threads."""


def row_search(space: SimpleNamespace, periodic: bool) -> SimpleNamespace:
    """Return the functions that find rows near 8 particles: by runs of cells, then by distance."""
    space_dim, scalar, Domain = space.space_dim, space.scalar, space.Domain
    vector, cell_vector = space.vector, space.cell_vector

    @wp.func
    def line_of(domain: Domain, cell: cell_vector):
        """Return the index of the line of cells, along the first axis, that contains a cell."""
        line = cell[1]
        if wp.static(space_dim == 3):
            line += cell[wp.static(space_dim - 1)] * domain.cell_shape[1]
        return line

    @wp.func
    def run_cells(domain: Domain, line: int, begin: int, end: int, run: int):
        """Return the first and last + 1 cell (row-major index) of run number `run` around `line`.

        A line is a row of cells along x. Columns `begin` to before `end` of each line within eps of
        `line` are one run of adjacent cells, or two runs if they wrap around the grid.
        """
        nx = domain.cell_shape[0]
        first = begin
        last = end
        number = run
        if end > nx:
            number = run >> 1
            first = wp.where((run & 1) == 0, begin, 0)
            last = wp.where((run & 1) == 0, nx, end - nx)
        base = wp.int32(0)
        y = line
        if wp.static(space_dim == 3):
            z = wp.int32(wp.uint32(line) / wp.uint32(domain.cell_shape[1]))
            y = line - z * domain.cell_shape[1]
            lines = space.cells_around(domain, 1)
            across = wp.int32(wp.uint32(number) / wp.uint32(lines))
            number -= across * lines
            z = space.wrapped(
                z - domain.cells_per_eps + across, domain.cell_shape[wp.static(space_dim - 1)]
            )
            base = z * domain.cell_shape[1]
        base = (base + space.wrapped(y - domain.cells_per_eps + number, domain.cell_shape[1])) * nx
        return base + first, base + last

    @wp.func
    def columns_around(domain: Domain, first: int, last: int):
        """Return the first and last + 1 column of cells within eps of columns `first` to `last`.

        The last one may lie beyond the grid, which then wraps around.
        """
        nx = domain.cell_shape[0]
        width = wp.min(last - first + 2 * domain.cells_per_eps + 1, nx)
        begin = wp.where(width < nx, space.wrapped(first - domain.cells_per_eps, nx), 0)
        return begin, begin + width

    @wp.func
    def count_runs(domain: Domain, to_column: int):
        """Return how many runs of adjacent cells `run_cells` has, with `to_column` as its `end`."""
        runs = space.cells_around(domain, 1)
        if wp.static(space_dim == 3):
            runs *= space.cells_around(domain, wp.static(space_dim - 1))
        return wp.where(to_column > domain.cell_shape[0], 2 * runs, runs)

    @wp.func
    def box_around(domain: Domain, position: vector, origin: vector, served: bool):
        """Return centre (from `origin`) and half sides of the box around `served` particles."""
        relative = position - origin
        if wp.static(periodic):
            relative = space.periodic_image(domain, relative)
        middle = vector()
        half = vector()
        for d in range(wp.static(space_dim)):
            low = smallest_in_tile(wp.where(served, relative[d], scalar(MAX_LENGTH)))
            high = -smallest_in_tile(wp.where(served, -relative[d], scalar(MAX_LENGTH)))
            middle[d] = scalar(0.5) * (low + high)
            half[d] = scalar(0.5) * (high - low)
        return middle, half

    @wp.func
    def near_box(domain: Domain, offset: vector, half: vector):
        """Return whether a point is within eps of a box; `offset`: from its centre."""
        nearest = offset
        if wp.static(periodic):
            nearest = space.periodic_image(domain, nearest)
        squared = scalar(0.0)
        for d in range(wp.static(space_dim)):
            beyond = wp.max(wp.abs(nearest[d]) - half[d], scalar(0.0))
            squared += beyond * beyond
        return squared < scalar(SLACK) * domain.squared_eps

    @wp.func
    def row_entry(position: vector, number: int):
        """Return a row's list entry: its particle's position, and `number`, its first index."""
        entry = ENTRY()
        for d in range(wp.static(space_dim)):
            entry[d] = position[d]
        entry[3] = as_word(number)
        return entry

    @wp.func
    def load_position(particles: wp.array[scalar], k: int):
        """Return the position of sorted particle k [length units]."""
        position = vector()
        for d in range(wp.static(space_dim)):
            position[d] = load_scalar(particles, k * wp.static(space_dim + 1) + d)
        return position

    @wp.func
    def is_finite(position: vector):
        finite = wp.bool(True)
        for d in range(wp.static(space_dim)):
            finite = finite and wp.isfinite(position[d])
        return finite

    return native.namespace(locals())


@cached_under_lock()
def listed_adjoint(
    space_dim: int, width: int, state_gradient: bool, periodic: bool, grouped: bool
) -> SimpleNamespace:
    """Return the backward kernels of perception that compute dL/d(states), by name.

    They are for a box if `periodic`, else for open space, and for several groups of `width`
    channels if `grouped`. The cotangents of a row's perception of a group are contiguous, [1 + D,
    width]: of the smoothed state, then of the state gradient. Zeros follow those of the last row.
    """
    options = {"gradient": state_gradient, "periodic": periodic, "grouped": grouped}
    module = kernel_module("listed_adjoint", space_dim, wp.float32, width=width, **options)
    space = group_types(space_dim, wp.float32, width)
    return SimpleNamespace(
        unscale_cotangents=unscaling_kernel(space, module, state_gradient),
        gather_state_cotangents=state_kernel(space, module, state_gradient, periodic, grouped),
    )


def unscaling_kernel(space: SimpleNamespace, module: wp.Module, state_gradient: bool) -> wp.Kernel:
    """Return the kernel that pulls gradients back through the logarithmic scaling."""
    space_dim, scalar, vector = space.space_dim, space.scalar, space.vector
    weight_count, parts = 1 + space_dim * state_gradient, space.width // THREAD_CHANNELS
    thread_gradient = wp.types.matrix((space_dim, THREAD_CHANNELS), scalar)
    vectors = {"scaled": vector, "cotangent": vector}
    log_scale_cotangent = native.function("log_scale_cotangent", **vectors, returns=vector)
    read_gradients = make_read_columns(THREAD_CHANNELS * space_dim)

    @wp.kernel(module=module, grid_stride=False)
    def unscale_cotangents(
        state_dim: int,
        gradient_scale: scalar,
        smoothed_scale: scalar,
        row_base: int,
        row_capacity: int,
        group_count: int,
        starts: wp.array[wp.int32],
        perception: wp.array2d[scalar],
        perception_bar: wp.array2d[scalar],
        bar_row: wp.array[wp.int32],
        # outputs
        cotangents: wp.array[FOUR_CHANNELS],
    ):
        """Write dL/d(smoothed states) times `smoothed_scale`, and dL/d(state gradients)."""
        wait_for_previous_kernel()
        allow_next_launch()
        thread = wp.tid()
        row_parts = group_count * wp.static(parts)
        row = wp.int32(wp.uint32(thread) / wp.uint32(row_parts))
        part = thread - row * row_parts
        channel = part * wp.static(THREAD_CHANNELS)
        entry = row * group_count + part / wp.static(parts)
        index = entry * wp.static(weight_count * parts) + part % wp.static(parts)
        if row == row_capacity and part < wp.static(parts):
            for n in range(wp.static(weight_count)):
                wide_store(cotangents, index + n * wp.static(parts), FOUR_CHANNELS())
        if row < wp.min(load_integer(starts, starts.shape[0] - 1) - row_base, row_capacity):
            from_row = row
            if bar_row.shape[0] > 0:
                from_row = load_integer(bar_row, row)
            column = state_dim + channel
            smoothed = read_channels(perception_bar, from_row, column, 2 * state_dim)
            wide_store(cotangents, index, smoothed_scale * smoothed)
            if wp.static(state_gradient):
                column = 2 * state_dim + channel * wp.static(space_dim)
                end = (2 + wp.static(space_dim)) * state_dim
                scaled = read_gradients(perception, from_row, column, end)
                bars = read_gradients(perception_bar, from_row, column, end)
                gradient_bars = thread_gradient()
                for c in range(wp.static(THREAD_CHANNELS)):
                    value = vector()
                    bar = vector()
                    for d in range(wp.static(space_dim)):
                        value[d] = scaled[c * wp.static(space_dim) + d]
                        bar[d] = bars[c * wp.static(space_dim) + d]
                    gradient_bar = gradient_scale * log_scale_cotangent(value, bar)
                    for d in range(wp.static(space_dim)):
                        gradient_bars[d, c] = gradient_bar[d]
                for d in range(wp.static(space_dim)):
                    wide_store(cotangents, index + (d + 1) * wp.static(parts), gradient_bars[d])

    return unscale_cotangents


def state_kernel(
    space: SimpleNamespace, module: wp.Module, state_gradient: bool, periodic: bool, grouped: bool
) -> wp.Kernel:
    """Return the kernel that computes dL/d(states) from the result of `unscale_cotangents`."""
    space_dim, scalar, width, vector = space.space_dim, space.scalar, space.width, space.vector
    weight_count, parts = 1 + space_dim * state_gradient, width // THREAD_CHANNELS
    load_vector, search = make_wide_load(vector), row_search(space, periodic)
    # Of a warp's 8 particles: the sum of the listed rows' cotangents, weighted by kernels.
    rows = {"address": wp.uint32, "count": int, "domain": space.Domain, "position": vector}
    values = {"channels": wp.array[scalar], "value": FOUR_CHANNELS}
    sizes = space_dim, width, weight_count, periodic
    sum_listed = native.function("sum_listed", *sizes, **rows, **values, returns=FOUR_CHANNELS)

    @wp.kernel(module=module, cuda_max_registers=STATE_REGISTERS, grid_stride=False)
    def gather_state_cotangents(
        domain: space.Domain,
        norm: scalar,
        particle_count: int,
        tile_count: int,
        state_dim: int,
        active_offset: int,
        row_base: int,
        row_capacity: int,
        group_count: int,
        starts: wp.array[wp.int32],
        particles: wp.array[scalar],
        original_index: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        row_positions: wp.array[vector],
        row_kernel_sum: wp.array[vector],
        perception_bar: wp.array2d[scalar],
        bar_row: wp.array[wp.int32],
        cotangents: wp.array[FOUR_CHANNELS],
        flat_cotangents: wp.array[scalar],
        # outputs
        states_bar: wp.array2d[scalar],
    ):
        """Write dL/d(state) of each particle, a sum over the active particles around it.

        A world's particles are `tile_count` tiles of 8; a warp serves a tile and a group of
        channels. `norm` is the normalising constant of the kernels, which multiplies the sum.
        """
        wait_for_previous_kernel()
        allow_next_launch()
        thread = wp.tid()
        lane = thread & wp.static(WARP - 1)
        tile = thread / wp.static(WARP)
        g = wp.int32(0)
        if wp.static(grouped):
            g = tile % group_count
            tile = tile / group_count
        world = wp.int32(wp.uint32(tile) / wp.uint32(tile_count))
        first = world * particle_count + (tile - world * tile_count) * wp.static(TILE_PARTICLES)
        end = wp.min(first + wp.static(TILE_PARTICLES), (world + 1) * particle_count)
        base = active_offset + world * domain.cell_count
        # A thread computes weights for one particle, and at the end writes channels of another.
        k = first + (lane >> 2)
        written = first + 2 * (lane & 3) + ((lane >> 2) & 1)
        part = lane >> 3
        channel = g * wp.static(width) + part * wp.static(THREAD_CHANNELS)
        i = load_integer(original_index, wp.min(written, end - 1))
        position = search.load_position(particles, wp.min(k, end - 1))
        own_row = load_integer(row_of, i)
        from_row = wp.where(bar_row.shape[0] > 0, i, own_row)
        if own_row >= 0 and channel < state_dim:
            prefetch_columns(perception_bar, from_row, channel)
        cell = space.cell_of(domain, position)
        line = search.line_of(domain, cell)
        address = row_list_address()
        total = FOUR_CHANNELS()
        # A position that is not finite has no neighbours.
        waiting = k < end and search.is_finite(position)
        while any_in_warp(waiting):
            # Serve the first particle that is left, and all others on its line of cells.
            leader = first_in_warp(waiting)
            column = of_warp(cell[0], leader)
            middle_line = of_warp(line, leader)
            served = waiting and line == middle_line
            waiting = waiting and line != middle_line
            origin = vector()
            for d in range(wp.static(space_dim)):
                origin[d] = scalar_of_warp(position[d], leader)
            middle, half = search.box_around(domain, position, origin, served)
            last_column = largest_in_warp(wp.where(served, cell[0], 0))
            from_column, to_column = search.columns_around(domain, column, last_column)
            run_count = search.count_runs(domain, to_column)
            votes = vote_of_warp(served) >> wp.uint32(8 * (lane & 3))
            count = wp.int32(0)
            block = wp.int32(0)
            block_sums = FOUR_CHANNELS()
            for first_run in range(0, run_count, wp.static(WARP)):
                run = first_run + lane
                run_begin = wp.int32(0)
                length = wp.int32(0)
                if run < run_count:
                    from_cell, to_cell = search.run_cells(
                        domain, middle_line, from_column, to_column, run
                    )
                    run_begin = load_integer(starts, base + from_cell) - row_base
                    run_end = load_integer(starts, base + to_cell) - row_base
                    length = wp.max(wp.min(run_end, row_capacity) - run_begin, 0)
                run_ends = sum_up_to(length)
                candidates = of_warp(run_ends, wp.static(WARP - 1))
                shift = run_begin - (run_ends - length)
                candidate = wp.int32(lane)
                searching = wp.bool(True)
                while searching:
                    row = candidate + of_warp(shift, thread_of(run_ends, candidate))
                    inside = candidate < candidates
                    other = load_vector(row_positions, wp.where(inside, row, 0))
                    near = search.near_box(domain, (other - origin) - middle, half)
                    entry = search.row_entry(other, row * group_count + g)
                    count = append_entry(address, count, inside and near, entry)
                    candidate += wp.static(WARP)
                    searching = candidate - lane < candidates
                    finished = not searching and first_run + wp.static(WARP) >= run_count
                    if finished or count > wp.static(LIST_ENTRIES - WARP):
                        summed_count = count & ~wp.int32(wp.static(TILE_PARTICLES - 1))
                        if finished:
                            # The entry after the last row is zero.
                            nothing = search.row_entry(origin, row_capacity * group_count)
                            summed_count = pad_list(address, count, nothing)
                        block_sums = sum_listed(
                            address, summed_count, domain, position, flat_cotangents, block_sums
                        )
                        keep_unsummed(address, summed_count, count)
                        count = wp.max(count - summed_count, 0)
                        block += summed_count
                        if finished or block >= wp.static(TERMS_PER_SUM):
                            for n in range(2):
                                if (votes & wp.uint32(1 << (4 * n))) != wp.uint32(0):
                                    total[n] += block_sums[n]
                                    total[n + 2] += block_sums[n + 2]
                            block_sums = FOUR_CHANNELS()
                            block = wp.int32(0)
        total = regroup_tile(total)
        if written < end and part < wp.static(parts) and channel < state_dim:
            volume_index = written * wp.static(space_dim + 1) + wp.static(space_dim)
            bar = (norm * load_scalar(particles, volume_index)) * total
            if own_row >= 0:
                bar += read_channels(perception_bar, from_row, channel, state_dim)
                if wp.static(state_gradient):
                    index = (own_row * group_count + g) * wp.static(weight_count * parts) + part
                    kernel_sum = load_vector(row_kernel_sum, own_row)
                    for d in range(wp.static(space_dim)):
                        bar -= kernel_sum[d] * load_channels(
                            cotangents, index + (d + 1) * wp.static(parts)
                        )
            write_columns(states_bar, i, channel, bar)

    return gather_state_cotangents
