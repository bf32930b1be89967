"""Pictures of 2D worlds, with a small Gaussian for every particle.

A particle at pixel p covers the patch of pixels q with |q - round(p)| <= r in both directions; its
weights exp(-|q - p|^2 / 2 sigma^2) are normalised to sum 1 over the patch, also over pixels outside
the picture. They are products of a row's weight and a column's.

On CUDA n threads gather a tile of pixels: each sums every n-th particle around the tile, and gets a
row of the sums. Particles are sorted by cells, the tiles that contain their patch's centre, with an
origin r pixels before the picture: the particles that cover tiles along a row of cells are then one
contiguous run. Small worlds are sorted by `kernels/cuda/sort.py`. On a CPU a thread draws a
world, particle by particle. Either way the order of a pixel's sum depends only on its own world.
Names: `x_bar` = dL/dx, the gradient of the loss L with respect to x.
"""

import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import (
    load_integer,
    make_lane_sum,
    make_wide_load,
    wait_for_previous_kernel,
    wide_store,
)
from npa_envs.kernels.native_functions import PAIRS, WORLDS, in_ranges, namespace

CHANNELS = 4
"""Channels of a picture: red, green, blue and density."""

TILE_WIDTH, TILE_HEIGHT = 4, 4
"""Pixels along each side of a tile, which `TILE_LANES` CUDA threads gather, and of a cell."""

TILE_LANES = 4
"""CUDA threads that share a tile's candidates, or a particle's gradients; on a CPU it is one."""

RUNS = 3
"""Runs of particles, one for each row of cells, that are gathered as one."""

GATHER_REGISTERS = 128
"""Registers per thread of `gather_splats` in float32, enough for all sums of a tile."""

GROUP_WIDTH, GROUP_HEIGHT = 4, 2
"""Tiles of a group, which one warp gathers."""

FOOTPRINT = 8
"""Entries of a footprint: vector from the particle to the patch's centre, and that centre, in
pixels (2 each); red, green, blue and one, times the weights' common factor (4)."""

PATCH_SIGMAS = 3.0
"""A particle's patch reaches this many standard deviations from its centre."""


@cached_under_lock()
def splat_types(scalar: type) -> SimpleNamespace:
    """Return the `View` struct of sizes, and the vector and matrix types, of one scalar type."""

    @wp.struct
    class View:
        resolution: int
        radius: int
        low: scalar
        pixels_per_length: scalar
        falloff: scalar
        area: scalar
        position_scale: scalar
        tile_columns: int
        tile_rows: int
        cell_columns: int
        cells_across: int
        cells_down: int
        cell_count: int

    return SimpleNamespace(
        View=View,
        vector=wp.types.vector(2, scalar),
        colour=wp.types.vector(CHANNELS, scalar),
        footprint=wp.types.vector(FOOTPRINT, scalar),
        columns=wp.types.vector(TILE_WIDTH, scalar),
        rows=wp.types.vector(TILE_HEIGHT, scalar),
        weights=wp.types.vector(TILE_WIDTH * TILE_HEIGHT, scalar),
        tile=wp.types.matrix((CHANNELS, TILE_WIDTH * TILE_HEIGHT), scalar),
        splat_bar=wp.types.vector(CHANNELS + 2, scalar),
    )


@cached_under_lock(256)
def make_view(
    scalar: type, resolution: int, pixel_size: float, sigma: float, low: float, high: float
) -> Any:
    """Return the `View` of pictures: the sizes that follow from resolution, window and Gaussian.

    A target's pixels have sides of `pixel_size`; the window is [low, high] along both directions,
    and Gaussians have standard deviation `sigma` [length units].
    """
    pixels = resolution * pixel_size / (high - low)
    view = splat_types(scalar).View()
    view.resolution = resolution
    view.radius = radius = math.ceil(PATCH_SIGMAS * sigma * pixels)
    view.low = low
    view.pixels_per_length = (resolution - 1) / (high - low)
    # For powers of two, which the hardware computes.
    view.falloff = 0.5 / (sigma * pixels) ** 2 / math.log(2.0)
    view.position_scale = view.pixels_per_length / (sigma * pixels) ** 2
    view.area = pixels * pixels
    view.tile_columns = -(-resolution // TILE_WIDTH)
    view.tile_rows = -(-resolution // TILE_HEIGHT)
    view.cells_across = (TILE_WIDTH - 1 + 2 * radius) // TILE_WIDTH + 1
    view.cell_columns = view.tile_columns - 1 + view.cells_across
    view.cells_down = (TILE_HEIGHT - 1 + 2 * radius) // TILE_HEIGHT + 1
    # One more, for invisible particles.
    view.cell_count = view.cell_columns * (view.tile_rows - 1 + view.cells_down) + 1
    return view


def gather_registers(scalar: type) -> int | None:
    """Return the maximum number of registers per thread of `gather_splats`; None: no limit."""
    return GATHER_REGISTERS if scalar == wp.float32 else None


def group_count(resolution: int) -> int:
    """Return the number of groups of tiles in a picture; a warp gathers one."""
    across = -(-resolution // (TILE_WIDTH * GROUP_WIDTH))
    return across * -(-resolution // (TILE_HEIGHT * GROUP_HEIGHT))


@cached_under_lock()
def splat_functions(scalar: type) -> SimpleNamespace:
    """Return the functions that several kernels share: positions in pixels, and footprints."""
    types = splat_types(scalar)
    View, vector, colour_type = types.View, types.vector, types.colour
    footprint_type = types.footprint
    fast_exp2 = native.function("fast_exp2", value=scalar, returns=scalar)

    @wp.func
    def patch_weight(falloff: scalar, slope: scalar, offset: scalar):
        """Return a Gaussian along one direction, at offset o [pixels] from the patch's centre.

        It is relative to the value at the centre, so that narrow ones stay finite: with n from the
        particle to the centre, n^2 - (n + o)^2 is -o (2 n + o), and `slope` is -2 n falloff.
        """
        return fast_exp2(offset * (slope - falloff * offset))

    @wp.func
    def pixel_position(view: View, position: vector, mean: vector, goal: wp.array[vector]):
        """Return a position in pixels; with a goal, the world's mean is first moved there."""
        moved = position
        if goal.shape[0] > 0:
            moved = (position - mean) + goal[0]
        return vector(
            (moved[0] - view.low) * view.pixels_per_length,
            (moved[1] - view.low) * view.pixels_per_length,
        )

    @wp.func
    def position_in_world(
        view: View, position: vector, means: wp.array[vector], goal: wp.array[vector], world: int
    ):
        mean = vector()
        if goal.shape[0] > 0:
            mean = means[world]
        return pixel_position(view, position, mean, goal)

    @wp.func
    def patch_centre(position: vector):
        return vector(wp.floor(position[0] + scalar(0.5)), wp.floor(position[1] + scalar(0.5)))

    @wp.func
    def visible(view: View, centre: vector):
        """Return whether the patch around a centre covers a pixel of the picture; False for NaN."""
        begin = -scalar(view.radius)
        end = scalar(view.resolution - 1 + view.radius)
        across = centre[0] >= begin and centre[0] <= end
        return across and centre[1] >= begin and centre[1] <= end

    @wp.func
    def cell_of_centre(view: View, centre: vector):
        """Return the cell of a patch's centre; the last cell if it is invisible."""
        cell = view.cell_count - 1
        if visible(view, centre):
            cell = (wp.int32(centre[1]) + view.radius) / wp.static(TILE_HEIGHT) * view.cell_columns
            cell += (wp.int32(centre[0]) + view.radius) / wp.static(TILE_WIDTH)
        return cell

    @wp.func
    def footprint_of(
        view: View, position: vector, i: int, states: wp.array2d[scalar], shift: scalar
    ):
        """Return a particle's footprint, with its last three states plus `shift` as colours."""
        centre = patch_centre(position)
        near = centre - position
        slope = scalar(-2.0) * view.falloff * near
        sums = vector()
        for o in range(-view.radius, view.radius + 1):
            for d in range(2):
                sums[d] += patch_weight(view.falloff, slope[d], scalar(o))
        factor = view.area / (sums[0] * sums[1])
        result = footprint_type()
        for d in range(2):
            result[d] = near[d]
            result[2 + d] = centre[d]
        for c in range(3):
            result[4 + c] = factor * (states[i, states.shape[1] - 3 + c] + shift)
        result[7] = factor
        return result

    @wp.func
    def footprint_colours(footprint: footprint_type):
        return colour_type(footprint[4], footprint[5], footprint[6], footprint[7])

    return namespace(locals())


@cached_under_lock()
def gather_functions(scalar: type, lanes: int) -> SimpleNamespace:
    """Return functions that sum the particles around a tile, by 1 thread or by one per row."""
    assert lanes in (1, TILE_HEIGHT)
    types, splat = splat_types(scalar), splat_functions(scalar)
    View, footprint_type, tile_type = types.View, types.footprint, types.tile
    columns_type, rows_type, weights_type = types.columns, types.rows, types.weights
    runs_type = wp.types.vector(RUNS, wp.int32)
    load_footprint = make_wide_load(footprint_type)
    # Each lane gets a row of the tile.
    collected_type = wp.types.matrix((CHANNELS, TILE_WIDTH * TILE_HEIGHT // lanes), scalar)
    sizes = collected_type, scalar, CHANNELS, TILE_WIDTH * TILE_HEIGHT, lanes
    collect = native.function("lane_collect", *sizes, value=tile_type, returns=collected_type)
    kept = native.function("kept", value=scalar, returns=scalar)

    @wp.func
    def candidate_count(
        view: View, world: int, tile_row: int, tile_column: int, starts: wp.array[wp.int32]
    ):
        """Return the number of particles in the cells around a tile."""
        first = world * view.cell_count + tile_row * view.cell_columns + tile_column
        total = wp.int32(0)
        for _row in range(view.cells_down):
            total += load_integer(starts, first + view.cells_across) - load_integer(starts, first)
            first += view.cell_columns
        return total

    @wp.func
    def gather_tile(
        view: View,
        world: int,
        tile_row: int,
        tile_column: int,
        lane: int,
        starts: wp.array[wp.int32],
        footprints: wp.array[footprint_type],
    ):
        """Return this thread's pixels of a tile: weighted sums over the particles around it."""
        across = columns_type()
        for c in range(wp.static(TILE_WIDTH)):
            across[c] = kept(scalar(tile_column * wp.static(TILE_WIDTH) + c))
        # Each lane begins with its own row.
        down = rows_type()
        for r in range(wp.static(TILE_HEIGHT)):
            down[r] = kept(scalar(tile_row * wp.static(TILE_HEIGHT) + (r ^ lane)))
        patch_half = scalar(view.radius) + scalar(0.5)
        totals = tile_type()
        base = world * view.cell_count + tile_row * view.cell_columns + tile_column
        for first_row in range(0, view.cells_down, wp.static(RUNS)):
            # Lanes alternate along several runs as if these were one: few lanes are idle.
            shifts = runs_type()
            ends = runs_type()
            total = wp.int32(0)
            for k in range(wp.static(RUNS)):
                begin = wp.int32(0)
                end = wp.int32(0)
                if first_row + k < view.cells_down:
                    first = base + (first_row + k) * view.cell_columns
                    begin = load_integer(starts, first)
                    end = load_integer(starts, first + view.cells_across)
                shifts[k] = begin - total
                total += end - begin
                ends[k] = total
            for i in range(lane, total, wp.static(lanes)):
                shift = shifts[0]
                for k in range(wp.static(RUNS - 1)):
                    shift = wp.where(i < ends[k], shift, shifts[k + 1])
                footprint = load_footprint(footprints, i + shift)
                slope_x = scalar(-2.0) * view.falloff * footprint[0]
                slope_y = scalar(-2.0) * view.falloff * footprint[1]
                columns = columns_type()
                for c in range(wp.static(TILE_WIDTH)):
                    offset = across[c] - footprint[2]
                    weight = splat.patch_weight(view.falloff, slope_x, offset)
                    columns[c] = wp.where(wp.abs(offset) < patch_half, weight, scalar(0.0))
                rows = rows_type()
                for r in range(wp.static(TILE_HEIGHT)):
                    offset = down[r] - footprint[3]
                    weight = splat.patch_weight(view.falloff, slope_y, offset)
                    rows[r] = wp.where(wp.abs(offset) < patch_half, weight, scalar(0.0))
                weights = weights_type()
                for k in range(wp.static(TILE_WIDTH * TILE_HEIGHT)):
                    weights[k] = (
                        rows[k / wp.static(TILE_WIDTH)] * columns[k % wp.static(TILE_WIDTH)]
                    )
                totals += wp.outer(splat.footprint_colours(footprint), weights)
        return collect(totals)

    return SimpleNamespace(candidate_count=candidate_count, gather_tile=gather_tile)


@cached_under_lock()
def splat_kernels(scalar: type, lanes: int) -> SimpleNamespace:
    """Return the kernels that draw worlds and pull back; `lanes` threads per tile or particle."""
    module = native.module(f"npa_envs.kernels.splat_{scalar_name(scalar)}_l{lanes}")
    return SimpleNamespace(
        **vars(sorting_kernels(scalar, module)),
        gather_splats=gathering_kernel(scalar, lanes, module),
        scatter_splats=scattering_kernel(scalar, module),
        pull_back_splats=adjoint_kernel(scalar, lanes, module),
    )


def sorting_kernels(scalar: type, module: wp.Module) -> SimpleNamespace:
    """Return the kernels that sort particles' footprints by cells."""
    types, splat = splat_types(scalar), splat_functions(scalar)
    View, vector, footprint_type = types.View, types.vector, types.footprint

    @wp.kernel(module=module)
    def count_splats(
        view: View,
        particle_count: int,
        positions: wp.array[vector],
        means: wp.array[vector],
        goal: wp.array[vector],
        # outputs
        cell: wp.array[wp.int32],
        arrival: wp.array[wp.int32],
        counts: wp.array[wp.int32],
    ):
        """Write each particle's cell and order of arrival, and count the particles of each cell.

        Those of cell c are counted at counts[c + 1]; counts[0] stays 0 for the prefix sum.
        """
        wait_for_previous_kernel()
        i = wp.tid()
        world = i / particle_count
        position = splat.position_in_world(view, positions[i], means, goal, world)
        index = world * view.cell_count + splat.cell_of_centre(view, splat.patch_centre(position))
        cell[i] = index
        arrival[i] = wp.atomic_add(counts, index + 1, 1)

    @wp.kernel(module=module)
    def place_splats(
        cell: wp.array[wp.int32],
        arrival: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        # outputs
        arrived: wp.array[wp.int32],
    ):
        """List the particles by cell, in the order in which they were counted."""
        wait_for_previous_kernel()
        i = wp.tid()
        arrived[starts[cell[i]] + arrival[i]] = i

    @wp.kernel(module=module)
    def order_splats(
        view: View,
        particle_count: int,
        positions: wp.array[vector],
        states: wp.array2d[scalar],
        shift: scalar,
        means: wp.array[vector],
        goal: wp.array[vector],
        cell: wp.array[wp.int32],
        arrived: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        # outputs
        footprints: wp.array[footprint_type],
        original_index: wp.array[wp.int32],
    ):
        """Write the particles' footprints sorted by cell, and by index within a cell."""
        wait_for_previous_kernel()
        k = wp.tid()
        i = arrived[k]
        c = cell[i]
        world = i / particle_count
        position = splat.position_in_world(view, positions[i], means, goal, world)
        footprint = splat.footprint_of(view, position, i, states, shift)
        begin = starts[c]
        target = k
        # Invisible particles, which may be many, can have any order.
        if c != (world + 1) * view.cell_count - 1:
            target = begin
            for other in range(begin, starts[c + 1]):
                if arrived[other] < i:
                    target += 1
        wide_store(footprints, target, footprint)
        original_index[target] = i

    return namespace(locals())


def gathering_kernel(scalar: type, lanes: int, module: wp.Module) -> wp.Kernel:
    """Return the kernel that draws by tiles of pixels, for CUDA."""
    types, gather_tile = splat_types(scalar), gather_functions(scalar, lanes).gather_tile
    View, colour_type = types.View, types.colour
    group_tiles = GROUP_WIDTH * GROUP_HEIGHT
    lane_pixels = TILE_WIDTH * TILE_HEIGHT // lanes

    @wp.func
    def tile_of(view: View, t: int):
        """Return world, row and column of thread t's tile, and the thread's number in the tile."""
        across = (view.tile_columns + wp.static(GROUP_WIDTH - 1)) / wp.static(GROUP_WIDTH)
        down = (view.tile_rows + wp.static(GROUP_HEIGHT - 1)) / wp.static(GROUP_HEIGHT)
        tile = t / wp.static(lanes)
        group = tile / wp.static(group_tiles)
        tile -= group * wp.static(group_tiles)
        world = group / (across * down)
        group -= world * across * down
        row = group / across * wp.static(GROUP_HEIGHT) + tile / wp.static(GROUP_WIDTH)
        column = group % across * wp.static(GROUP_WIDTH) + tile % wp.static(GROUP_WIDTH)
        return world, row, column, t % wp.static(lanes)

    @wp.func
    def pixel_of(view: View, tile_row: int, tile_column: int, k: int):
        """Return the index of a tile's k-th pixel in its picture, -1 outside of it."""
        row = tile_row * wp.static(TILE_HEIGHT) + k / wp.static(TILE_WIDTH)
        column = tile_column * wp.static(TILE_WIDTH) + k % wp.static(TILE_WIDTH)
        pixel = row * view.resolution + column
        if row >= view.resolution or column >= view.resolution:
            pixel = wp.int32(-1)
        return pixel

    @wp.kernel(module=module, cuda_max_registers=gather_registers(scalar))
    def gather_splats(
        view: View,
        starts: wp.array[wp.int32],
        footprints: wp.array[types.footprint],
        # outputs
        picture: wp.array[colour_type],
    ):
        """Write colours and density of each pixel of the pictures."""
        world, row, column, lane = tile_of(view, wp.tid())
        if row < view.tile_rows and column < view.tile_columns:
            values = gather_tile(view, world, row, column, lane, starts, footprints)
            begin = world * view.resolution * view.resolution
            for k in range(wp.static(lane_pixels)):
                pixel = pixel_of(view, row, column, lane * wp.static(lane_pixels) + k)
                if pixel >= 0:
                    value = colour_type(values[0, k], values[1, k], values[2, k], values[3, k])
                    wide_store(picture, begin + pixel, value)

    return gather_splats


def scattering_kernel(scalar: type, module: wp.Module) -> wp.Kernel:
    """Return the kernel that draws by particles, for CPUs."""
    types, splat = splat_types(scalar), splat_functions(scalar)
    vector = types.vector

    @in_ranges(WORLDS)
    @wp.kernel(module=module)
    def scatter_splats(
        range_start: int,
        view: types.View,
        particle_count: int,
        positions: wp.array[vector],
        states: wp.array2d[scalar],
        shift: scalar,
        means: wp.array[vector],
        goal: wp.array[vector],
        scratch: wp.array2d[scalar],
        # outputs
        picture: wp.array3d[types.colour],
        footprints: wp.array[types.footprint],
        original_index: wp.array[wp.int32],
    ):
        """Draw a world's picture, particle after particle; for devices with few threads."""
        world = range_start + wp.tid()
        for row in range(view.resolution):
            for column in range(view.resolution):
                picture[world, row, column] = types.colour()
        for i in range(world * particle_count, (world + 1) * particle_count):
            position = splat.position_in_world(view, positions[i], means, goal, world)
            footprint = splat.footprint_of(view, position, i, states, shift)
            footprints[i] = footprint
            original_index[i] = i
            if splat.visible(view, splat.patch_centre(position)):
                column = wp.int32(footprint[2])
                row = wp.int32(footprint[3])
                left = wp.max(column - view.radius, 0)
                right = wp.min(column + view.radius, view.resolution - 1) + 1
                slope_x = scalar(-2.0) * view.falloff * footprint[0]
                slope_y = scalar(-2.0) * view.falloff * footprint[1]
                for q in range(left, right):
                    weight = splat.patch_weight(view.falloff, slope_x, scalar(q - column))
                    scratch[world, q - left] = weight
                colours = splat.footprint_colours(footprint)
                low = wp.max(row - view.radius, 0)
                for p in range(low, wp.min(row + view.radius, view.resolution - 1) + 1):
                    along = splat.patch_weight(view.falloff, slope_y, scalar(p - row)) * colours
                    for q in range(left, right):
                        drawn = picture[world, p, q]
                        picture[world, p, q] = drawn + scratch[world, q - left] * along

    return scatter_splats


def adjoint_kernel(scalar: type, lanes: int, module: wp.Module) -> wp.Kernel:
    """Return the backward kernel, of gradients with respect to positions and colours."""
    types, splat = splat_types(scalar), splat_functions(scalar)
    vector, colour_type, bar_type = types.vector, types.colour, types.splat_bar
    load_footprint, load_colour = make_wide_load(types.footprint), make_wide_load(colour_type)
    lane_sum = make_lane_sum(bar_type, lanes)

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def pull_back_splats(
        range_start: int,
        view: types.View,
        particle_count: int,
        footprints: wp.array[types.footprint],
        original_index: wp.array[wp.int32],
        picture_bar: wp.array[colour_type],
        # outputs
        positions_bar: wp.array[vector],
        colours_bar: wp.array2d[scalar],
    ):
        """Write loss gradients with respect to positions and colours, from those of pixels."""
        k, lane = wp.tid()
        k += range_start
        world = k / particle_count
        footprint = load_footprint(footprints, k)
        colours = splat.footprint_colours(footprint)
        centre = vector(footprint[2], footprint[3])
        near = vector(footprint[0], footprint[1])
        slope = scalar(-2.0) * view.falloff * near
        is_drawn = splat.visible(view, centre)
        splat_bar = bar_type()
        if is_drawn:
            column = wp.int32(centre[0])
            row = wp.int32(centre[1])
            left = wp.max(column - view.radius, 0)
            right = wp.min(column + view.radius, view.resolution - 1) + 1
            low = wp.max(row - view.radius, 0)
            high = wp.min(row + view.radius, view.resolution - 1) + 1
            for p in range(low + lane, high, wp.static(lanes)):
                away_y = near[1] + scalar(p - row)
                begin = (world * view.resolution + p) * view.resolution
                along = colour_type()
                slope_x = scalar(0.0)
                for q in range(left, right):
                    away_x = near[0] + scalar(q - column)
                    weight = splat.patch_weight(view.falloff, slope[0], scalar(q - column))
                    bar = weight * load_colour(picture_bar, begin + q)
                    along += bar
                    slope_x += wp.dot(bar, colours) * away_x
                weight = splat.patch_weight(view.falloff, slope[1], scalar(p - row))
                for c in range(wp.static(CHANNELS)):
                    splat_bar[c] += weight * along[c]
                splat_bar[4] += weight * slope_x
                splat_bar[5] += weight * wp.dot(along, colours) * away_y
        splat_bar = lane_sum(splat_bar)
        if lane == 0:
            position_bar = vector()
            colour_bar = colour_type()
            if is_drawn:
                # Weights are normalised to sum 1, so the derivative subtracts the mean cotangent.
                sums = vector()
                moments = vector()
                for o in range(-view.radius, view.radius + 1):
                    for d in range(2):
                        weight = splat.patch_weight(view.falloff, slope[d], scalar(o))
                        sums[d] += weight
                        moments[d] += weight * (near[d] + scalar(o))
                for c in range(wp.static(CHANNELS)):
                    colour_bar[c] = splat_bar[c]
                gained = wp.dot(colour_bar, colours)
                for d in range(2):
                    position_bar[d] = splat_bar[4 + d] - gained * moments[d] / sums[d]
                colour_bar *= footprint[7]
            i = original_index[k]
            positions_bar[i] = view.position_scale * position_bar
            for c in range(3):
                colours_bar[i, c] = colour_bar[c]

    return pull_back_splats
