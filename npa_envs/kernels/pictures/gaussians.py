"""3D Gaussians on pictures: their footprints, the tiles that these cover, and the adjoint of both.

A footprint is the data of a Gaussian on a picture that `blending` needs. It extends to where the
Gaussian falls below the smallest alpha, so tiles miss nothing.

Sources: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", and
Zwicker et al. 2002, "EWA Splatting". A Gaussian of mean p and covariance P = (R S)(R S)ᵀ (Kerbl,
equation 6) lies at c = W p + t in a camera's frame and at (fx x/z + cx, fy y/z + cy) on its
picture. There its covariance is Q⁻¹ = J W P Wᵀ Jᵀ + dilation (Kerbl, equation 5), where J is the
projection's derivative at c, the local affine approximation (Zwicker).
Names: `x_bar` = dL/dx, the gradient of the loss L with respect to x.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import make_wide_load, wide_store
from npa_envs.kernels.native_functions import PAIRS, in_ranges, namespace

TILE_SIDE = 16
"""Pixels along each side of a tile."""

CHANNELS = 4
"""Colour channels of a footprint; pictures may have fewer."""

FOOTPRINT = 12
"""Entries of a footprint: mean (2), conic Q (3: xx, xy, yy), opacity, colours (4), extent (2)."""

TILE_BAR = 10
"""Entries of a Gaussian's cotangents from a tile: with weights α ᾱ and offsets d of pixels, the
sums of 1, dx, dy, dx dx, dx dy, dy dy; cotangents of the colours (4)."""

MIN_ALPHA = 1.0 / 255.0
"""Smallest alpha that is drawn, as in Kerbl's rasterizer."""

CLAMP_MARGIN = 0.3
"""J is computed at a point at most this fraction of half the picture outside of it, as in Kerbl's
implementation: far outside, the affine approximation gives Gaussians that fill the picture."""

EXTENT_SLACK = 1e-3
"""Added to the exponent at which a Gaussian ends, so that rounding cannot lose a pixel."""

HARMONIC_0, HARMONIC_1 = 0.28209479177387814, 0.4886025119029199
"""Factors of the real spherical harmonics of degree 0 and 1."""


@cached_under_lock()
def gaussian_types(scalar: type) -> SimpleNamespace:
    """Return the `Frame` struct of sizes, and the vector and matrix types, of one scalar type."""

    @wp.struct
    class Frame:
        particle_count: int
        view_count: int
        width: int
        height: int
        tile_columns: int
        tile_count: int
        channels: int
        near: scalar
        dilation: scalar

    return SimpleNamespace(
        Frame=Frame,
        pair=wp.types.vector(2, scalar),
        triple=wp.types.vector(3, scalar),
        quad=wp.types.vector(4, scalar),
        footprint=wp.types.vector(FOOTPRINT, scalar),
        tile_bar=wp.types.vector(TILE_BAR, scalar),
        square=wp.types.matrix((2, 2), scalar),
        flat=wp.types.matrix((2, 3), scalar),
        cube=wp.types.matrix((3, 3), scalar),
        motion=wp.types.matrix((4, 4), scalar),
        harmonics=wp.types.matrix((4, 3), scalar),
    )


@cached_under_lock(256)
def make_frame(
    scalar: type, shape: tuple[int, int, int], sizes: tuple[int, int], near: float, dilation: float
) -> Any:
    """Return the `Frame` of a batch of pictures.

    `shape`: particles, views and channels. `sizes`: width and height [pixels]. `near`: least depth
    [length units]. `dilation`: variance that is added to Gaussians [pixels²].
    """
    frame = gaussian_types(scalar).Frame()
    frame.particle_count, frame.view_count, frame.channels = shape
    frame.width, frame.height = sizes
    frame.tile_columns = -(-frame.width // TILE_SIDE)
    frame.tile_count = frame.tile_columns * -(-frame.height // TILE_SIDE)
    frame.near = near
    frame.dilation = dilation
    return frame


@cached_under_lock()
def gaussian_functions(scalar: type) -> SimpleNamespace:
    """Return the functions that several kernels share: rotations, projection, colours and tiles."""
    types = gaussian_types(scalar)
    Frame, pair, triple, quad = types.Frame, types.pair, types.triple, types.quad
    footprint_type, harmonics_type = types.footprint, types.harmonics
    flat, cube, motion_type = types.flat, types.cube, types.motion

    @wp.func
    def covered(middle: scalar, extent: scalar, size: int):
        """Return first and last + 1 pixel of `size` whose centre is within `extent` of `middle`."""
        end = scalar(size)
        first = wp.ceil(wp.clamp(middle - extent - scalar(0.5), scalar(0.0), end))
        last = wp.floor(wp.clamp(middle + extent + scalar(0.5), scalar(0.0), end))
        return wp.int32(first), wp.int32(last)

    @wp.func
    def unit_quaternion(quaternion: quad):
        """Return the unit quaternion (identity for length 0), and 1 / length (0 for length 0)."""
        unit = quad(scalar(1.0), scalar(0.0), scalar(0.0), scalar(0.0))
        inverse = scalar(0.0)
        length = wp.length(quaternion)
        # Not >, which would turn NaN into a rotation.
        if length != scalar(0.0):
            inverse = scalar(1.0) / length
            unit = inverse * quaternion
        return unit, inverse

    @wp.func
    def rotation_of(q: quad):
        w = q[0]
        x = q[1]
        y = q[2]
        z = q[3]
        one = scalar(1.0)
        two = scalar(2.0)
        return cube(
            one - two * (y * y + z * z),
            two * (x * y - w * z),
            two * (x * z + w * y),
            two * (x * y + w * z),
            one - two * (x * x + z * z),
            two * (y * z - w * x),
            two * (x * z - w * y),
            two * (y * z + w * x),
            one - two * (x * x + y * y),
        )

    @wp.func
    def pull_back_rotation(q: quad, bar: cube):
        """Return dL/dq of a unit quaternion q; `bar` is dL/dR of its rotation matrix R."""
        w = q[0]
        x = q[1]
        y = q[2]
        z = q[3]
        two = scalar(2.0)
        return two * quad(
            x * (bar[2, 1] - bar[1, 2]) + y * (bar[0, 2] - bar[2, 0]) + z * (bar[1, 0] - bar[0, 1]),
            y * (bar[0, 1] + bar[1, 0])
            + z * (bar[0, 2] + bar[2, 0])
            + w * (bar[2, 1] - bar[1, 2])
            - two * x * (bar[1, 1] + bar[2, 2]),
            x * (bar[0, 1] + bar[1, 0])
            + z * (bar[1, 2] + bar[2, 1])
            + w * (bar[0, 2] - bar[2, 0])
            - two * y * (bar[0, 0] + bar[2, 2]),
            x * (bar[0, 2] + bar[2, 0])
            + y * (bar[1, 2] + bar[2, 1])
            + w * (bar[1, 0] - bar[0, 1])
            - two * z * (bar[0, 0] + bar[1, 1]),
        )

    @wp.func
    def rotation_part(motion: motion_type):
        result = cube()
        for row in range(3):
            for column in range(3):
                result[row, column] = motion[row, column]
        return result

    @wp.func
    def shift_part(motion: motion_type):
        return triple(motion[0, 3], motion[1, 3], motion[2, 3])

    @wp.func
    def limited(ratio: scalar, focal: scalar, middle: scalar, size: scalar):
        """Return x/z or y/z (`ratio`), clamped to a margin around the picture, for J."""
        margin = scalar(wp.static(0.5 * CLAMP_MARGIN)) * size
        return wp.clamp(ratio, (-middle - margin) / focal, (size - middle + margin) / focal)

    @wp.func
    def limited_ratios(frame: Frame, camera: quad, position: triple):
        return pair(
            limited(position[0] / position[2], camera[0], camera[2], scalar(frame.width)),
            limited(position[1] / position[2], camera[1], camera[3], scalar(frame.height)),
        )

    @wp.func
    def jacobian_of(frame: Frame, camera: quad, position: triple):
        """Return J [2, 3], the derivative of a point on the picture by the point in the camera."""
        ratios = limited_ratios(frame, camera, position)
        x = camera[0] / position[2]
        y = camera[1] / position[2]
        return flat(x, scalar(0.0), -x * ratios[0], scalar(0.0), y, -y * ratios[1])

    @wp.func
    def scaled_columns(matrix: cube, scale: triple):
        result = cube()
        for row in range(3):
            for column in range(3):
                result[row, column] = matrix[row, column] * scale[column]
        return result

    @wp.func
    def offset_from_camera(motion: motion_type, mean: triple):
        """Return the vector from the camera to a mean [length units], on which colours depend."""
        return mean + wp.transpose(rotation_part(motion)) * shift_part(motion)

    @wp.func
    def harmonics_at(colours: wp.array2d[scalar], i: int):
        result = harmonics_type()
        for k in range(4):
            for c in range(3):
                result[k, c] = colours[i, 3 * k + c]
        return result

    @wp.func
    def harmonic_basis(direction: triple):
        factor = scalar(HARMONIC_1)
        return quad(
            scalar(HARMONIC_0),
            -factor * direction[1],
            factor * direction[2],
            -factor * direction[0],
        )

    @wp.func
    def colours_of(colours: wp.array2d[scalar], i: int, motion: motion_type, mean: triple):
        """Return a Gaussian's 4 colours, padded with 0; 12 numbers are spherical harmonics."""
        result = quad()
        if colours.shape[1] <= wp.static(CHANNELS):
            for c in range(wp.static(CHANNELS)):
                if c < colours.shape[1]:
                    result[c] = colours[i, c]
        else:
            basis = harmonic_basis(wp.normalize(offset_from_camera(motion, mean)))
            colour = basis * harmonics_at(colours, i)
            for c in range(3):
                value = colour[c] + scalar(0.5)
                # Not wp.max, which would turn NaN into a colour.
                result[c] = wp.where(value < scalar(0.0), scalar(0.0), value)
        return result

    @wp.func
    def covered_tiles(frame: Frame, footprint: footprint_type):
        """Return first column and row, then last + 1 ones, of the tiles in a footprint."""
        left, right = covered(footprint[0], footprint[10], frame.width)
        top, bottom = covered(footprint[1], footprint[11], frame.height)
        result = wp.vec4i()
        if left < right and top < bottom:
            size = wp.static(TILE_SIDE)
            result = wp.vec4i(
                left / size, top / size, (right - 1) / size + 1, (bottom - 1) / size + 1
            )
        return result

    return namespace(locals())


@cached_under_lock()
def gaussian_kernels(scalar: type) -> SimpleNamespace:
    """Return the kernels that project 3D Gaussians, list the tiles they cover, and pull back."""
    module = native.module(f"npa_envs.kernels.gaussians_{scalar_name(scalar)}")
    kernels = vars(projection_kernels(scalar, module))
    return SimpleNamespace(**kernels, pull_back_gaussians=adjoint_kernel(scalar, module))


def projection_kernels(scalar: type, module: wp.Module) -> SimpleNamespace:
    """Return the kernels that project Gaussians and list the tiles that these cover."""
    types, gaussian = gaussian_types(scalar), gaussian_functions(scalar)
    Frame, triple, quad = types.Frame, types.triple, types.quad
    footprint_type, motion_type = types.footprint, types.motion
    load_footprint = make_wide_load(footprint_type)

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def project_gaussians(
        range_start: int,
        frame: Frame,
        means: wp.array[triple],
        scales: wp.array[triple],
        quaternions: wp.array[quad],
        opacities: wp.array[scalar],
        colours: wp.array2d[scalar],
        motions: wp.array[motion_type],
        intrinsics: wp.array[quad],
        # outputs
        footprints: wp.array[footprint_type],
        depths: wp.array[scalar],
        counts: wp.array[wp.int32],
    ):
        """Write footprint, depth and number of covered tiles of each Gaussian in each picture.

        An invisible Gaussian, or one with a number that is not finite, covers no tile and has
        infinite depth. `motions` (from world to camera) and `intrinsics` are one for each picture,
        for each view of all worlds, or for all pictures.
        """
        entry = range_start + wp.tid()
        image = entry / frame.particle_count
        i = image / frame.view_count * frame.particle_count + entry % frame.particle_count
        motion = motions[image % motions.shape[0]]
        camera = intrinsics[image % intrinsics.shape[0]]
        mean = means[i]
        opacity = opacities[i]
        rotation = gaussian.rotation_part(motion)
        position = rotation * mean + gaussian.shift_part(motion)
        depth = scalar(wp.inf)
        count = wp.int32(0)
        footprint = footprint_type()
        if position[2] >= frame.near and opacity >= scalar(MIN_ALPHA):
            unit, _inverse = gaussian.unit_quaternion(quaternions[i])
            spread = gaussian.scaled_columns(rotation * gaussian.rotation_of(unit), scales[i])
            root = gaussian.jacobian_of(frame, camera, position) * spread
            x = root[0]
            y = root[1]
            squared_x = wp.dot(x, x)
            squared_y = wp.dot(y, y)
            # By Cauchy-Binet: the difference of products would cancel for a thin Gaussian.
            normal = wp.cross(x, y)
            determinant = wp.dot(normal, normal)
            determinant += frame.dilation * (squared_x + squared_y + frame.dilation)
            inverse = scalar(1.0) / determinant
            squared_x += frame.dilation
            squared_y += frame.dilation
            extent = scalar(2.0) * (wp.log(scalar(255.0) * opacity) + scalar(EXTENT_SLACK))
            footprint[0] = camera[0] * position[0] / position[2] + camera[2]
            footprint[1] = camera[1] * position[1] / position[2] + camera[3]
            footprint[2] = squared_y * inverse
            footprint[3] = -wp.dot(x, y) * inverse
            footprint[4] = squared_x * inverse
            footprint[5] = opacity
            colour = gaussian.colours_of(colours, i, motion, mean)
            for c in range(wp.static(CHANNELS)):
                footprint[6 + c] = colour[c]
            footprint[10] = wp.sqrt(extent * squared_x)
            footprint[11] = wp.sqrt(extent * squared_y)
            total = scalar(0.0)
            for k in range(wp.static(FOOTPRINT)):
                total += footprint[k]
            if wp.isfinite(total) and determinant > scalar(0.0):
                tiles = gaussian.covered_tiles(frame, footprint)
                count = (tiles[2] - tiles[0]) * (tiles[3] - tiles[1])
                if count > 0:
                    depth = position[2]
        wide_store(footprints, entry, footprint)
        depths[entry] = depth
        counts[entry] = count

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def list_pairs(
        range_start: int,
        frame: Frame,
        footprints: wp.array[footprint_type],
        order: wp.array[wp.int64],
        ends: wp.array[wp.int64],
        room: int,
        # outputs
        tiles: wp.array[wp.int32],
        owners: wp.array[wp.int32],
        slots: wp.array[wp.int32],
    ):
        """Write the pairs of a tile and a Gaussian that covers it, near Gaussians first.

        A picture has room for `room` pairs. `slots` has the index of each Gaussian's first pair, -1
        if it covers no tile or has no room.
        """
        k = range_start + wp.tid()
        image = k / frame.particle_count
        first = image * frame.particle_count
        entry = first + wp.int32(order[k])
        begin = wp.int64(0)
        if k > first:
            begin = ends[k - 1]
        end = ends[k]
        slot = wp.int32(-1)
        if begin < end and end <= wp.int64(room):
            slot = image * room + wp.int32(begin)
            covers = gaussian.covered_tiles(frame, load_footprint(footprints, entry))
            next_slot = slot
            for row in range(covers[1], covers[3]):
                for column in range(covers[0], covers[2]):
                    tiles[next_slot] = image * frame.tile_count + row * frame.tile_columns + column
                    owners[next_slot] = entry
                    next_slot += 1
        slots[entry] = slot

    return namespace(locals())


def adjoint_kernel(scalar: type, module: wp.Module) -> wp.Kernel:
    """Return the backward kernel of Gaussians, which adds up their gradients from tiles."""
    types, gaussian = gaussian_types(scalar), gaussian_functions(scalar)
    Frame, pair, triple, quad = types.Frame, types.pair, types.triple, types.quad
    footprint_type, bar_type, harmonics_type = types.footprint, types.tile_bar, types.harmonics
    square, cube, motion_type = types.square, types.cube, types.motion
    load_footprint, load_tile_bar = make_wide_load(footprint_type), make_wide_load(bar_type)

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def pull_back_gaussians(
        range_start: int,
        frame: Frame,
        means: wp.array[triple],
        scales: wp.array[triple],
        quaternions: wp.array[quad],
        colours: wp.array2d[scalar],
        motions: wp.array[motion_type],
        intrinsics: wp.array[quad],
        footprints: wp.array[footprint_type],
        counts: wp.array[wp.int32],
        slots: wp.array[wp.int32],
        tile_bars: wp.array[bar_type],
        # outputs
        means_bar: wp.array[triple],
        scales_bar: wp.array[triple],
        quaternions_bar: wp.array[quad],
        opacities_bar: wp.array[scalar],
        colours_bar: wp.array2d[scalar],
    ):
        """Write Gaussians' cotangents: sums over views and, in each view, over tiles."""
        i = range_start + wp.tid()
        world = i / frame.particle_count
        mean = means[i]
        scale = scales[i]
        unit, inverse = gaussian.unit_quaternion(quaternions[i])
        own_rotation = gaussian.rotation_of(unit)
        mean_bar = triple()
        scale_bar = triple()
        rotation_bar = cube()
        opacity_bar = scalar(0.0)
        colour_bar = quad()
        harmonics_bar = harmonics_type()
        is_drawn = wp.bool(False)
        for view in range(frame.view_count):
            image = world * frame.view_count + view
            entry = image * frame.particle_count + i % frame.particle_count
            slot = slots[entry]
            if slot >= 0:
                is_drawn = wp.bool(True)
                tile_bar = bar_type()
                for k in range(slot, slot + counts[entry]):
                    tile_bar += load_tile_bar(tile_bars, k)
                footprint = load_footprint(footprints, entry)
                motion = motions[image % motions.shape[0]]
                camera = intrinsics[image % intrinsics.shape[0]]
                rotation = gaussian.rotation_part(motion)
                position = rotation * mean + gaussian.shift_part(motion)
                conic = square(footprint[2], footprint[3], footprint[3], footprint[4])
                centre_bar = conic * pair(tile_bar[1], tile_bar[2])
                opacity_bar += tile_bar[0] / footprint[5]

                # Of Q = (A Aᵀ + dilation)⁻¹ with A = J W R S.
                moments = square(tile_bar[3], tile_bar[4], tile_bar[4], tile_bar[5])
                jacobian = gaussian.jacobian_of(frame, camera, position)
                axes = rotation * own_rotation
                spread = gaussian.scaled_columns(axes, scale)
                root_bar = conic * moments * conic * (jacobian * spread)
                jacobian_bar = root_bar * wp.transpose(spread)
                spread_bar = wp.transpose(jacobian) * root_bar
                for d in range(3):
                    for row in range(3):
                        scale_bar[d] += spread_bar[row, d] * axes[row, d]
                rotation_bar += wp.transpose(rotation) * gaussian.scaled_columns(spread_bar, scale)

                ratios = gaussian.limited_ratios(frame, camera, position)
                position_bar = triple()
                for d in range(2):
                    focal = camera[d] / position[2]
                    ratio = position[d] / position[2]
                    position_bar[d] = focal * centre_bar[d]
                    position_bar[2] -= focal * centre_bar[d] * ratio
                    position_bar[2] -= focal / position[2] * jacobian_bar[d, d]
                    position_bar[2] += focal / position[2] * ratios[d] * jacobian_bar[d, 2]
                    if ratios[d] == ratio:
                        ratio_bar = -focal / position[2] * jacobian_bar[d, 2]
                        position_bar[d] += ratio_bar
                        position_bar[2] -= ratio_bar * ratio
                mean_bar += wp.transpose(rotation) * position_bar

                if colours.shape[1] <= wp.static(CHANNELS):
                    for c in range(wp.static(CHANNELS)):
                        colour_bar[c] += tile_bar[6 + c]
                else:
                    seen_colour_bar = triple()
                    for c in range(3):
                        if footprint[6 + c] > scalar(0.0):
                            seen_colour_bar[c] = tile_bar[6 + c]
                    way = gaussian.offset_from_camera(motion, mean)
                    direction = wp.normalize(way)
                    harmonics_bar += wp.outer(gaussian.harmonic_basis(direction), seen_colour_bar)
                    basis_bar = gaussian.harmonics_at(colours, i) * seen_colour_bar
                    factor = scalar(HARMONIC_1) / wp.length(way)
                    way_bar = factor * triple(-basis_bar[3], -basis_bar[1], basis_bar[2])
                    mean_bar += way_bar - wp.dot(way_bar, direction) * direction
        means_bar[i] = mean_bar
        scales_bar[i] = scale_bar
        quaternion_bar = quad()
        if is_drawn:
            unit_bar = gaussian.pull_back_rotation(unit, rotation_bar)
            quaternion_bar = inverse * (unit_bar - wp.dot(unit_bar, unit) * unit)
        quaternions_bar[i] = quaternion_bar
        opacities_bar[i] = opacity_bar
        if colours.shape[1] <= wp.static(CHANNELS):
            for c in range(wp.static(CHANNELS)):
                if c < colours.shape[1]:
                    colours_bar[i, c] = colour_bar[c]
        else:
            for k in range(4):
                for c in range(3):
                    colours_bar[i, 3 * k + c] = harmonics_bar[k, c]

    return pull_back_gaussians
