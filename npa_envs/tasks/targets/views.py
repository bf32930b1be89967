"""Views of a 3D target: pictures with alpha from known cameras, some of them held out."""

from __future__ import annotations

import contextlib
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npa_envs.atomic_files import home_path, read_json
from npa_envs.checks import check_count, is_real
from npa_envs.errors import NPAError, shown
from npa_envs.ops import Cameras, cameras_of_poses, look_at, orbit
from npa_envs.tasks.targets.images import open_image, scaled_square
from npa_envs.tasks.targets.meshes import RADIUS, Mesh, draw_mesh, load_mesh

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
    """Make a target from a built-in mesh, a mesh file, or a folder in the format of NeRF-synthetic.

    A mesh is drawn from cameras all around. Of a folder's pictures and cameras evenly spaced ones
    are taken, at most `training_count` and `held_out_count`; the scene is rotated so that y is up,
    and scaled into the ball of radius 0.85. Views have `resolution` pixels along each side.
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
        return read_nerf(folder, resolution, training_count, held_out_count)
    mesh = load_mesh(source)
    return views_of_mesh(mesh, folder.stem, resolution, training_count, held_out_count)


def views_of_mesh(
    mesh: Mesh, name: str, resolution: int, training_count: int, held_out_count: int
) -> ViewTarget:
    """Return views of a mesh, which fits into the ball of radius 0.85, from cameras all around."""
    views = []
    for count, turn in ((training_count, 0.0), (held_out_count, 0.5)):
        cameras = surrounding_cameras(count, resolution, turn=turn)
        views.append(Views(cameras, torch.from_numpy(draw_mesh(mesh, cameras))))
    return ViewTarget(name, views[0], views[1], mesh.summary)


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


# Folders of pictures and cameras in the format of NeRF-synthetic (Mildenhall et al. 2020).

TRAINING_FILE = "transforms_train.json"
HELD_OUT_FILES = ("transforms_test.json", "transforms_val.json")

OPAQUE_ALPHA = 0.5
"""Alpha above which a pixel belongs to the scene."""

UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Rotation from the format's coordinates, z up, to ours, y up."""


def read_nerf(
    folder: Path, resolution: int, training_count: int, held_out_count: int
) -> ViewTarget:
    """Return the target in a NeRF-synthetic folder, as `load_views` describes."""
    held_out = next((folder / name for name in HELD_OUT_FILES if (folder / name).is_file()), None)
    if held_out is None or not (folder / TRAINING_FILE).is_file():
        raise NPAError(
            f"a folder of views must hold {TRAINING_FILE}, and {' or '.join(HELD_OUT_FILES)}, "
            f"{shown(str(folder))} does not: views to measure by must be others than those trained "
            "with"
        )
    training = _read_views(folder / TRAINING_FILE, resolution, training_count)
    measured = _read_views(held_out, resolution, held_out_count)
    radius = max(scene_radius(training), scene_radius(measured))
    if radius == 0.0:
        raise NPAError(
            f"views must show something, but no picture of {shown(str(folder))} has a pixel of "
            f"alpha above {OPAQUE_ALPHA}: give pictures with a transparent background"
        )
    for views in (training, measured):
        views.cameras.world_to_camera[:, :3, 3] *= RADIUS / radius
    return ViewTarget(folder.name, training, measured)


def scene_radius(views: Views) -> float:
    """Return a lower bound on the scene's radius [length units].

    It is the largest distance from the origin of a camera ray on which something is visible. A
    point is at least as far from the origin as the rays on which it is visible; with many views,
    one of these rays nearly touches the farthest point.
    """
    cameras, radius = views.cameras, 0.0
    lenses = cameras.intrinsics.double().expand(cameras.count, 4)
    for motion, lens, picture in zip(
        cameras.world_to_camera.double(), lenses, views.pictures, strict=True
    ):
        row, column = (picture[..., 3] > OPAQUE_ALPHA).nonzero(as_tuple=True)
        if len(row) == 0:
            continue
        pixel = torch.stack((column, row), dim=-1) + 0.5
        ray = torch.nn.functional.pad((pixel - lens[2:]) / lens[:2], (0, 1), value=1.0)
        ray /= ray.norm(dim=1, keepdim=True)
        # The origin in the camera's frame, and its distance from each ray.
        away = torch.linalg.cross(ray, motion[:3, 3].expand_as(ray)).norm(dim=1)
        radius = max(radius, float(away.max()))
    return radius


def _read_views(path: Path, resolution: int, count: int) -> Views:
    """Return `count` evenly spaced views of a `transforms_*.json`, rotated so that y is up."""
    file = shown(str(path))
    try:
        content = read_json(path)
    except NPAError as error:
        raise NPAError(f"cannot read {file} as JSON: {error}") from error
    content = content if isinstance(content, dict) else {}
    angle: Any = content.get("camera_angle_x")
    frames = content.get("frames")
    if not is_real(angle) or not 0.0 < angle < math.pi:
        raise NPAError(
            f"camera_angle_x in {file} must be an angle between 0 and pi radians, "
            f"got {shown(angle)}"
        )
    if not isinstance(frames, list) or not frames:
        raise NPAError(f"frames in {file} must be a list with at least one view")
    files, poses = zip(
        *(_read_frame(path, k, frame) for k, frame in enumerate(frames)), strict=True
    )
    total = len(files)
    chosen = [k * total // min(count, total) for k in range(min(count, total))]
    turned = torch.stack(poses)[chosen]
    turned[:, :3] = torch.tensor(UPRIGHT, dtype=turned.dtype) @ turned[:, :3]
    try:
        cameras: Cameras = cameras_of_poses(
            turned.float(), float(angle), width=resolution, height=resolution
        )
    except NPAError as error:
        raise NPAError(f"in {file}: {error}") from error
    pictures = []
    for picture in (files[k] for k in chosen):
        image = open_image(picture)
        if image.width != image.height:
            raise NPAError(
                f"views must be square, {shown(str(picture))} has {image.width} x {image.height} "
                "pixels: cut them to squares around the middle, and correct camera_angle_x"
            )
        pictures.append(torch.from_numpy(scaled_square(image, resolution)))
    return Views(cameras, torch.stack(pictures))


def _read_frame(path: Path, number: int, frame: Any) -> tuple[Path, Tensor]:
    """Return the picture's file and the pose of a frame of a `transforms_*.json`."""
    frame, where = frame if isinstance(frame, dict) else {}, f"frame {number} in {shown(str(path))}"
    name, matrix = frame.get("file_path"), frame.get("transform_matrix")
    if not isinstance(name, str) or not name:
        raise NPAError(f"{where} must have a file_path, got {shown(name)}")
    pose = torch.empty(0)
    with contextlib.suppress(TypeError, ValueError, RuntimeError, OverflowError):
        pose = torch.tensor(matrix, dtype=torch.float64)
    if pose.shape != (4, 4):
        raise NPAError(f"transform_matrix of {where} must be 4 x 4 numbers, got {shown(matrix)}")
    inside = os.path.normpath(name)
    if os.path.isabs(name) or inside == os.curdir or inside.split(os.sep)[0] == os.pardir:
        raise NPAError(
            f"file_path of {where} must name a file in that folder, got {shown(name)}: put the "
            "pictures next to it"
        )
    file = path.parent / inside
    # The format's file_path has no suffix.
    return (file if file.suffix else file.with_name(file.name + ".png")), pose
