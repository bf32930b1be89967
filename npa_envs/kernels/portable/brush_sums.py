"""Sums over the points under brushes, which hold points by (1 - r²)² at r radii from their centre.

Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import wait_for_previous_kernel
from npa_envs.kernels.native_functions import WORLDS, in_ranges


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
