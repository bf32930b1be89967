"""Pictures of coloured or textured triangles: at every pixel the nearest one, by a depth buffer.

They are targets, drawn once on the CPU before training, in float64. A texture has levels, each half
as wide and high as the one before. A pixel's colour is the mean of samples along the longer axis of
its footprint on the texture; they are taken from the two levels whose texels are about as wide as
the shorter axis, so that textures finer than pixels are averaged.
"""

import warp as wp

from npa_envs.kernels.native_functions import CAMERAS, in_ranges

module = wp.get_module("npa_envs.kernels.triangles")

WRAPS = ("repeat", "mirror", "clamp")
"""What a texture shows beyond its edges: itself again, itself mirrored, or its edge."""


@wp.func
def twice_area(a: wp.vec2d, b: wp.vec2d, p: wp.vec2d):
    """Return twice the signed area of the triangle a, b, p."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])


@wp.struct
class Textures:
    """Pictures on triangles."""

    texels: wp.array[wp.vec3ub]
    """Texels of all levels of all textures, sRGB, row by row."""
    levels: wp.array2d[wp.vec3i]
    """First texel, width and height of each level of each texture, from the finest; 0: none."""
    wrap: wp.array[wp.vec2i]
    """What each texture shows beyond its edges, by `WRAPS`, along u and v."""
    brightness: wp.array[wp.float64]
    """Linear brightness of each of the 256 sRGB values."""


@wp.func
def wrapped(place: wp.float64, wrap: int):
    """Return a place in [0, 1] with the same colour."""
    one, two = wp.float64(1.0), wp.float64(2.0)
    if wrap == wp.static(WRAPS.index("repeat")):
        return place - wp.floor(place)
    if wrap == wp.static(WRAPS.index("mirror")):
        return one - wp.abs(place - two * wp.floor(place / two) - one)
    return wp.clamp(place, wp.float64(0.0), one)


@wp.func
def neighbours(place: wp.float64, wrap: int, size: int):
    """Return the two texels of a row of `size` nearest to a place, and the second's share."""
    along = wrapped(place, wrap) * wp.float64(size) - wp.float64(0.5)
    low = wp.int32(wp.floor(along))
    share = along - wp.floor(along)
    high = low + 1
    if wrap == wp.static(WRAPS.index("repeat")):
        low, high = (low + size) % size, high % size
    # Places that are no numbers must not read beyond the array.
    return wp.clamp(low, 0, size - 1), wp.clamp(high, 0, size - 1), share


@wp.func
def texel(textures: Textures, k: int):
    """Return a texel's linear colour."""
    stored = textures.texels[k]
    return wp.vec3d(
        textures.brightness[wp.int32(stored[0])],
        textures.brightness[wp.int32(stored[1])],
        textures.brightness[wp.int32(stored[2])],
    )


@wp.func
def level_colour(textures: Textures, texture: int, level: int, place: wp.vec2d):
    """Return the linear colour of one level, interpolated between four texels."""
    header, wrap, one = textures.levels[texture, level], textures.wrap[texture], wp.float64(1.0)
    left, right, x = neighbours(place[0], wrap[0], header[1])
    top, bottom, y = neighbours(place[1], wrap[1], header[2])
    upper, lower = header[0] + top * header[1], header[0] + bottom * header[1]
    return (one - y) * (
        (one - x) * texel(textures, upper + left) + x * texel(textures, upper + right)
    ) + y * ((one - x) * texel(textures, lower + left) + x * texel(textures, lower + right))


@wp.func
def texture_colour(
    textures: Textures, texture: int, place: wp.vec2d, across: wp.vec2d, down: wp.vec2d
):
    """Return a texture's linear colour around a place.

    `across` and `down`: how far the place moves within a pixel's width and height.
    """
    finest = textures.levels[texture, 0]
    size = wp.vec2d(wp.float64(finest[1]), wp.float64(finest[2]))
    wide, high = wp.length(wp.cw_mul(across, size)), wp.length(wp.cw_mul(down, size))
    longer, axis = wide, across
    if high > wide:
        longer, axis = high, down
    last = textures.levels.shape[1] - 1
    while textures.levels[texture, last][1] == 0:
        last -= 1
    # Also of triangles with nearly no area, whose footprints may be no numbers.
    longest = wp.float64(1 << 30)
    if not wide + high <= longest:
        longer, axis = longest, wp.vec2d()
    shorter = wp.max(wp.min(wide, high), wp.float64(1.0))
    count = wp.int32(wp.ceil(wp.clamp(longer / shorter, wp.float64(1.0), wp.float64(16.0))))
    depth = wp.log2(wp.max(longer / wp.float64(count), wp.float64(1.0)))
    fine = wp.min(wp.int32(depth), last)
    coarse = wp.min(fine + 1, last)
    share = depth - wp.floor(depth)
    total = wp.vec3d()
    for k in range(count):
        part = (wp.float64(k) + wp.float64(0.5)) / wp.float64(count) - wp.float64(0.5)
        sampled = place + part * axis
        total += (wp.float64(1.0) - share) * level_colour(textures, texture, fine, sampled)
        if share > wp.float64(0.0):
            total += share * level_colour(textures, texture, coarse, sampled)
    return total / wp.float64(count)


@wp.func
def encoded(value: wp.float64):
    """Return the sRGB value of a linear brightness."""
    if value <= wp.float64(0.0031308):
        return wp.float64(12.92) * value
    power = wp.pow(value, wp.float64(1.0) / wp.float64(2.4))
    return wp.float64(1.055) * power - wp.float64(0.055)


@in_ranges(CAMERAS)
@wp.kernel(enable_backward=False, module=module)
def draw_triangles(
    range_start: int,
    width: int,
    height: int,
    positions: wp.array2d[wp.vec2d],
    nearness: wp.array2d[wp.float64],
    colours: wp.array2d[wp.vec3d],
    faces: wp.array[wp.vec3i],
    visible: wp.array2d[wp.uint8],
    texels: wp.array[wp.vec3ub],
    levels: wp.array2d[wp.vec3i],
    wrap: wp.array[wp.vec2i],
    brightness: wp.array[wp.float64],
    texture_of_face: wp.array[wp.int32],
    places: wp.array2d[wp.vec2d],
    light: wp.array2d[wp.float64],
    # outputs
    nearest: wp.array2d[wp.float64],
    picture: wp.array2d[wp.vec4d],
):
    """Draw the triangles visible to a camera: at each pixel the nearest over its centre."""
    camera = range_start + wp.tid()
    zero, half = wp.float64(0.0), wp.float64(0.5)
    textures = Textures(texels, levels, wrap, brightness)
    for face in range(faces.shape[0]):
        if visible[camera, face] == wp.uint8(0):
            continue
        corners = faces[face]
        a = positions[camera, corners[0]]
        b = positions[camera, corners[1]]
        c = positions[camera, corners[2]]
        area = twice_area(a, b, c)
        if area == zero:
            continue
        low = wp.min(wp.min(a, b), c)
        high = wp.max(wp.max(a, b), c)
        # Bounded before they become integers.
        left = wp.int32(wp.floor(wp.clamp(low[0] - half, zero, wp.float64(width))))
        top = wp.int32(wp.floor(wp.clamp(low[1] - half, zero, wp.float64(height))))
        right = wp.int32(wp.ceil(wp.clamp(high[0] - half, -half, wp.float64(width - 1))))
        bottom = wp.int32(wp.ceil(wp.clamp(high[1] - half, -half, wp.float64(height - 1))))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                middle = wp.vec2d(wp.float64(column) + half, wp.float64(row) + half)
                # Inside, all three areas have the sign of the total; edges count as inside.
                u = twice_area(b, c, middle) / area
                v = twice_area(c, a, middle) / area
                w = twice_area(a, b, middle) / area
                if u >= zero and v >= zero and w >= zero:
                    # Quantities divided by the depth are linear on the picture.
                    u *= nearness[camera, corners[0]]
                    v *= nearness[camera, corners[1]]
                    w *= nearness[camera, corners[2]]
                    near = u + v + w
                    pixel = row * width + column
                    if near > nearest[camera, pixel]:
                        nearest[camera, pixel] = near
                        colour = (
                            u * colours[face, 0] + v * colours[face, 1] + w * colours[face, 2]
                        ) / near
                        if face < texture_of_face.shape[0] and texture_of_face[face] >= 0:
                            first = places[face, 0]
                            second = places[face, 1]
                            third = places[face, 2]
                            place = (u * first + v * second + w * third) / near
                            # Places move as their shares of `near` do.
                            turn_u = nearness[camera, corners[0]] / area * (first - place) / near
                            turn_v = nearness[camera, corners[1]] / area * (second - place) / near
                            turn_w = nearness[camera, corners[2]] / area * (third - place) / near
                            sample = texture_colour(
                                textures,
                                texture_of_face[face],
                                place,
                                (b[1] - c[1]) * turn_u
                                + (c[1] - a[1]) * turn_v
                                + (a[1] - b[1]) * turn_w,
                                (c[0] - b[0]) * turn_u
                                + (a[0] - c[0]) * turn_v
                                + (b[0] - a[0]) * turn_w,
                            )
                            lit = (
                                u * light[face, 0] + v * light[face, 1] + w * light[face, 2]
                            ) / near
                            for channel in range(3):
                                colour[channel] = lit * encoded(colour[channel] * sample[channel])
                        picture[camera, pixel] = wp.vec4d(
                            colour[0], colour[1], colour[2], wp.float64(1.0)
                        )
