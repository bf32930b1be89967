"""Errors of pictures of 2D worlds against a target.

On CUDA no picture is written: a few threads gather a tile of pixels, compare it and continue with
another one. The tiles of a warp take as long as the one with most particles around it, and many
tiles of a picture have none. So a block first sorts its tiles by their numbers of particles. Sums
do not depend on which threads serve a tile. On a CPU a drawn picture is compared.
"""

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import (
    CUDA_BLOCK,
    WARP,
    block_number,
    make_lane_sum,
    make_wide_load,
    thread_of_block,
    wait_for_previous_kernel,
)
from npa_envs.kernels.pictures.splat import (
    CHANNELS,
    TILE_HEIGHT,
    TILE_LANES,
    TILE_WIDTH,
    gather_functions,
    gather_registers,
    splat_types,
)

BLOCK_TILES = CUDA_BLOCK
"""Maximum number of tiles of a block: each thread counts the particles around one."""

BLOCK_WARPS, WARP_TILES = CUDA_BLOCK // WARP, WARP // TILE_LANES
ROUND_TILES = WARP_TILES * BLOCK_WARPS
"""Warps of a block, tiles that a warp serves together, and tiles that a block serves together."""


@cached_under_lock()
def make_pixel_errors(scalar: type) -> wp.Function:
    """Return a Warp function for the density error and the colour error of a pixel.

    The density error is |d| + d² of the difference d in density; the colour error is the sum of the
    same over red, green and blue, times exp(-density error).
    """
    colour_type = splat_types(scalar).colour

    @wp.func
    def growth(difference: scalar):
        size = wp.abs(difference)
        return size + size * size

    @wp.func
    def pixel_errors(value: colour_type, target: colour_type):
        density = growth(value[3] - target[3])
        colour = growth(value[0] - target[0]) + growth(value[1] - target[1])
        colour = (colour + growth(value[2] - target[2])) * wp.exp(-density)
        return wp.vec2d(wp.float64(density), wp.float64(colour))

    return pixel_errors


@cached_under_lock()
def gather_errors(scalar: type) -> wp.Kernel:
    """Return the kernel that draws pictures by tiles and compares them with a target, for CUDA."""
    types = splat_types(scalar)
    View, colour_type, footprint_type = types.View, types.colour, types.footprint
    row_type = wp.types.matrix((CHANNELS, TILE_WIDTH), scalar)
    gathering = gather_functions(scalar, TILE_LANES)
    pixel_errors = make_pixel_errors(scalar)
    load_colour = make_wide_load(colour_type)
    lane_sum = make_lane_sum(wp.vec2d, TILE_LANES)
    module = native.module(f"npa_envs.kernels.errors_{scalar_name(scalar)}")

    rank_tiles = native.function("rank_tiles", BLOCK_TILES, tile_count=int, candidates=int)
    ranked_tile = native.function("ranked_tile", BLOCK_TILES, rank=int, returns=wp.vec2i)

    @wp.kernel(module=module, cuda_max_registers=gather_registers(scalar), grid_stride=False)
    def gather_errors(
        view: View,
        tile_count: int,
        starts: wp.array[wp.int32],
        footprints: wp.array[footprint_type],
        target: wp.array[colour_type],
        # outputs
        partial_sums: wp.array2d[wp.vec2d],
    ):
        """Write the sums of density and colour errors over each tile."""
        wait_for_previous_kernel()
        # Adjacent tiles belong to different blocks, so that all blocks of a world do equal work.
        tiles = view.tile_columns * view.tile_rows
        stride = (tiles + tile_count - 1) / tile_count
        world = block_number() / stride
        first = block_number() - world * stride
        own = first + thread_of_block() * stride
        candidates = wp.int32(-1)
        if own < tiles and thread_of_block() < tile_count:
            row = own / view.tile_columns
            candidates = gathering.candidate_count(
                view, world, row, own - row * view.tile_columns, starts
            )
        rank_tiles(tile_count, candidates)
        lane = thread_of_block() % wp.static(TILE_LANES)
        warp = thread_of_block() / wp.static(WARP)
        tile_of_warp = thread_of_block() % wp.static(WARP) / wp.static(TILE_LANES)
        for r in range(tile_count / wp.static(ROUND_TILES)):
            # In alternating directions, so that all warps do equal work.
            batch = r * wp.static(BLOCK_WARPS) + warp
            if r % 2 == 1:
                batch += wp.static(BLOCK_WARPS - 1) - 2 * warp
            ranked = ranked_tile(batch * wp.static(WARP_TILES) + tile_of_warp)
            tile = first + ranked[0] * stride
            row = wp.int32(wp.uint32(tile) / wp.uint32(view.tile_columns))
            column = tile - row * view.tile_columns
            values = row_type()
            if ranked[1] > 0:
                values = gathering.gather_tile(view, world, row, column, lane, starts, footprints)
            # A lane has a row of the tile.
            row = row * wp.static(TILE_HEIGHT) + lane
            column *= wp.static(TILE_WIDTH)
            inside = wp.where(row < view.resolution, view.resolution - column, wp.int32(0))
            pixel = row * view.resolution + column
            sums = wp.vec2d()
            for k in range(wp.static(TILE_WIDTH)):
                if k < inside:
                    value = colour_type(values[0, k], values[1, k], values[2, k], values[3, k])
                    sums += pixel_errors(value, load_colour(target, pixel + k))
            sums = lane_sum(sums)
            if lane == 0 and ranked[1] >= 0:
                third = wp.float64(1.0) / wp.float64(3.0)
                partial_sums[world, tile] = wp.vec2d(sums[0], third * sums[1])

    return gather_errors


@cached_under_lock()
def sum_errors(scalar: type) -> wp.Kernel:
    """Return the kernel that compares drawn pictures with a target; for the CPU."""
    colour_type = splat_types(scalar).colour
    pixel_errors = make_pixel_errors(scalar)

    @wp.kernel(module=native.module(f"npa_envs.kernels.drawn_errors_{scalar_name(scalar)}"))
    def sum_errors(
        picture: wp.array3d[colour_type],
        target: wp.array2d[colour_type],
        # outputs
        partial_sums: wp.array2d[wp.vec2d],
    ):
        """Write the sums of density and colour errors over each row of the pictures."""
        world, row = wp.tid()
        sums = wp.vec2d()
        for column in range(picture.shape[2]):
            sums += pixel_errors(picture[world, row, column], target[row, column])
        partial_sums[world, row] = wp.vec2d(sums[0], sums[1] / wp.float64(3.0))

    return sum_errors
