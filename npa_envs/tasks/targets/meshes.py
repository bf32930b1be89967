"""Coloured triangle meshes: built-in ones, and files read by trimesh; pictures of meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from npa_envs.atomic_files import check_regular, home_path
from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest
from npa_envs.ops import Cameras
from npa_envs.ops.pictures.triangles import nearest_triangles
from npa_envs.tasks.targets.images import no_foreign_programs

FloatArray = NDArray[np.float64]

RADIUS = 0.85
"""Largest distance from the origin to which every mesh is scaled [length units]."""

_MAX_FILE = 256 * 2**20
_SIZES = 1e-30, 1e30
_MIN_AREA = 1e-12

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Suffixes of mesh files."""

ROUND = 48
"""Corners around the axis of a surface of revolution."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with colours at their vertices; y is up."""

    vertices: FloatArray
    """Vertices [length units], shape [K, 3]."""

    faces: NDArray[np.int64]
    """Vertex indices of each triangle, counterclockwise from outside, shape [F, 3]."""

    colours: FloatArray
    """Red, green and blue of each vertex, in [0, 1], shape [K, 3]."""

    def fitted(self, radius: float = RADIUS) -> Mesh:
        """Return the mesh with its bounding box centred, scaled into a ball of `radius`."""
        used = self.vertices[np.unique(self.faces)]
        middle = 0.5 * (used.min(axis=0) + used.max(axis=0))
        farthest = np.linalg.norm(used - middle, axis=1).max()
        return Mesh((self.vertices - middle) * (radius / farthest), self.faces, self.colours)

    def normals(self) -> FloatArray:
        """Return unit normals at the vertices, weighted by the triangles' areas, shape [K, 3]."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        flat = np.cross(b - a, c - a)
        sums = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(sums, self.faces[:, k], flat)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        unit: FloatArray = np.divide(sums, length, out=np.zeros_like(sums), where=length > 0)
        return unit


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
    return Mesh(vertices, grid_faces(len(rings), corners, closed=False), paint(vertices))


def ellipsoid(
    centre: Sequence[float], radii: Sequence[float], colour: Sequence[float], turns: int = 18
) -> Mesh:
    """Return an ellipsoid of one colour with half-axes `radii`, made of `turns` rings."""
    tilt = np.linspace(-0.5 * np.pi, 0.5 * np.pi, turns)
    profile = [(float(np.cos(t)), float(np.sin(t))) for t in tilt]
    ball = turned(profile, lambda v: np.broadcast_to(np.asarray(colour, float), v.shape).copy())
    return Mesh(ball.vertices * np.asarray(radii) + np.asarray(centre), ball.faces, ball.colours)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + k for mesh, k in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.colours for mesh in meshes]),
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
    window = ellipsoid((0.0, 0.28, 0.25), (0.13, 0.13, 0.08), (0.2, 0.5, 0.9))
    meshes = [turned(body, paint), window]
    outline = np.array([(0.20, -0.15), (0.58, -0.62), (0.58, -0.92), (0.20, -0.62)])
    for turn in np.arange(3) * 2.0 * np.pi / 3.0 + np.pi:
        meshes.append(_fin(outline, float(turn), 0.05, np.array([0.95, 0.55, 0.12])))
    return joined(meshes)


def make_duck() -> Mesh:
    """Return a bath duck: yellow, with an orange bill and dark eyes."""
    yellow, bill, eye = (0.98, 0.82, 0.14), (0.95, 0.45, 0.08), (0.08, 0.08, 0.12)
    meshes = [
        ellipsoid((0.0, -0.30, 0.0), (0.52, 0.40, 0.70), yellow),
        ellipsoid((0.0, 0.35, 0.35), (0.36, 0.36, 0.36), yellow),
        ellipsoid((0.0, -0.05, -0.66), (0.22, 0.16, 0.26), yellow),
        ellipsoid((0.0, 0.28, 0.74), (0.20, 0.07, 0.20), bill),
    ]
    for side in (-1.0, 1.0):
        meshes.append(ellipsoid((0.19 * side, 0.48, 0.62), (0.07, 0.07, 0.07), eye))
        wing = (0.50 * side, -0.22, -0.08), (0.12, 0.24, 0.40), (0.90, 0.66, 0.08)
        meshes.append(ellipsoid(*wing))
    return joined(meshes)


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
    return Mesh(vertices.reshape(-1, 3), faces[:, ::-1].copy(), colours.reshape(-1, 3))


MESHES: Mapping[str, Callable[[], Mesh]] = {
    "doughnut": make_doughnut,
    "duck": make_duck,
    "mushroom": make_mushroom,
    "rocket": make_rocket,
}
"""The built-in meshes by name."""


def builtin_meshes() -> tuple[str, ...]:
    """Return the names of the meshes that come with the package, in alphabetical order."""
    return tuple(sorted(MESHES))


def load_mesh(source: str | Path) -> Mesh:
    """Return a built-in mesh or that of a file, scaled into a ball of radius 0.85."""
    if isinstance(source, str) and source in MESHES:
        return MESHES[source]().fitted()
    path = home_path(source)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise NPAError(
            f"target must be a built-in mesh, the path of a mesh file ({', '.join(MESH_SUFFIXES)}) "
            f"or a folder of views, got {shown(str(source))}: {suggest(source, MESHES)}"
        )
    check_regular(path, limit=_MAX_FILE, what="target")
    return _read_mesh(path).fitted()


def _read_mesh(path: Path) -> Mesh:
    try:
        import trimesh
    except ImportError as error:
        raise MissingDependencyError(
            f"reading the mesh {shown(str(path))} needs trimesh, which is not installed: "
            "pip install 'npa-envs[meshes]', or take a built-in mesh"
        ) from error
    try:
        with no_foreign_programs(), np.errstate(all="ignore"):
            read = trimesh.load(path, force="mesh", process=False)
            vertices = np.asarray(read.vertices, dtype=np.float64)
            faces = np.asarray(read.faces, dtype=np.int64)
            visual = read.visual.to_color() if hasattr(read.visual, "to_color") else read.visual
            colours = np.asarray(visual.vertex_colors, dtype=np.float64)[:, :3] / 255.0
    except Exception as error:
        # Its readers report damaged files by exceptions of many kinds.
        raise NPAError(
            f"target {shown(str(path))} cannot be read as a mesh ({type(error).__name__}: "
            f"{shown(error)}): save it again, for example as .ply or .glb"
        ) from error
    in_space = vertices.shape[1:] == (3,) and faces.shape[1:] == (3,)
    if not in_space or faces.size == 0 or vertices.size == 0 or not np.isfinite(vertices).all():
        raise NPAError(
            f"target {shown(str(path))} must hold triangles with finite corners, got {len(faces)} "
            f"triangles and {len(vertices)} corners: give a surface, not a point cloud"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise NPAError(
            f"the triangles of target {shown(str(path))} must have corners from 0 to "
            f"{len(vertices) - 1}, got {faces.min()} to {faces.max()}: save it again"
        )
    used = vertices[np.unique(faces)]
    extent = float((used.max(axis=0) / 2 - used.min(axis=0) / 2).max()) * 2
    if not _SIZES[0] <= extent <= _SIZES[1] or np.abs(used).max() > _SIZES[1]:
        raise NPAError(
            f"target {shown(str(path))} must lie within {_SIZES[1]:g} of the origin and be of a "
            f"size of at least {_SIZES[0]:g}, got a size of {extent:.3g}: scale it"
        )
    a, b, c = ((vertices[faces[:, k]] - used.min(axis=0)) / extent for k in range(3))
    if np.linalg.norm(np.cross(b - a, c - a), axis=1).max() < _MIN_AREA:
        raise NPAError(
            f"target {shown(str(path))} must have a surface, but the corners of every triangle "
            "lie on a line: give triangles with an area"
        )
    if colours.shape != vertices.shape or not np.isfinite(colours).all():
        colours = np.full(vertices.shape, 0.6)
    return Mesh(vertices, faces, colours)


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
    return Mesh(corners, np.array(faces, dtype=np.int64), colours)


# Pictures of meshes.

LIGHT = (0.35, 0.80, 0.50)
"""Direction towards the light, fixed in the world."""

AMBIENT = 0.6
"""Brightness of a surface that faces away from the light, as a fraction."""

SAMPLES = 2
"""Samples along each side of a pixel."""

BATCH_LIMIT = 2**22
"""Largest number of samples, of vertices, and of triangles' vertices of views that are drawn in one
batch; a single view may have more."""


def draw_mesh(mesh: Mesh, cameras: Cameras) -> NDArray[np.float32]:
    """Return pictures of a mesh [V, H, W, 4]: colours times alpha, and alpha, in [0, 1].

    Surfaces are matt and lit from a direction that is fixed in the world. Both sides of a triangle
    are visible. Triangles with a vertex nearer than `cameras.near` are left out. The first row is
    the top.
    """
    light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    lit = AMBIENT + (1.0 - AMBIENT) * (mesh.normals() @ light).clip(0.0, 1.0)
    # Copies: torch accepts no arrays with negative strides or read-only ones.
    colours, vertices = (
        torch.from_numpy(np.array(values, dtype=np.float64, order="C"))
        for values in (mesh.colours * lit[:, None], mesh.vertices)
    )
    faces = torch.from_numpy(np.array(mesh.faces, dtype=np.int64, order="C"))
    motions = cameras.world_to_camera.double().cpu()
    lenses = SAMPLES * cameras.intrinsics.double().cpu().expand(len(motions), 4)[:, None]
    height, width = SAMPLES * cameras.height, SAMPLES * cameras.width
    batch_size = max(1, BATCH_LIMIT // max(height * width, len(vertices), 3 * len(faces)))
    pictures = []
    batches = (torch.split(each, batch_size) for each in (motions, lenses))
    for motion, lens in zip(*batches, strict=True):
        local = vertices @ motion[:, :3, :3].mT + motion[:, None, :3, 3]
        depth = local[..., 2].clamp(min=cameras.near)
        fine = nearest_triangles(
            local[..., :2] / depth[..., None] * lens[..., :2] + lens[..., 2:],
            1.0 / depth,
            colours,
            faces,
            (local[..., 2] >= cameras.near)[:, faces].all(dim=-1),
            width=width,
            height=height,
        )
        coarse = fine.view(-1, cameras.height, SAMPLES, cameras.width, SAMPLES, 4)
        pictures.append(coarse.mean(dim=(2, 4)).float())
    return torch.cat(pictures).numpy()
