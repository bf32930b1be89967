"""Coloured triangle meshes: built-in ones, and mesh files, and pictures of them by cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from npa_envs.atomic_files import home_path
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.ops import Cameras
from npa_envs.ops.pictures.triangles import nearest_triangles

FloatArray = NDArray[np.float64]

RADIUS = 0.85
"""Radius of the ball around the origin into which every mesh is scaled [length units]."""

MAX_FILE = 256 * 2**20
"""Maximum size of a mesh file, and of each file that it names [bytes]."""

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Suffixes of mesh files."""


Wrap = Literal["repeat", "mirror", "clamp"]
"""What a texture shows beyond its edges: itself again, itself mirrored, or its edge."""


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture that lies on triangles."""

    pixels: NDArray[np.uint8]
    """Red, green and blue, sRGB, in [0, 255], shape [H, W, 3]; the first row is the upper one."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """What it shows beyond its left and right edges (u), and beyond upper and lower ones (v)."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with colours or textures; y is up."""

    vertices: FloatArray
    """Vertices [length units], shape [K, 3]."""
    faces: NDArray[np.int64]
    """Vertex indices of each triangle, counterclockwise from outside, shape [F, 3]."""
    colours: FloatArray
    """Red, green and blue at each corner of each triangle, sRGB, in [0, 1], shape [F, 3, 3]. On a
    triangle with a texture they multiply the texture in linear light: white leaves it as it is."""
    uv: FloatArray | None = None
    """Place in the texture of each corner of each triangle, shape [F, 3, 2]: (0, 0) is the upper
    left corner of the picture, and (1, 1) the lower right one. None: no triangle has a texture."""
    texture_of_face: NDArray[np.int64] | None = None
    """Index of each triangle's texture, -1 for none, shape [F]. None: none has one."""
    textures: tuple[Texture, ...] = ()
    """The textures."""
    summary: str = ""
    """What was read, in one line."""

    def fitted(self, radius: float = RADIUS) -> Mesh:
        """Return the mesh with its bounding box centred at 0, scaled into a ball of `radius`."""
        used = self.vertices[np.unique(self.faces)]
        middle = 0.5 * (used.min(axis=0) + used.max(axis=0))
        farthest = np.linalg.norm(used - middle, axis=1).max()
        return replace(self, vertices=(self.vertices - middle) * (radius / farthest))

    def normals(self) -> FloatArray:
        """Return unit normals at vertices, means over triangles weighted by area, shape [K, 3]."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        flat = np.cross(b - a, c - a)
        sums = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(sums, self.faces[:, k], flat)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        unit: FloatArray = np.divide(sums, length, out=np.zeros_like(sums), where=length > 0)
        return unit


MESHES = {path.stem: path for path in (Path(__file__).parent / "built_in_meshes").glob("*.npz")}
"""The files of the built-in meshes by name; `benchmarks/mesh_shapes.py` makes them."""


def builtin_meshes() -> tuple[str, ...]:
    """Return the names of the meshes that come with the package, in alphabetical order."""
    return tuple(sorted(MESHES))


def load_mesh(source: str | Path) -> Mesh:
    """Return a built-in mesh, by name, or the mesh in a file, scaled into a ball of radius 0.85."""
    if isinstance(source, str) and source in MESHES:
        with np.load(MESHES[source]) as file:
            faces = file["faces"].astype(np.int64)
            return Mesh(file["vertices"], faces, file["colours"][faces]).fitted()
    path = home_path(source)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise NPAError(
            f"target must be a built-in mesh, the path of a mesh file ({', '.join(MESH_SUFFIXES)}) "
            f"or a folder of views, got {shown(str(source))}: {suggest(source, MESHES)}"
        )
    # The readers make meshes.
    from npa_envs.tasks.targets.mesh_files import read_mesh

    return read_mesh(path).fitted()


# Pictures of meshes.

LIGHT = (0.35, 0.80, 0.50)
"""Direction towards the light, fixed in the world; it need not have length 1."""

AMBIENT = 0.6
"""Brightness of a surface that faces away from the light, where 1 is one that faces it."""

SAMPLES = 2
"""Number of samples along each side of a pixel."""

BATCH_LIMIT = 2**22
"""Maximum number of samples, and of vertices, of the views that are drawn in one batch; a single
view may have more."""


def draw_mesh(mesh: Mesh, cameras: Cameras) -> NDArray[np.float32]:
    """Return pictures of a mesh by V cameras, [V, H, W, 4]: colours times alpha, alpha, in [0, 1].

    Surfaces are matt and lit from a direction fixed in the world. Both sides of triangles are
    visible. Triangles with a vertex nearer than `cameras.near` are left out. The top row is first.
    """
    light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    lit = AMBIENT + (1.0 - AMBIENT) * (mesh.normals() @ light).clip(0.0, 1.0)
    # Copies: torch accepts no arrays with negative strides or read-only ones.
    colours, vertices = (
        torch.from_numpy(np.array(values, dtype=np.float64, order="C"))
        for values in (mesh.colours * lit[mesh.faces][..., None], mesh.vertices)
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
