"""Coloured triangle meshes: built-in ones, and mesh files. They need no torch, a slow import."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from npa_envs.atomic_files import home_path
from npa_envs.errors import NPAError, shown, suggest

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
class MeshTexture:
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
    textures: tuple[MeshTexture, ...] = ()
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


def linear_light(colours: FloatArray) -> FloatArray:
    """Return the linear brightness of sRGB values in [0, 1]."""
    bright: FloatArray = ((colours + 0.055).clip(0.0) / 1.055) ** 2.4
    return np.where(colours <= 0.04045, colours / 12.92, bright)


def srgb_values(brightness: NDArray[Any]) -> NDArray[Any]:
    """Return the sRGB values in [0, 1] of linear brightnesses."""
    bright = 1.055 * brightness.clip(0.0) ** (1.0 / 2.4) - 0.055
    return np.where(brightness <= 0.0031308, 12.92 * brightness, bright)
