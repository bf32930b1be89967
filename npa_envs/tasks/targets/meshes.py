"""Coloured triangle meshes: built-in ones, and mesh files, and pictures of them by cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from npa_envs.atomic_files import home_path
from npa_envs.errors import NPAError, shown, suggest

if TYPE_CHECKING:
    from npa_envs.ops import Cameras
    from npa_envs.ops.pictures.triangles import TexturedFaces

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


# Pictures of meshes.

LIGHT = (0.35, 0.80, 0.50)
"""Direction towards the light, fixed in the world; it need not have length 1."""

AMBIENT = 0.6
"""Brightness of a surface that faces away from the light, where 1 is one that faces it."""

SAMPLES = 2
"""Number of samples along each side of a pixel."""

MAX_TEXELS, MAX_ALL_TEXELS = 2**24, 2**26
"""Maximum number of pixels of a texture, 4096 x 4096, and of all textures of a mesh together: those
with more are halved."""

BATCH_LIMIT = 2**22
"""Maximum number of samples, and of vertices, of the views that are drawn in one batch; a single
view may have more."""


def linear_light(colours: FloatArray) -> FloatArray:
    """Return the linear brightness of sRGB values in [0, 1]."""
    bright: FloatArray = ((colours + 0.055).clip(0.0) / 1.055) ** 2.4
    return np.where(colours <= 0.04045, colours / 12.92, bright)


def srgb_values(brightness: NDArray[Any]) -> NDArray[Any]:
    """Return the sRGB values in [0, 1] of linear brightnesses."""
    bright = 1.055 * brightness.clip(0.0) ** (1.0 / 2.4) - 0.055
    return np.where(brightness <= 0.0031308, 12.92 * brightness, bright)


def halved(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an sRGB picture [H, W, 3] at half its size, averaged in linear light."""
    size, channels = (max(pixels.shape[1] // 2, 1), max(pixels.shape[0] // 2, 1)), []
    for k in range(3):
        channel = Image.fromarray(_BRIGHTNESS.astype(np.float32)[pixels[..., k]])
        half = np.asarray(channel.resize(size, Image.Resampling.BOX))
        channels.append((255.0 * srgb_values(half)).round().astype(np.uint8))
    return np.stack(channels, axis=-1)


_BRIGHTNESS = linear_light(np.arange(256) / 255.0)


def _textured_faces(mesh: Mesh, light: FloatArray) -> TexturedFaces | None:
    """Return a mesh's textures with all their levels; `light`: brightness of each corner."""
    if mesh.texture_of_face is None or mesh.uv is None or (mesh.texture_of_face < 0).all():
        return None
    import torch

    from npa_envs.ops.pictures.triangles import WRAP_NUMBERS, TexturedFaces

    limit = min(MAX_TEXELS, MAX_ALL_TEXELS // len(mesh.textures))
    texels: list[NDArray[np.uint8]] = []
    headers: list[list[tuple[int, int, int]]] = []
    total = 0
    for texture in mesh.textures:
        pixels = texture.pixels
        while pixels[..., 0].size > limit:
            pixels = halved(pixels)
        headers.append([])
        while not headers[-1] or texels[-1].size > 3:
            headers[-1].append((total, pixels.shape[1], pixels.shape[0]))
            texels.append(pixels.reshape(-1, 3))
            total += len(texels[-1])
            pixels = halved(pixels)
    depth = max(map(len, headers))
    levels = [header + [(0, 0, 0)] * (depth - len(header)) for header in headers]
    wrap = [[WRAP_NUMBERS[side] for side in texture.wrap] for texture in mesh.textures]
    return TexturedFaces(
        torch.from_numpy(np.concatenate(texels)),
        torch.tensor(levels, dtype=torch.int32),
        torch.tensor(wrap, dtype=torch.int32),
        torch.from_numpy(_BRIGHTNESS),
        torch.from_numpy(mesh.texture_of_face.astype(np.int32)),
        torch.from_numpy(np.nan_to_num(mesh.uv).astype(np.float64, order="C").clip(-1e9, 1e9)),
        torch.from_numpy(light),
    )


def draw_mesh(mesh: Mesh, cameras: Cameras) -> NDArray[np.float32]:
    """Return pictures of a mesh by V cameras, [V, H, W, 4]: colours times alpha, alpha, in [0, 1].

    Surfaces are matt and lit from a direction fixed in the world. Textures finer than pixels are
    averaged in linear light. Both sides of triangles are visible. Triangles with a vertex nearer
    than `cameras.near` are left out. The top row is first.
    """
    # Reading a mesh needs neither, and their imports take seconds.
    import torch

    from npa_envs.ops.pictures.triangles import nearest_triangles

    light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    lit = AMBIENT + (1.0 - AMBIENT) * (mesh.normals() @ light).clip(0.0, 1.0)
    light = lit[mesh.faces]
    colours_of_corners = mesh.colours * light[..., None]
    textures = _textured_faces(mesh, light)
    if textures is not None:
        textured = textures.of_face.numpy() >= 0
        colours_of_corners[textured] = linear_light(mesh.colours[textured])
    # Copies: torch accepts no arrays with negative strides or read-only ones.
    colours, vertices = (
        torch.from_numpy(np.array(values, dtype=np.float64, order="C"))
        for values in (colours_of_corners, mesh.vertices)
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
            textures,
            width=width,
            height=height,
        )
        coarse = fine.view(-1, cameras.height, SAMPLES, cameras.width, SAMPLES, 4)
        pictures.append(coarse.mean(dim=(2, 4)).float())
    return torch.cat(pictures).numpy()
