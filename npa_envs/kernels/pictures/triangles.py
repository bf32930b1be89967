"""Pictures of coloured triangles: at every pixel the nearest one, by a depth buffer.

They are targets, drawn once on the CPU before training, in float64.
"""

import warp as wp

from npa_envs.kernels.native_functions import CAMERAS, in_ranges

module = wp.get_module("npa_envs.kernels.triangles")


@wp.func
def twice_area(a: wp.vec2d, b: wp.vec2d, p: wp.vec2d):
    """Return twice the signed area of the triangle a, b, p."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])


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
    # outputs
    nearest: wp.array2d[wp.float64],
    picture: wp.array2d[wp.vec4d],
):
    """Draw the triangles visible to a camera: at each pixel the nearest over its centre."""
    camera = range_start + wp.tid()
    zero, half = wp.float64(0.0), wp.float64(0.5)
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
                        picture[camera, pixel] = wp.vec4d(
                            colour[0], colour[1], colour[2], wp.float64(1.0)
                        )
