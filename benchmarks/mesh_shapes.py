"""Coloured meshes made by formulas: the built-in ones of the package, and parts for others.

`python benchmarks/mesh_shapes.py npa_envs/tasks/targets/built_in_meshes` writes the built-in files.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from npa_envs.tasks.targets.meshes import FloatArray, Mesh

ROUND = 48
"""Corners around the axis of a surface of revolution."""


def painted(vertices: FloatArray, faces: NDArray[np.int64], colours: FloatArray) -> Mesh:
    """Return a mesh with a colour for each vertex, [K, 3]."""
    return Mesh(vertices, faces, colours[faces])


def vertex_colours(mesh: Mesh) -> FloatArray:
    """Return the colour of each vertex of a mesh that `painted` made, [K, 3]."""
    colours = np.zeros_like(mesh.vertices)
    colours[mesh.faces] = mesh.colours
    return colours


def turned(
    profile: Sequence[tuple[float, float]],
    paint: Callable[[FloatArray], FloatArray],
    corners: int = ROUND,
) -> Mesh:
    """Return the surface of revolution of a profile (radius, y), from bottom to top."""
    rings = np.asarray(profile, dtype=np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    x = rings[:, :1] * np.sin(angle)
    z = rings[:, :1] * np.cos(angle)
    y = np.broadcast_to(rings[:, 1:], x.shape)
    vertices = np.stack((x, y, z), axis=-1).reshape(-1, 3)
    return painted(vertices, grid_faces(len(rings), corners, closed=False), paint(vertices))


def ellipsoid(
    centre: Sequence[float], radii: Sequence[float], colour: Sequence[float], turns: int = 18
) -> Mesh:
    """Return an ellipsoid of one colour with half-axes `radii`, made of `turns` rings."""
    tilt = np.linspace(-0.5 * np.pi, 0.5 * np.pi, turns)
    profile = [(float(np.cos(t)), float(np.sin(t))) for t in tilt]
    ball = turned(profile, lambda v: np.broadcast_to(np.asarray(colour, float), v.shape).copy())
    return Mesh(ball.vertices * np.asarray(radii) + np.asarray(centre), ball.faces, ball.colours)


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + k for part, k in zip(parts, starts, strict=True)]),
        np.concatenate([part.colours for part in parts]),
    )


def make_mushroom() -> Mesh:
    """Return a toadstool: a red cap with pale dots on a cream stem."""
    red, dot, cream, gill = (
        np.array(c)
        for c in ((0.85, 0.12, 0.10), (0.97, 0.93, 0.86), (0.93, 0.85, 0.68), (0.80, 0.62, 0.45))
    )
    around = np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False)
    dots = [np.array([np.sin(a) * 0.62, 0.62, np.cos(a) * 0.62]) for a in around]
    dots += [np.array([np.sin(a + 0.5) * 0.9, 0.2, np.cos(a + 0.5) * 0.9]) for a in around]
    dots.append(np.array([0.0, 1.0, 0.0]))

    def paint_cap(vertices: FloatArray) -> FloatArray:
        scaled = (vertices - (0.0, 0.25, 0.0)) / (0.8, 0.6, 0.8)
        colours = np.broadcast_to(red, vertices.shape).copy()
        for middle in dots:
            near = np.linalg.norm(scaled - middle / np.linalg.norm(middle), axis=1) < 0.24
            colours[near] = dot
        colours[vertices[:, 1] < 0.245] = gill
        return colours

    under = [(r, 0.24) for r in np.linspace(0.0, 0.8, 5)]
    tilt = np.linspace(0.0, 0.5 * np.pi, 40)
    over = [(0.8 * float(np.cos(t)), 0.25 + 0.6 * float(np.sin(t))) for t in tilt]
    height = np.linspace(-0.8, 0.3, 16)
    stem = [(0.0, -0.8)]
    stem += [(0.2 + 0.14 * float(((0.3 - h) / 1.1) ** 2), float(h)) for h in height]
    return joined(
        [
            turned([*under, *over], paint_cap, corners=3 * ROUND),
            turned(stem, lambda v: np.broadcast_to(cream, v.shape).copy()),
        ]
    )


def make_rocket() -> Mesh:
    """Return a rocket: white and red rings, a blue window, three orange fins."""
    white, red, steel = (
        np.array(c) for c in ((0.94, 0.94, 0.96), (0.80, 0.10, 0.14), (0.35, 0.37, 0.42))
    )

    def paint(vertices: FloatArray) -> FloatArray:
        y = vertices[:, 1]
        colours = np.broadcast_to(white, vertices.shape).copy()
        colours[(y > 0.52) | ((y > -0.30) & (y < -0.12))] = red
        colours[y < -0.60] = steel
        return colours

    height = np.linspace(-0.6, 1.0, 60)
    body = [(0.0, -0.78), (0.22, -0.78), (0.17, -0.62)]
    body += [(0.30 * float(np.sqrt(max(0.0, 1.0 - ((h + 0.1) / 1.1) ** 2))), h) for h in height]
    parts = [turned(body, paint), ellipsoid((0.0, 0.28, 0.25), (0.13, 0.13, 0.08), (0.2, 0.5, 0.9))]
    outline = np.array([(0.20, -0.15), (0.58, -0.62), (0.58, -0.92), (0.20, -0.62)])
    for turn in np.arange(3) * 2.0 * np.pi / 3.0 + np.pi:
        parts.append(_fin(outline, float(turn), 0.05, np.array([0.95, 0.55, 0.12])))
    return joined(parts)


def make_duck() -> Mesh:
    """Return a bath duck: yellow, with an orange bill and dark eyes."""
    yellow, bill, eye = (0.98, 0.82, 0.14), (0.95, 0.45, 0.08), (0.08, 0.08, 0.12)
    parts = [
        ellipsoid((0.0, -0.30, 0.0), (0.52, 0.40, 0.70), yellow),
        ellipsoid((0.0, 0.35, 0.35), (0.36, 0.36, 0.36), yellow),
        ellipsoid((0.0, -0.05, -0.66), (0.22, 0.16, 0.26), yellow),
        ellipsoid((0.0, 0.28, 0.74), (0.20, 0.07, 0.20), bill),
    ]
    for side in (-1.0, 1.0):
        parts.append(ellipsoid((0.19 * side, 0.48, 0.62), (0.07, 0.07, 0.07), eye))
        parts.append(ellipsoid((0.50 * side, -0.22, -0.08), (0.12, 0.24, 0.40), (0.90, 0.66, 0.08)))
    return joined(parts)


def make_doughnut() -> Mesh:
    """Return a doughnut: dough below, pink icing with sprinkles above."""
    along = np.linspace(0.0, 2.0 * np.pi, 2 * ROUND, endpoint=False)
    around = np.linspace(0.0, 2.0 * np.pi, ROUND, endpoint=False)
    u, v = np.meshgrid(along, around, indexing="ij")
    radius = 0.6 + 0.27 * np.cos(v)
    vertices = np.stack((radius * np.sin(u), 0.27 * np.sin(v), radius * np.cos(u)), axis=-1)
    icing = np.sin(v) > 0.05 + 0.18 * np.sin(5.0 * u)
    colours = np.where(icing[..., None], (0.94, 0.45, 0.62), (0.80, 0.55, 0.28))
    hues = np.array([(0.2, 0.75, 0.9), (0.98, 0.9, 0.25), (0.98, 0.98, 0.98), (0.35, 0.8, 0.35)])
    for k in range(18):
        row, column = (11 * k) % (2 * ROUND), ROUND // 4 + (7 * k) % 15 - 7
        colours[row : row + 3, column - 1 : column + 1] = hues[k % 4]
    faces = grid_faces(2 * ROUND, ROUND, closed=True)
    return painted(vertices.reshape(-1, 3), faces[:, ::-1].copy(), colours.reshape(-1, 3))


def grid_faces(rows: int, columns: int, *, closed: bool) -> NDArray[np.int64]:
    """Return the triangles of a grid, periodic in columns and, if `closed`, in rows; [F, 3]."""
    row, column = np.meshgrid(
        np.arange(rows if closed else rows - 1), np.arange(columns), indexing="ij"
    )
    below, right = (row + 1) % rows, (column + 1) % columns
    a, b = row * columns + column, row * columns + right
    c, d = below * columns + column, below * columns + right
    halves = (np.stack((a, b, d), axis=-1), np.stack((a, d, c), axis=-1))
    return np.concatenate([half.reshape(-1, 3) for half in halves])


def _fin(outline: FloatArray, turn: float, thickness: float, colour: FloatArray) -> Mesh:
    """Return a plate with an outline (radius, y), at an angle around the y axis."""
    outward = np.array([np.sin(turn), 0.0, np.cos(turn)])
    across = np.array([np.cos(turn), 0.0, -np.sin(turn)])
    flat = outline[:, :1] * outward + outline[:, 1:] * np.array([0.0, 1.0, 0.0])
    half = 0.5 * thickness * across
    # Each side has its own vertices, so that edges stay sharp.
    sides = [flat + half, flat - half]
    faces = [(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6)]
    vertices = [*sides]
    for k in range(4):
        near, far = flat[k], flat[(k + 1) % 4]
        start = 8 + 4 * k
        vertices.append(np.stack((near + half, near - half, far - half, far + half)))
        faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    corners = np.concatenate(vertices)
    colours = np.broadcast_to(colour, corners.shape).copy()
    return painted(corners, np.array(faces, dtype=np.int64), colours)


MESHES: Mapping[str, Callable[[], Mesh]] = {
    "doughnut": make_doughnut,
    "duck": make_duck,
    "mushroom": make_mushroom,
    "rocket": make_rocket,
}

if __name__ == "__main__":
    for name, make in MESHES.items():
        mesh = make()
        faces = mesh.faces.astype(np.uint16)
        path = Path(sys.argv[1]) / f"{name}.npz"
        np.savez_compressed(path, vertices=mesh.vertices, faces=faces, colours=vertex_colours(mesh))
