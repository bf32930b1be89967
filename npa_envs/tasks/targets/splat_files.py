"""Point clouds and trained Gaussians in PLY files, as 3D Gaussians, and pictures of them."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from npa_envs.atomic_files import open_regular, read_bytes
from npa_envs.errors import importing, shown
from npa_envs.ops import Cameras, render_gaussians
from npa_envs.tasks.gaussian_outputs import HARMONIC_0
from npa_envs.tasks.targets.mesh_files import PlyProperty, ply_colours, read_ply
from npa_envs.tasks.targets.mesh_parts import MeshFile
from npa_envs.tasks.targets.meshes import MAX_FILE, RADIUS, FloatArray

Element = dict[str, PlyProperty]

NEIGHBOURS = 8
"""Number of neighbours of a point that say how large its Gaussian is, and which way it lies."""

POINT_SIGMA = 0.6
"""Standard deviation of a point's Gaussian in multiples of the distance between points (the square
root of the area of a surface for each). 0.5 and 0.7 give pictures 0.8 dB farther from the surface's
(20 000 points of the mushroom, views of 96 pixels)."""

FLATTEST = 0.1
"""Smallest standard deviation across the surface, relative to the one along it. Round Gaussians
give pictures 4 dB farther from the surface's."""

POINT_OPACITY = 0.99
"""Opacity in the middle of a point's Gaussian."""

MAX_POINTS = 2**18
"""Maximum number of points of a cloud, two for each pixel's width of a view of 192 pixels; evenly
spaced ones are taken of more."""

SAMPLES = 4
"""Samples along each side of a pixel: Gaussians are blurred by half a sample, not half a pixel."""

MAX_SIDE = 4096
"""Maximum number of samples along a side of a picture; large pictures have fewer in a pixel."""

VISIBLE_OPACITY = 0.1
"""Gaussians of this opacity at least say where a scene is, and how large."""

STRAY = 4.0
"""What is farther from the middle than this times 98 % of the scene is left out."""

GAUSSIAN_NAMES = (
    *"xyz", "opacity", *(f"f_dc_{k}" for k in range(3)), *(f"scale_{k}" for k in range(3)),
    *(f"rot_{k}" for k in range(4)),
)  # fmt: skip
"""Properties of each trained Gaussian (Kerbl et al. 2023), beside `f_rest_0` and so on."""

_HEADER = 2**16
_REST = (0, 9, 24, 45)
_TRAINED = {"opacity", "scale_0", "rot_0"}


@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """N 3D Gaussians; y is up."""

    means: Tensor
    """Middles [length units], shape [N, 3]."""
    scales: Tensor
    """Standard deviations along the Gaussians' own axes [length units], shape [N, 3]."""
    quaternions: Tensor
    """Rotations of these axes (w, x, y, z), shape [N, 4]."""
    opacities: Tensor
    """Opacity in the middle, shape [N]."""
    harmonics: Tensor
    """Coefficients of real spherical harmonics of degree 0, 1, 2 or 3 for red, green and blue,
    sRGB minus 0.5, shape [N, 1, 4, 9 or 16, 3]."""
    summary: str = ""
    """What was read, in one line."""


def ply_kind(path: Path) -> str:
    """Return what a PLY file holds by its header: "triangles", "gaussians" or "points".

    Files without a whole header count as triangles.
    """
    with open_regular(path, limit=MAX_FILE, what="target") as file:
        header, end, _ = file.read(_HEADER).partition(b"end_header")
    text = header.decode("latin-1")
    counts = re.findall(r"(?<=[\r\n])element\s+(\w+)\s+(\d+)\s", text)
    rows = {name: int(count) for name, count in counts}
    names = set(re.findall(r"(?<=[\r\n])property\s+\w+\s+(\w+)\s", text))
    if not end or any(rows.get(name) for name in ("face", "tristrips")) or not rows.get("vertex"):
        return "triangles"
    trained = names >= _TRAINED or "packed_position" in names
    return "gaussians" if trained else "points"


def read_splats(path: Path) -> GaussianCloud:
    """Return the point cloud or the trained Gaussians in a PLY file, in a ball of radius 0.85.

    The bounding box of the points, or of the middles of visible Gaussians, is centred at 0.
    """
    file = MeshFile(path)
    with file.reading("points or Gaussians"):
        vertex = read_ply(read_bytes(path, limit=MAX_FILE, what="target"))[0]["vertex"]
        if "packed_position" in vertex:
            raise file.error("is compressed (packed_position): save it as an ordinary PLY")
        read = _trained_gaussians if vertex.keys() >= _TRAINED else _points
        return read(file, vertex)


def _columns(file: MeshFile, vertex: Element, names: tuple[str, ...]) -> FloatArray:
    """Return properties of all points, [N, any]."""
    missing = [name for name in names if name not in vertex]
    if missing:
        raise file.error(f"must have the properties {', '.join(names)}: {missing[0]} is missing")
    return np.stack([vertex[name].values.astype(np.float64) for name in names], axis=1)


def _trained_gaussians(file: MeshFile, vertex: Element) -> GaussianCloud:
    """Return trained Gaussians, whose scales are logarithms and whose opacities are logits."""
    table = _columns(file, vertex, GAUSSIAN_NAMES)
    rest = sum(name.startswith("f_rest_") for name in vertex)
    if rest not in _REST:
        raise file.error(
            "must have 0, 9, 24 or 45 properties f_rest_0, f_rest_1 ..., for spherical harmonics "
            f"of degree 0 to 3, got {rest}"
        )
    degree = _REST.index(rest)
    harmonics = table[:, None, 4:7]
    if degree:
        # Of each colour one after another.
        others = _columns(file, vertex, tuple(f"f_rest_{k}" for k in range(rest)))
        others = others.reshape(len(table), 3, rest // 3).swapaxes(1, 2)
        harmonics = np.concatenate((harmonics, others), axis=1)
    opacities, scales = 1.0 / (1.0 + np.exp(-table[:, 3])), np.exp(table[:, 7:10])
    summary = f"{file.path.name}: {len(table)} Gaussians, spherical harmonics of degree {degree}"
    columns = (table[:, :3], scales, table[:, 10:], opacities, harmonics)
    return _fitted(file, "Gaussians", columns, summary)


def _points(file: MeshFile, vertex: Element) -> GaussianCloud:
    """Return a point cloud: each point as a Gaussian that is flat where its neighbours are."""
    hint = "pip install 'npa-envs[meshes]', or give triangles"
    with importing("scipy", f"reading the points of {shown(str(file.path))}", hint):
        from scipy.spatial import KDTree
        from scipy.spatial.transform import Rotation
    points = _columns(file, vertex, ("x", "y", "z"))
    colours = ply_colours(file, vertex)
    if colours is None:
        file.left_out("colours, as the file has none: all is grey")
        colours = np.full(points.shape, file.plain)
    finite = np.isfinite(points).all(axis=1)
    file.count_left_out(int((~finite).sum()), "point(s) without a place")
    step = -(-len(points) // MAX_POINTS)
    if step > 1:
        file.left_out(f"all points but one of {step}, as there are {len(points)}")
    points, colours = points[finite][::step], colours[finite][::step]
    unique, first = np.unique(points, axis=0, return_index=True)
    if len(unique) <= NEIGHBOURS:
        raise file.error(f"must hold at least {NEIGHBOURS + 1} points apart, got {len(unique)}")
    file.count_left_out(len(points) - len(unique), "point(s) at the place of another")
    points, colours = unique, colours[first]
    distances, nearest = KDTree(points).query(points, k=NEIGHBOURS + 1)
    apart = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
    # Rotations do not mirror.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    sigma = POINT_SIGMA * np.sqrt(np.pi / NEIGHBOURS) * distances[:, -1]
    flat = np.sqrt((variances[:, 0] / variances[:, 2]).clip(FLATTEST**2))
    columns = (
        points,
        sigma[:, None] * np.stack((flat, np.ones_like(flat), np.ones_like(flat)), axis=1),
        Rotation.from_matrix(axes).as_quat(scalar_first=True),
        np.full(len(points), POINT_OPACITY),
        ((colours - 0.5) / HARMONIC_0)[:, None],
    )
    return _fitted(file, "points", columns, f"{file.path.name}: {len(points)} points")


def _fitted(
    file: MeshFile, what: str, columns: tuple[FloatArray, ...], summary: str
) -> GaussianCloud:
    """Return Gaussians (the fields of `GaussianCloud`) scaled into the ball, without strays."""
    positions, sizes, _, shares, _ = columns
    finite = np.ones(len(positions), dtype=bool)
    for values in columns:
        finite &= np.isfinite(values.reshape(len(positions), -1)).all(axis=1)
    seen = finite & (shares >= VISIBLE_OPACITY)
    if seen.sum() < 2:
        raise file.error(
            f"must hold {what} of an opacity of at least {VISIBLE_OPACITY}, got {seen.sum()}"
        )
    away = np.linalg.norm(positions - np.median(positions[seen], axis=0), axis=1)
    near = finite & (away <= STRAY * np.quantile(away[seen], 0.98))
    if not near.all():
        file.left_out(
            f"{int((~near).sum())} of {len(near)} {what}, far from the others or infinite"
        )
    low, high = (f(positions[seen & near], axis=0) for f in (np.min, np.max))
    middle = 0.5 * (low + high)
    size = np.linalg.norm(positions[seen & near] - middle, axis=1).max()
    if not size > 0.0:
        raise file.error(f"must hold {what} at several places, got all at one")
    columns = ((positions - middle) * (RADIUS / size), sizes * (RADIUS / size), *columns[2:])
    means, scales, turns, opacities, harmonics = (
        torch.from_numpy(np.ascontiguousarray(each[near])).float() for each in columns
    )
    return GaussianCloud(means, scales, turns, opacities, harmonics, summary)


def draw_splats(splats: GaussianCloud, cameras: Cameras) -> Tensor:
    """Return pictures of Gaussians by V cameras, [V, H, W, 4]: colours times alpha, alpha.

    Gaussians have their own colours, without the light of meshes.
    """
    samples = max(1, min(SAMPLES, MAX_SIDE // max(cameras.width, cameras.height)))
    fine = replace(cameras, width=samples * cameras.width, height=samples * cameras.height)
    lenses = samples * cameras.intrinsics.expand(cameras.count, 4)
    pictures = []
    for motion, lens in zip(cameras.world_to_camera, lenses, strict=True):
        camera = replace(fine, world_to_camera=motion[None], intrinsics=lens)
        eye = -motion[:3, :3].mT @ motion[:3, 3]
        drawn = render_gaussians(
            splats.means[None],
            splats.scales[None],
            splats.quaternions[None],
            splats.opacities[None],
            colours_from(splats.harmonics, splats.means - eye)[None],
            camera,
        )
        picture = torch.cat((drawn.image, drawn.alpha[..., None]), dim=-1)
        sides = (cameras.height, samples, cameras.width, samples, 4)
        coarse = picture.view(sides).mean(dim=(1, 3))
        coarse[..., :3] = torch.minimum(coarse[..., :3], coarse[..., 3:])
        pictures.append(coarse)
    return torch.stack(pictures)


def colours_from(harmonics: Tensor, directions: Tensor) -> Tensor:
    """Return colours, at least 0, [N, 3], of spherical harmonics [N, K, 3] seen along directions.

    Signs and order are those of Kerbl et al. 2023. Directions, [N, 3], have any length.
    """
    x, y, z = torch.nn.functional.normalize(directions, dim=1).unbind(dim=1)
    basis = [torch.full_like(x, HARMONIC_0), -0.4886025 * y, 0.4886025 * z, -0.4886025 * x]
    basis += [1.0925484 * x * y, -1.0925484 * y * z, 0.3153916 * (3.0 * z * z - 1.0)]
    basis += [-1.0925484 * x * z, 0.5462742 * (x * x - y * y)]
    basis += [-0.5900436 * y * (3.0 * x * x - y * y), 2.8906114 * x * y * z]
    basis += [-0.4570458 * y * (5.0 * z * z - 1.0), 0.3731763 * z * (5.0 * z * z - 3.0)]
    basis += [-0.4570458 * x * (5.0 * z * z - 1.0), 1.4453057 * z * (x * x - y * y)]
    basis += [-0.5900436 * x * (x * x - 3.0 * y * y)]
    terms = torch.stack(basis[: harmonics.shape[1]], dim=1)
    return (torch.einsum("nk,nkc->nc", terms, harmonics) + 0.5).clamp(min=0.0)
