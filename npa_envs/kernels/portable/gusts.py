"""Gusts and blights: in each world a random place where particles move, and one where they are hit.

Arguments: see `kernels/portable/__init__.py`.
"""

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import wait_for_previous_kernel
from npa_envs.kernels.native_functions import WORLDS, in_ranges
from npa_envs.kernels.portable.brush_sums import brush_functions
from npa_envs.kernels.portable.random_numbers import ULP_24, joined, world_words

CHANCES, GUST_PLACE, BLIGHT_PLACE = 0, 2, 3
"""Numbers of draws of a step; that of the gust's direction lies between."""


@cached_under_lock()
def gust_kernel(scalar: type) -> wp.Kernel:
    """Return the kernel of gusts and blights in 2D; `lanes` threads share a world."""
    vector = wp.types.vector(2, scalar)
    brush = brush_functions(scalar)

    @wp.func
    def gusted(position: vector, centre: vector, move: vector, inverse_radius: scalar, box: vector):
        """Return a position after a gust, moved by the weight of a brush at `centre`."""
        weight = brush.weight(inverse_radius * brush.nearest_image(centre - position, box))
        for d in range(2):
            position[d] += scalar(weight * wp.float64(move[d]))
        return position

    @wp.func
    def place(w: wp.types.vector(4, wp.uint32), count: int):
        return wp.int32(joined(w[0], w[1]) % wp.uint64(count))

    @in_ranges(WORLDS)
    @wp.kernel(module=native.module(f"npa_envs.kernels.gusts_{scalar_name(scalar)}"))
    def blow(
        range_start: int,
        chances: vector,
        radii: vector,
        box: vector,
        lanes: int,
        keys: wp.array[wp.int64],
        episodes: wp.array[wp.int32],
        steps: wp.array[wp.int32],
        moves: wp.array[vector],
        positions: wp.array2d[vector],
        # outputs
        moved: wp.array2d[vector],
        hit: wp.array2d[wp.uint8],
    ):
        """Write positions after gusts by `moves`, then which particles blights hit."""
        wait_for_previous_kernel()
        world, lane = wp.tid()
        world += range_start
        count = positions.shape[1]
        drawn = world_words(world, 0, wp.static(CHANCES), keys, episodes, steps)
        move = moves[world]
        if scalar(wp.float32(drawn[0] >> wp.uint32(8)) * ULP_24) >= chances[0]:
            move *= scalar(0.0)
        radius = scalar(-1.0)
        if scalar(wp.float32(drawn[1] >> wp.uint32(8)) * ULP_24) < chances[1]:
            radius = radii[1]
        inverse = scalar(1.0) / radii[0]
        drawn = world_words(world, 0, wp.static(GUST_PLACE), keys, episodes, steps)
        gust = positions[world, place(drawn, count)]
        drawn = world_words(world, 0, wp.static(BLIGHT_PLACE), keys, episodes, steps)
        blight = gusted(positions[world, place(drawn, count)], gust, move, inverse, box)
        for i in range(lane, count, lanes):
            position = gusted(positions[world, i], gust, move, inverse, box)
            moved[world, i] = position
            away = brush.nearest_image(position - blight, box)
            hit[world, i] = wp.uint8(wp.where(wp.length(away) <= radius, 1, 0))

    return blow
