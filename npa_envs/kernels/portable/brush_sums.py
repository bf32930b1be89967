"""Sums over the points under brushes, which hold points by (1 - r²)² at r radii from their centre;
and gusts, which move particles as a brush does, before others are hit.

Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import wait_for_previous_kernel
from npa_envs.kernels.native_functions import WORLDS, in_ranges
from npa_envs.kernels.portable.random_numbers import joined, world_words


@cached_under_lock()
def brush_functions(scalar: type) -> SimpleNamespace:
    """Return Warp functions for the nearest image of a vector and for a brush's weight there."""
    vector = wp.types.vector(2, scalar)

    @wp.func
    def nearest_image(away: vector, box: vector):
        """Return the nearest image to the origin; a `box` of 0 is open space."""
        if box[0] > scalar(0.0):
            for d in range(2):
                away[d] -= box[d] * wp.round(away[d] / box[d])
        return away

    @wp.func
    def weight(away: vector):
        """Return the weight of a point that is `away` from the centre, in radii; 0 outside."""
        square = wp.dot(away, away)
        held = wp.float64(0.0)
        if square < scalar(1.0):
            held = wp.float64((scalar(1.0) - square) * (scalar(1.0) - square))
        return held

    return SimpleNamespace(nearest_image=nearest_image, weight=weight)


@cached_under_lock()
def brush_kernel(scalar: type, width: int, moments: bool) -> wp.Kernel:
    """Return the kernel of sums of `width` values under each brush; it has a thread for each.

    With `moments` sums of 1 and of offsets from the centre, in radii, precede those of values.
    """
    first = 3 * moments
    sums_type = wp.types.vector(first + width, wp.float64)
    vector = wp.types.vector(2, scalar)
    brush = brush_functions(scalar)
    name = f"npa_envs.kernels.brush_sums_{scalar_name(scalar)}_w{width}_m{int(moments)}"

    @in_ranges(WORLDS)
    @wp.kernel(module=native.module(name))
    def sum_under_brushes(
        range_start: int,
        radius: scalar,
        box: vector,
        centres: wp.array2d[vector],
        points: wp.array2d[vector],
        values: wp.array3d[scalar],
        # outputs
        sums: wp.array3d[scalar],
    ):
        """Write the weighted sums over all points of a world; a `box` of 0 is open space."""
        wait_for_previous_kernel()
        world, j = wp.tid()
        world += range_start
        centre = centres[world, j]
        inverse_radius = scalar(1.0) / radius
        total = sums_type()
        for i in range(points.shape[1]):
            away = inverse_radius * brush.nearest_image(points[world, i] - centre, box)
            weight = brush.weight(away)
            if weight > wp.float64(0.0):
                if wp.static(moments):
                    total[0] += weight
                    total[1] += weight * wp.float64(away[0])
                    total[2] += weight * wp.float64(away[1])
                for c in range(wp.static(width)):
                    total[wp.static(first) + c] += weight * wp.float64(values[world, i, c])
        for c in range(wp.static(first + width)):
            sums[world, j, c] = scalar(total[c])

    return sum_under_brushes


@cached_under_lock()
def gust_kernel(scalar: type) -> wp.Kernel:
    """Return the kernel of gusts in 2D; `lanes` threads share a world."""
    vector = wp.types.vector(2, scalar)
    brush = brush_functions(scalar)

    @wp.func
    def gusted(position: vector, centre: vector, move: vector, inverse_radius: scalar, box: vector):
        """Return a position moved by a brush at `centre`."""
        weight = brush.weight(inverse_radius * brush.nearest_image(centre - position, box))
        for d in range(2):
            position[d] += scalar(weight * wp.float64(move[d]))
        return position

    @in_ranges(WORLDS)
    @wp.kernel(module=native.module(f"npa_envs.kernels.gusts_{scalar_name(scalar)}"))
    def blow(
        range_start: int,
        radius: scalar,
        box: vector,
        lanes: int,
        keys: wp.array[wp.int64],
        episodes: wp.array[wp.int32],
        steps: wp.array[wp.int32],
        moves: wp.array[vector],
        hits: wp.array[scalar],
        positions: wp.array2d[vector],
        # outputs
        moved: wp.array2d[vector],
        hit: wp.array2d[wp.uint8],
    ):
        """Write positions after gusts by `moves`, then what is within `hits` of a particle."""
        wait_for_previous_kernel()
        world, lane = wp.tid()
        world += range_start
        count = positions.shape[1]
        inverse = scalar(1.0) / radius
        # In a step these are the draws 2 and 3.
        words = world_words(world, 0, 2, keys, episodes, steps)
        gust = positions[world, wp.int32(joined(words[0], words[1]) % wp.uint64(count))]
        words = world_words(world, 0, 3, keys, episodes, steps)
        middle = positions[world, wp.int32(joined(words[0], words[1]) % wp.uint64(count))]
        middle = gusted(middle, gust, moves[world], inverse, box)
        for i in range(lane, count, lanes):
            position = gusted(positions[world, i], gust, moves[world], inverse, box)
            moved[world, i] = position
            away = brush.nearest_image(position - middle, box)
            hit[world, i] = wp.uint8(wp.where(wp.length(away) <= hits[world], 1, 0))

    return blow
