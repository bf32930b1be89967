"""Meshes as pictures with alpha: a z-buffer in NumPy, which needs neither OpenGL nor a screen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from npa_envs.ops import Cameras
from npa_envs.tasks.meshes import FloatArray, Mesh

LIGHT = (0.35, 0.80, 0.50)
"""Direction that light comes from, fixed in the world."""

AMBIENT = 0.6
"""Share of its colour that a surface shows where no light falls on it."""

SAMPLES = 2
"""Samples along each side of a pixel."""


def draw_mesh(mesh: Mesh, cameras: Cameras) -> NDArray[np.float32]:
    """Return pictures of a mesh, matt and lit from one side.

    Light stays where it is when a camera goes round, so all views show one coloured surface. Both
    sides of a triangle are seen. Triangles with a corner nearer than `cameras.near` are left out.

    Args:
        mesh: The mesh.
        cameras: V cameras, on any device.

    Returns:
        Red, green and blue, each times alpha, and alpha, in [0, 1], shape [V, H, W, 4]; the first
        row is the upper one.
    """
    light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    lit = AMBIENT + (1.0 - AMBIENT) * (mesh.normals() @ light).clip(0.0, 1.0)
    colours = mesh.colours * lit[:, None]
    motions = cameras.world_to_camera.double().cpu().numpy()
    lenses = cameras.intrinsics.double().cpu().expand(len(motions), 4).numpy()
    height, width = SAMPLES * cameras.height, SAMPLES * cameras.width
    pictures = []
    for motion, lens in zip(motions, SAMPLES * lenses, strict=True):
        seen = mesh.vertices @ motion[:3, :3].T + motion[:3, 3]
        front = (seen[mesh.faces][..., 2] >= cameras.near).all(axis=1)
        depth = np.maximum(seen[:, 2], cameras.near)
        place = seen[:, :2] / depth[:, None] * lens[:2] + lens[2:]
        fine = _draw(place, 1.0 / depth, colours, mesh.faces[front], height, width)
        coarse = fine.reshape(cameras.height, SAMPLES, cameras.width, SAMPLES, 4)
        pictures.append(coarse.mean(axis=(1, 3)))
    return np.stack(pictures).astype(np.float32)


def _draw(
    place: FloatArray,
    nearness: FloatArray,
    colours: FloatArray,
    faces: NDArray[np.int64],
    height: int,
    width: int,
) -> FloatArray:
    """Return red, green, blue and alpha of the nearest triangle at each pixel, [H, W, 4].

    Args:
        place: Where corners are on the picture [pixels], [K, 2].
        nearness: One over their depth, which is linear on the picture, [K].
        colours: Their colours, [K, 3].
        faces: Corners of each triangle, [F, 3].
        height: Pixels down.
        width: Pixels across.
    """
    corners = place[faces]
    low = np.maximum(np.floor(corners.min(axis=1) - 0.5).astype(np.int64), 0)
    high = np.minimum(np.ceil(corners.max(axis=1) - 0.5).astype(np.int64), (width - 1, height - 1))
    spans = (high - low + 1).max(axis=1)
    shown = (high >= low).all(axis=1)
    found: list[tuple[NDArray[np.int64], FloatArray, FloatArray]] = []
    # Triangles of about one size together, each on a square of pixels that holds it.
    side = 1
    while side < 2 * max(height, width):
        chosen = np.flatnonzero(shown & (spans > side // 2) & (spans <= side))
        for part in np.array_split(chosen, max(1, len(chosen) * side * side // 2**21)):
            if len(part):
                found.append(
                    _fragments(corners, nearness, colours, faces, part, low, side, (height, width))
                )
        side *= 2
    picture = np.zeros((height * width, 4))
    if found:
        pixel, near, colour = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.lexsort((-near, pixel))
        pixel, colour = pixel[order], colour[order]
        first = np.concatenate(([True], pixel[1:] != pixel[:-1]))
        picture[pixel[first], :3] = colour[first]
        picture[pixel[first], 3] = 1.0
    return picture.reshape(height, width, 4)


def _fragments(
    corners: FloatArray,
    nearness: FloatArray,
    colours: FloatArray,
    faces: NDArray[np.int64],
    part: NDArray[np.int64],
    low: NDArray[np.int64],
    side: int,
    size: tuple[int, int],
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Return pixel, nearness and colour wherever the triangles of `part` cover a pixel's middle."""
    offset = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="xy"), axis=-1)
    pixels = low[part][:, None] + offset.reshape(-1, 2)
    middle: FloatArray = pixels.astype(np.float64) + 0.5
    a, b, c = (corners[part, k][:, None] for k in range(3))
    opposite = [_cross(b, c, middle), _cross(c, a, middle), _cross(a, b, middle)]
    area = opposite[0][:, :1] + opposite[1][:, :1] + opposite[2][:, :1]
    turn = np.sign(area)
    inside = (area != 0.0) & (pixels[..., 0] < size[1]) & (pixels[..., 1] < size[0])
    for weight in opposite:
        inside &= weight * turn >= 0.0
    face, k = np.nonzero(inside)
    # Colours are linear in space: on the picture they are so once divided by the depth.
    weights = np.stack([weight[face, k] for weight in opposite], axis=-1) / area[face]
    share = weights * nearness[faces[part][face]]
    near = share.sum(axis=-1)
    colour = (share[..., None] * colours[faces[part][face]]).sum(axis=1) / near[:, None]
    return pixels[face, k, 1] * size[1] + pixels[face, k, 0], near, colour


def _cross(a: FloatArray, b: FloatArray, p: FloatArray) -> FloatArray:
    """Return twice the signed area of the triangles a, b, p."""
    area: FloatArray = (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1]) - (
        b[..., 1] - a[..., 1]
    ) * (p[..., 0] - a[..., 0])
    return area
