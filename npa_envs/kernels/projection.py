"""How 3D Gaussians lie on a picture: types, sizes, and the functions that projection is made of.

Sources: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", and
Zwicker et al. 2002, "EWA Splatting". A Gaussian of mean p and covariance P = (R S)(R S)ᵀ (Kerbl,
equation 6) lies at c = W p + t in a camera's frame and at (fx x/z + cx, fy y/z + cy) on its
picture. There its covariance is Q⁻¹ = J W P Wᵀ Jᵀ + dilation (Kerbl, equation 5), where J is the
projection's derivative at c, the local affine approximation (Zwicker).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

TILE = 16
"""Pixels along each side of a tile."""

CHANNELS = 4
"""Colour channels of a footprint; pictures may have fewer."""

FOOTPRINT = 12
"""Entries of a footprint: mean (2), conic Q (3: xx, xy, yy), opacity, colours (4), reach (2)."""

PULLS = 10
"""Entries of a pull, the cotangents that a tile has for a Gaussian: with weights α ᾱ and the way d
to a pixel, the sums of 1, dx, dy, dx dx, dx dy, dy dy; cotangents of the colours (4)."""

SMALLEST_ALPHA = 1.0 / 255.0
"""What covers less of a pixel is left out, as by Kerbl's rasterizer."""

CLAMP_MARGIN = 0.3
"""J is taken at most this share of the picture's half outside of it: far outside, the affine
approximation makes Gaussians that fill the picture (as Kerbl's implementation does)."""

REACH_SLACK = 1e-3
"""Added to the exponent at which a Gaussian ends: rounding must not cut a pixel off."""

HARMONIC_0, HARMONIC_1 = 0.28209479177387814, 0.4886025119029199
"""Factors of the real spherical harmonics of degree 0 and 1."""


@functools.cache
def gaussian_types(scalar: type) -> SimpleNamespace:
    """Return the `Frame` struct and the vector and matrix types of one scalar type."""

    @wp.struct
    class Frame:
        particle_count: wp.int32
        view_count: wp.int32
        width: wp.int32
        height: wp.int32
        tile_columns: wp.int32
        tile_count: wp.int32
        channels: wp.int32
        near: scalar
        dilation: scalar

    return SimpleNamespace(
        Frame=Frame,
        pair=wp.types.vector(2, scalar),
        triple=wp.types.vector(3, scalar),
        quad=wp.types.vector(4, scalar),
        footprint=wp.types.vector(FOOTPRINT, scalar),
        pulls=wp.types.vector(PULLS, scalar),
        square=wp.types.matrix((2, 2), scalar),
        flat=wp.types.matrix((2, 3), scalar),
        cube=wp.types.matrix((3, 3), scalar),
        motion=wp.types.matrix((4, 4), scalar),
        harmonics=wp.types.matrix((4, 3), scalar),
    )


@functools.lru_cache(maxsize=256)
def make_frame(
    scalar: type,
    shape: tuple[int, int, int],
    sizes: tuple[int, int],
    near: float,
    dilation: float,
) -> Any:
    """Return the `Frame` of a batch of pictures.

    Args:
        scalar: `wp.float32` or `wp.float64`.
        shape: Particles N of a world, views V of a world, and colour channels K of a picture.
        sizes: Pixels across and down.
        near: Nothing nearer is seen [length units].
        dilation: Added to both variances on the picture [pixels squared].
    """
    frame = gaussian_types(scalar).Frame()
    frame.particle_count, frame.view_count, frame.channels = shape
    frame.width, frame.height = sizes
    frame.tile_columns = -(-frame.width // TILE)
    frame.tile_count = tile_total(*sizes)
    frame.near = near
    frame.dilation = dilation
    return frame


def tile_total(width: int, height: int) -> int:
    """Return how many tiles cover a picture."""
    return -(-width // TILE) * -(-height // TILE)


@functools.cache
def projection_functions(scalar: type) -> SimpleNamespace:
    """Return Warp functions of one scalar type."""
    types = gaussian_types(scalar)
    Frame, pair, triple, quad = types.Frame, types.pair, types.triple, types.quad
    flat, cube, motion_type = types.flat, types.cube, types.motion
    footprint_type, harmonics_type = types.footprint, types.harmonics

    @wp.func
    def unit_quaternion(quaternion: quad):
        """A quaternion of length 1, no rotation for one of length 0; one over its length, or 0."""
        unit = quad(scalar(1.0), scalar(0.0), scalar(0.0), scalar(0.0))
        inverse = scalar(0.0)
        length = wp.length(quaternion)
        # Not >, which would make a rotation of what is not a number.
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
        """Cotangent of a quaternion of length 1 from that of its rotation."""
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
        """A ratio x/z as J takes it."""
        margin = scalar(wp.static(0.5 * CLAMP_MARGIN)) * size
        return wp.clamp(ratio, (-middle - margin) / focal, (size - middle + margin) / focal)

    @wp.func
    def limited_ratios(frame: Frame, lens: quad, place: triple):
        return pair(
            limited(place[0] / place[2], lens[0], lens[2], scalar(frame.width)),
            limited(place[1] / place[2], lens[1], lens[3], scalar(frame.height)),
        )

    @wp.func
    def jacobian_of(frame: Frame, lens: quad, place: triple):
        """J, the derivative of the place on the picture by that in the camera's frame."""
        ratios = limited_ratios(frame, lens, place)
        x = lens[0] / place[2]
        y = lens[1] / place[2]
        return flat(x, scalar(0.0), -x * ratios[0], scalar(0.0), y, -y * ratios[1])

    @wp.func
    def scaled_columns(matrix: cube, scale: triple):
        result = cube()
        for row in range(3):
            for column in range(3):
                result[row, column] = matrix[row, column] * scale[column]
        return result

    @wp.func
    def outlook(motion: motion_type, mean: triple):
        """Way from the camera to a mean, whose direction colours depend on [length units]."""
        return mean + wp.transpose(rotation_part(motion)) * shift_part(motion)

    @wp.func
    def harmonics_at(colours: wp.array(dtype=scalar, ndim=2), i: wp.int32):
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
    def colours_of(
        colours: wp.array(dtype=scalar, ndim=2), i: wp.int32, motion: motion_type, mean: triple
    ):
        """A Gaussian's colours, zeros beyond its last one; of spherical harmonics if it has 12."""
        result = quad()
        if colours.shape[1] <= wp.static(CHANNELS):
            for c in range(wp.static(CHANNELS)):
                if c < colours.shape[1]:
                    result[c] = colours[i, c]
        else:
            basis = harmonic_basis(wp.normalize(outlook(motion, mean)))
            seen = basis * harmonics_at(colours, i)
            for c in range(3):
                value = seen[c] + scalar(0.5)
                # Not wp.max, which would make a colour of what is not a number.
                result[c] = wp.where(value < scalar(0.0), scalar(0.0), value)
        return result

    @wp.func
    def covered(middle: scalar, reach: scalar, size: wp.int32):
        """First pixel along one direction whose middle is within reach, and one past the last."""
        end = scalar(size)
        first = wp.ceil(wp.clamp(middle - reach - scalar(0.5), scalar(0.0), end))
        last = wp.floor(wp.clamp(middle + reach + scalar(0.5), scalar(0.0), end))
        return wp.int32(first), wp.int32(last)

    @wp.func
    def covered_tiles(frame: Frame, footprint: footprint_type):
        """First column and row of the tiles that a footprint covers, and one past the last."""
        left, right = covered(footprint[0], footprint[10], frame.width)
        top, bottom = covered(footprint[1], footprint[11], frame.height)
        result = wp.vec4i()
        if left < right and top < bottom:
            size = wp.static(TILE)
            result = wp.vec4i(
                left / size, top / size, (right - 1) / size + 1, (bottom - 1) / size + 1
            )
        return result

    return SimpleNamespace(
        unit_quaternion=unit_quaternion,
        rotation_of=rotation_of,
        pull_back_rotation=pull_back_rotation,
        rotation_part=rotation_part,
        shift_part=shift_part,
        limited_ratios=limited_ratios,
        jacobian_of=jacobian_of,
        scaled_columns=scaled_columns,
        outlook=outlook,
        harmonics_at=harmonics_at,
        harmonic_basis=harmonic_basis,
        colours_of=colours_of,
        covered=covered,
        covered_tiles=covered_tiles,
    )
