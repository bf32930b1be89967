"""Pictures of 3D Gaussians: alpha blending of footprints, near ones first, and the adjoint.

A footprint covers a pixel at offset d from its mean by alpha = min(0.99, o exp(-1/2 dᵀ Q d)), by 0
if that is below 1/255. The pixel's colour is the sum of c alpha T, with the transmittance T the
product of 1 - alpha of nearer Gaussians, until T would be below 1e-4 (Kerbl et al. 2023: equation 3
and their rasterizer's limits).

The backward pass divides T by 1 - alpha from the last Gaussian to the first. With b the sum of
(c . c̄) alpha T over farther Gaussians plus the final T times its cotangent, the cotangent of alpha
is T (c . c̄) - b / (1 - alpha).

On CUDA there is a block per tile and a thread per pixel; sums over pixels use shuffles within warps
and shared memory among warps. On a CPU a thread serves a tile, one Gaussian after the other, each
only at the pixels that it covers. Every pair of a tile and a Gaussian has its own place for the
cotangents from that tile (`tile_bars`): no sum depends on the order of threads.
Names: `x_bar` = dL/dx, the gradient of the loss L with respect to x.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import (
    WARP,
    any_in_warp,
    load_integer,
    make_lane_sum,
    make_wide_load,
    sync_block,
)
from npa_envs.kernels.native_functions import TILES, in_ranges, namespace
from npa_envs.kernels.pictures.gaussians import (
    CHANNELS,
    MIN_ALPHA,
    TILE_BAR,
    TILE_SIDE,
    gaussian_functions,
    gaussian_types,
)

MAX_ALPHA = 0.99
"""Largest alpha: the adjoint divides by 1 - alpha."""

MIN_PASSING = 1e-4
"""Transmittance below which farther Gaussians are ignored."""

TILE_PIXELS = TILE_SIDE * TILE_SIDE
"""Pixels of a tile, and threads of its block."""

PATCH_WIDTH, PATCH_HEIGHT = 8, 4
"""Pixels of a tile that a warp serves: nearly square, so that it can skip most Gaussians."""

BATCH = 32
"""Pairs whose gradients a block keeps in shared memory before it adds those of its warps."""

TO_POWER_OF_TWO = -0.7213475204444817
"""-1/2 log2(e), the factor of p in exp(-1/2 p) as a power of two."""


@cached_under_lock()
def blending_functions(scalar: type) -> SimpleNamespace:
    """Return the functions that kernels share: a Gaussian's effect on a pixel, and gradients."""
    types = gaussian_types(scalar)
    Frame, quad, footprint_type, bar_type = types.Frame, types.quad, types.footprint, types.tile_bar
    fast_exp2 = native.function("fast_exp2", value=scalar, returns=scalar)

    @wp.func
    def strength(footprint: footprint_type, x: scalar, y: scalar):
        """Return a Gaussian's alpha at offset (x, y) [pixels] from its centre, not yet limited."""
        power = footprint[2] * x * x + footprint[4] * y * y
        power += scalar(2.0) * footprint[3] * x * y
        return footprint[5] * fast_exp2(scalar(TO_POWER_OF_TWO) * power)

    @wp.func
    def colours_of(footprint: footprint_type):
        return quad(footprint[6], footprint[7], footprint[8], footprint[9])

    @wp.func
    def cotangents(
        footprint: footprint_type,
        x: scalar,
        y: scalar,
        strength: scalar,
        bar: quad,
        through: scalar,
        behind: scalar,
    ):
        """Return a Gaussian's gradients from a pixel, and `through` and `behind` in front of it.

        Given are those behind it: `through` is the transmittance T, `behind` the final T times its
        gradient plus (c . c̄) alpha T of farther Gaussians. `bar` is c̄, the pixel's gradient.
        """
        alpha = wp.min(strength, scalar(MAX_ALPHA))
        rest = scalar(1.0) / (scalar(1.0) - alpha)
        before = through * rest
        gained = wp.dot(colours_of(footprint), bar)
        weight = alpha * before
        slope = scalar(0.0)
        if strength <= scalar(MAX_ALPHA):
            slope = alpha * (before * gained - behind * rest)
        slope_x = slope * x
        slope_y = slope * y
        pixel_bar = bar_type()
        pixel_bar[0] = slope
        pixel_bar[1] = slope_x
        pixel_bar[2] = slope_y
        pixel_bar[3] = slope_x * x
        pixel_bar[4] = slope_x * y
        pixel_bar[5] = slope_y * y
        for c in range(wp.static(CHANNELS)):
            pixel_bar[6 + c] = weight * bar[c]
        return pixel_bar, before, behind + weight * gained

    @wp.func
    def channels_at(values: wp.array2d[scalar], pixel: int):
        result = quad()
        # In an unrolled loop the vector stays in registers.
        for c in range(wp.static(CHANNELS)):
            if c < values.shape[1]:
                result[c] = values[pixel, c]
        return result

    @wp.func
    def pixel_of(frame: Frame, image: int, row: int, column: int):
        """Return the index of a pixel among those of all pictures, -1 outside of its picture."""
        pixel = wp.int32(-1)
        if row < frame.height and column < frame.width:
            pixel = (image * frame.height + row) * frame.width + column
        return pixel

    @wp.func
    def middle_of(pixel: int):
        """Return the coordinate [pixels] of a pixel's centre along one direction."""
        return scalar(pixel) + scalar(0.5)

    return namespace(locals())


@cached_under_lock()
def tile_kernels(scalar: type) -> SimpleNamespace:
    """Return the forward and the backward kernel of blending, one thread per tile; for CPUs."""
    types = gaussian_types(scalar)
    Frame, footprint_type, bar_type = types.Frame, types.footprint, types.tile_bar
    blending = blending_functions(scalar)
    covered = gaussian_functions(scalar).covered
    module = native.module(f"npa_envs.kernels.blending_tiles_{scalar_name(scalar)}")

    @wp.func
    def shared_pixels(frame: Frame, tile: int, footprint: footprint_type):
        """Return first column and row, then last + 1 ones, of a tile's pixels in a footprint."""
        tile_in_picture = tile % frame.tile_count
        row = tile_in_picture / frame.tile_columns * wp.static(TILE_SIDE)
        column = tile_in_picture % frame.tile_columns * wp.static(TILE_SIDE)
        left, right = covered(footprint[0], footprint[10], frame.width)
        top, bottom = covered(footprint[1], footprint[11], frame.height)
        return wp.vec4i(
            wp.max(left, column),
            wp.max(top, row),
            wp.min(right, column + wp.static(TILE_SIDE)),
            wp.min(bottom, row + wp.static(TILE_SIDE)),
        )

    @in_ranges(TILES)
    @wp.kernel(module=module)
    def draw_tiles(
        range_start: int,
        frame: Frame,
        starts: wp.array[wp.int32],
        owners: wp.array[wp.int32],
        footprints: wp.array[footprint_type],
        # added to, from zeros and ones
        picture: wp.array2d[scalar],
        passing: wp.array[scalar],
        # outputs
        stops: wp.array[wp.int32],
    ):
        """Blend the Gaussians of a tile; `stops` becomes the first pair that a pixel ignores.

        A pair is a tile and a Gaussian that covers it. Initial `stops` must be beyond all pairs.
        """
        tile = range_start + wp.tid()
        image = tile / frame.tile_count
        for j in range(starts[tile], starts[tile + 1]):
            footprint = footprints[owners[j]]
            pixels = shared_pixels(frame, tile, footprint)
            for row in range(pixels[1], pixels[3]):
                y = blending.middle_of(row) - footprint[1]
                for column in range(pixels[0], pixels[2]):
                    strength = blending.strength(
                        footprint, blending.middle_of(column) - footprint[0], y
                    )
                    pixel = blending.pixel_of(frame, image, row, column)
                    if strength >= scalar(MIN_ALPHA) and j < stops[pixel]:
                        before = passing[pixel]
                        alpha = wp.min(strength, scalar(MAX_ALPHA))
                        after = before * (scalar(1.0) - alpha)
                        if after < scalar(MIN_PASSING):
                            stops[pixel] = j
                        else:
                            passing[pixel] = after
                            for c in range(frame.channels):
                                added = alpha * before * footprint[6 + c]
                                picture[pixel, c] = picture[pixel, c] + added

    @in_ranges(TILES)
    @wp.kernel(module=module)
    def pull_back_tiles(
        range_start: int,
        frame: Frame,
        starts: wp.array[wp.int32],
        owners: wp.array[wp.int32],
        pair_slots: wp.array[wp.int64],
        footprints: wp.array[footprint_type],
        stops: wp.array[wp.int32],
        picture_bar: wp.array2d[scalar],
        # changed: what passes at the end, and that times its cotangent
        through: wp.array[scalar],
        behind: wp.array[scalar],
        # outputs
        tile_bars: wp.array[bar_type],
    ):
        """Write a tile's gradients with respect to Gaussians, each at `pair_slots` of its pair."""
        tile = range_start + wp.tid()
        image = tile / frame.tile_count
        begin = starts[tile]
        end = starts[tile + 1]
        for k in range(end - begin):
            j = end - 1 - k
            footprint = footprints[owners[j]]
            pixels = shared_pixels(frame, tile, footprint)
            total = bar_type()
            for row in range(pixels[1], pixels[3]):
                y = blending.middle_of(row) - footprint[1]
                for column in range(pixels[0], pixels[2]):
                    x = blending.middle_of(column) - footprint[0]
                    strength = blending.strength(footprint, x, y)
                    pixel = blending.pixel_of(frame, image, row, column)
                    if strength >= scalar(MIN_ALPHA) and j < stops[pixel]:
                        bar = blending.channels_at(picture_bar, pixel)
                        added, before, rest = blending.cotangents(
                            footprint, x, y, strength, bar, through[pixel], behind[pixel]
                        )
                        total += added
                        through[pixel] = before
                        behind[pixel] = rest
            tile_bars[wp.int32(pair_slots[j])] = total

    return SimpleNamespace(draw_tiles=draw_tiles, pull_back_tiles=pull_back_tiles)


@cached_under_lock()
def block_kernels(scalar: type) -> SimpleNamespace:
    """Return the forward and the backward kernel of blending, one block per tile; for CUDA."""
    types = gaussian_types(scalar)
    Frame, quad, footprint_type, bar_type = types.Frame, types.quad, types.footprint, types.tile_bar
    blending = blending_functions(scalar)
    name = scalar_name(scalar)
    drawing_module = native.module(f"npa_envs.kernels.blending_blocks_{name}")
    adjoint_module = native.module(f"npa_envs.kernels.blending_blocks_adjoint_{name}")
    load_footprint = make_wide_load(footprint_type)
    add_warp = make_lane_sum(bar_type, WARP, whole_warps=True)

    # Store a warp's cotangents of pair i (`write`), or return an entry of the warps' sum.
    arguments = {"write": bool, "i": int, "entry": int, "value": bar_type}
    sizes = BATCH, TILE_PIXELS // WARP
    store_or_sum = native.function("store_or_sum", *sizes, **arguments, returns=scalar)

    @wp.func
    def own_pixel(frame: Frame, tile: int, k: int):
        """Return column and row of thread k's pixel in a tile; a warp has a rectangle of pixels."""
        patch = k / wp.static(WARP)
        lane = k % wp.static(WARP)
        across = wp.static(TILE_SIDE // PATCH_WIDTH)
        tile_in_picture = tile % frame.tile_count
        column = tile_in_picture % frame.tile_columns * wp.static(TILE_SIDE)
        column += patch % across * wp.static(PATCH_WIDTH) + lane % wp.static(PATCH_WIDTH)
        row = tile_in_picture / frame.tile_columns * wp.static(TILE_SIDE)
        row += patch / across * wp.static(PATCH_HEIGHT) + lane / wp.static(PATCH_WIDTH)
        return column, row

    @wp.kernel(module=drawing_module)
    def draw_blocks(
        frame: Frame,
        starts: wp.array[wp.int32],
        owners: wp.array[wp.int32],
        footprints: wp.array[footprint_type],
        # outputs
        picture: wp.array2d[scalar],
        passing: wp.array[scalar],
        stops: wp.array[wp.int32],
    ):
        """Write a pixel; `stops` gets the first pair of its tile and a Gaussian that it ignores."""
        t = wp.tid()
        tile = t / wp.static(TILE_PIXELS)
        column, row = own_pixel(frame, tile, t % wp.static(TILE_PIXELS))
        pixel = blending.pixel_of(frame, tile / frame.tile_count, row, column)
        if pixel >= 0:
            left = blending.middle_of(column)
            top = blending.middle_of(row)
            total = quad()
            through = scalar(1.0)
            j = starts[tile]
            end = starts[tile + 1]
            stop = end
            while j < stop:
                footprint = load_footprint(footprints, load_integer(owners, j))
                strength = blending.strength(footprint, left - footprint[0], top - footprint[1])
                if strength >= scalar(MIN_ALPHA):
                    alpha = wp.min(strength, scalar(MAX_ALPHA))
                    after = through * (scalar(1.0) - alpha)
                    if after < scalar(MIN_PASSING):
                        stop = j
                    else:
                        total += alpha * through * blending.colours_of(footprint)
                        through = after
                j += 1
            for c in range(wp.static(CHANNELS)):
                if c < frame.channels:
                    picture[pixel, c] = total[c]
            passing[pixel] = through
            stops[pixel] = stop

    @wp.kernel(module=adjoint_module)
    def pull_back_blocks(
        frame: Frame,
        starts: wp.array[wp.int32],
        owners: wp.array[wp.int32],
        pair_slots: wp.array[wp.int64],
        footprints: wp.array[footprint_type],
        stops: wp.array[wp.int32],
        picture_bar: wp.array2d[scalar],
        passing: wp.array[scalar],
        passing_bar: wp.array[scalar],
        # outputs
        tile_bars: wp.array[scalar],
    ):
        """Write a tile's gradients with respect to Gaussians, each at `pair_slots` of its pair.

        A block serves a tile; all its threads go through all pairs, as they sum together.
        """
        t = wp.tid()
        tile = t / wp.static(TILE_PIXELS)
        k = t % wp.static(TILE_PIXELS)
        column, row = own_pixel(frame, tile, k)
        pixel = blending.pixel_of(frame, tile / frame.tile_count, row, column)
        left = blending.middle_of(column)
        top = blending.middle_of(row)
        begin = starts[tile]
        end = starts[tile + 1]
        stop = wp.int32(0)
        bar = quad()
        through = scalar(0.0)
        behind = scalar(0.0)
        if pixel >= 0:
            stop = stops[pixel]
            bar = blending.channels_at(picture_bar, pixel)
            through = passing[pixel]
            behind = through * passing_bar[pixel]
        while end > begin:
            count = wp.min(end - begin, wp.static(BATCH))
            for i in range(count):
                j = end - 1 - i
                total = bar_type()
                if any_in_warp(j < stop):
                    footprint = load_footprint(footprints, load_integer(owners, j))
                    x = left - footprint[0]
                    y = top - footprint[1]
                    strength = blending.strength(footprint, x, y)
                    is_drawn = j < stop and strength >= scalar(MIN_ALPHA)
                    if any_in_warp(is_drawn):
                        if is_drawn:
                            total, through, behind = blending.cotangents(
                                footprint, x, y, strength, bar, through, behind
                            )
                        total = add_warp(total)
                store_or_sum(True, i, 0, total)
            sync_block()
            for entry in range(k, count * wp.static(TILE_BAR), wp.static(TILE_PIXELS)):
                i = entry / wp.static(TILE_BAR)
                part = entry - i * wp.static(TILE_BAR)
                slot = wp.int32(pair_slots[end - 1 - i])
                block_sum = store_or_sum(False, i, part, bar_type())
                tile_bars[slot * wp.static(TILE_BAR) + part] = block_sum
            sync_block()
            end -= count

    return SimpleNamespace(draw_blocks=draw_blocks, pull_back_blocks=pull_back_blocks)
