"""Views of a 3D target: pictures with alpha from known cameras, some of them held out."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from npa_envs.atomic_files import home_path
from npa_envs.checks import check_count
from npa_envs.errors import NPAError, shown
from npa_envs.ops import Cameras, look_at, orbit
from npa_envs.tasks.targets.meshes import Mesh, draw_mesh, load_mesh
from npa_envs.tasks.targets.splat_files import draw_splats, ply_kind, read_splats

DISTANCE = 3.2
"""Distance of cameras from the origin [length units]."""

MAX_PIXELS = 2**27
"""Maximum number of pixels of all views of a target; a pixel takes 16 bytes."""

ANGLE = 40.0
"""Angle of view of cameras [degrees]: the unit ball fits into the picture."""


@dataclass(frozen=True, eq=False)
class Views:
    """Pictures and the cameras that took them."""

    cameras: Cameras
    """Poses and lenses of V cameras."""
    pictures: Tensor
    """Red, green and blue, each times alpha, and alpha, dimensionless, shape [V, H, W, 4]; the
    first row is the upper one."""

    def to(self, device: str | torch.device) -> Views:
        """Return a copy on another device."""
        return Views(self.cameras.to(torch.device(device)), self.pictures.to(device))


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """A 3D target: pictures of it from all sides."""

    name: str
    """The built-in name, or the file's or folder's name."""
    training: Views
    """The views that the loss compares."""
    held_out: Views
    """The views that metrics compare."""
    summary: str = ""
    """What was read, in one line; empty for a built-in target."""

    def to(self, device: str | torch.device) -> ViewTarget:
        """Return a copy on another device."""
        training, held_out = self.training.to(device), self.held_out.to(device)
        return replace(self, training=training, held_out=held_out)


def load_views(
    source: str | Path,
    *,
    resolution: int = 192,
    training_count: int = 48,
    held_out_count: int = 12,
) -> ViewTarget:
    """Make a target from a built-in mesh, a mesh file, a PLY file of points, or a folder of views.

    Meshes, point clouds and trained Gaussians (3DGS) are drawn from cameras all around. A folder is
    in the format of NeRF-synthetic, instant-ngp or nerfstudio; of a single `transforms.json` every
    eighth view is held out. Evenly spaced views are taken, at most `training_count` and
    `held_out_count`. Lenses are undistorted, and pictures become squares. The scene is rotated so
    that y is up, and scaled into the ball of radius 0.85. Opaque pictures lose the plain background
    around the thing. Views have `resolution` pixels along each side.
    """
    if not isinstance(source, str | Path) or not str(source):
        raise NPAError(
            "target must be a built-in mesh, a mesh file or a folder of views, got "
            f"{shown(source)}: for example 'mushroom'"
        )
    counts = {"training_count": training_count, "held_out_count": held_out_count}
    for name, value in {"resolution": resolution, **counts}.items():
        check_count(name, value)
    pixels = (training_count + held_out_count) * resolution**2
    if pixels > MAX_PIXELS:
        raise NPAError(
            f"all views together must have at most {MAX_PIXELS} pixels, got {shown(pixels)} of "
            f"resolution={shown(resolution)}: lower it, or take fewer views"
        )
    folder = home_path(source)
    if os.path.isdir(folder):
        # The readers make views.
        from npa_envs.tasks.targets.view_folders import read_view_folder

        return read_view_folder(folder, resolution, training_count, held_out_count)
    if folder.suffix.lower() == ".ply" and folder.is_file() and ply_kind(folder) != "triangles":
        splats = read_splats(folder)
        draw = functools.partial(draw_splats, splats)
        counted = (training_count, held_out_count)
        return _views_around(draw, folder.stem, resolution, counted, splats.summary)
    mesh = load_mesh(source)
    return views_of_mesh(mesh, folder.stem, resolution, training_count, held_out_count)


def views_of_mesh(
    mesh: Mesh, name: str, resolution: int, training_count: int, held_out_count: int
) -> ViewTarget:
    """Return views of a mesh, which fits into the ball of radius 0.85, from cameras all around."""
    counts = (training_count, held_out_count)

    def draw(cameras: Cameras) -> Tensor:
        return torch.from_numpy(draw_mesh(mesh, cameras))

    return _views_around(draw, name, resolution, counts, mesh.summary)


def _views_around(
    draw: Callable[[Cameras], Tensor],
    name: str,
    resolution: int,
    counts: tuple[int, int],
    summary: str,
) -> ViewTarget:
    """Return views that a function draws, to train with and held out, from cameras all around."""
    views = []
    for count, turn in zip(counts, (0.0, 0.5), strict=True):
        cameras = surrounding_cameras(count, resolution, turn=turn)
        views.append(Views(cameras, draw(cameras)))
    return ViewTarget(name, views[0], views[1], summary)


def surrounding_cameras(count: int, resolution: int, *, turn: float = 0.0) -> Cameras:
    """Return cameras on a Fibonacci spiral around the origin, at which they point.

    The spiral is rotated by `turn` turns around the y axis.
    """
    k = torch.arange(count, dtype=torch.float64)
    height = (2.0 * k + 1.0) / count - 1.0
    angle = math.tau * (k * (0.5 * (math.sqrt(5.0) - 1.0)) + turn)
    flat = (1.0 - height * height).sqrt()
    outward = torch.stack((flat * angle.sin(), height, flat * angle.cos()), dim=-1)
    # Only the intrinsics of this camera are used.
    lens = orbit(1, 0.0, DISTANCE, ANGLE, width=resolution, height=resolution)
    return Cameras(
        world_to_camera=look_at(DISTANCE * outward, (0.0, 0.0, 0.0)).float(),
        intrinsics=lens.intrinsics,
        width=resolution,
        height=resolution,
    )


def composited(views: Tensor, background: Tensor) -> Tensor:
    """Return the colours [..., 3] of views [..., 4] in front of a background [..., 3]."""
    return views[..., :3] + (1.0 - views[..., 3:]) * background


def some_views(views: Views, index: Tensor) -> Views:
    """Return the views with these indices, int64, shape [any]."""
    cameras = views.cameras
    intrinsics = cameras.intrinsics
    chosen = replace(
        cameras,
        world_to_camera=cameras.world_to_camera.index_select(0, index),
        intrinsics=intrinsics if intrinsics.ndim == 1 else intrinsics.index_select(0, index),
    )
    return Views(chosen, views.pictures.index_select(0, index))


def nearest_camera(cameras: Cameras, elevation: float) -> int:
    """Return the index of the camera nearest to the front (+z) at an elevation [degrees]."""
    motions = cameras.world_to_camera.double().cpu()
    positions = -(motions[:, :3, :3].mT @ motions[:, :3, 3:])[..., 0]
    tilt = math.radians(elevation)
    front = positions.new_tensor((0.0, math.sin(tilt), math.cos(tilt)))
    return int((positions @ front / positions.norm(dim=1)).argmax())
