"""Folders of pictures and cameras as the NeRF-synthetic scenes are (Mildenhall et al. 2020)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import Cameras, cameras_of_poses
from npa_envs.tasks.checks import is_real
from npa_envs.tasks.images import open_image
from npa_envs.tasks.meshes import RADIUS
from npa_envs.tasks.views import Views, ViewTarget

TRAINING = "transforms_train.json"
HELD_OUT = ("transforms_test.json", "transforms_val.json")

SEEN = 0.5
"""Alpha above which a pixel belongs to the scene."""

UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Rotation from their world, whose z is up, to ours, whose y is."""


@dataclass(frozen=True)
class _Split:
    """What one `transforms_*.json` holds."""

    path: Path
    angle: float
    files: tuple[Path, ...]
    poses: Tensor


def read_nerf(
    folder: Path, resolution: int, training_count: int, held_out_count: int
) -> ViewTarget:
    """Read a scene; `load_views` says what becomes of it.

    Args:
        folder: Holds `transforms_train.json` and `transforms_test.json` (or `_val`).
        resolution: Pixels along each side of a view.
        training_count: Views to train with, at most.
        held_out_count: Views to measure by, at most.

    Raises:
        NPAError: A file is missing or damaged, a pose is no rigid motion, or nothing is seen.
    """
    held_out = next((folder / name for name in HELD_OUT if (folder / name).is_file()), None)
    if held_out is None:
        raise NPAError(
            f"a folder of views must hold {' or '.join(HELD_OUT)}, {str(folder)!r} does not: "
            "views to measure by must be others than those trained with"
        )
    training = _views(_read_split(folder / TRAINING), resolution, training_count)
    measured = _views(_read_split(held_out), resolution, held_out_count)
    reach = max(scene_reach(training), scene_reach(measured))
    if reach == 0.0:
        raise NPAError(
            f"views must show something, but no picture of {str(folder)!r} has a pixel of alpha "
            f"above {SEEN}: give pictures with a transparent background"
        )
    scale = RADIUS / reach
    return ViewTarget(folder.name, _scaled(training, scale), _scaled(measured, scale))


def scene_reach(views: Views) -> float:
    """Return how far from the origin what is seen reaches, at least [length units].

    Every point of the scene is at least as far from the origin as the ray on which it is seen; from
    many sides the farthest is seen on such a ray.

    Args:
        views: Views of the scene.
    """
    cameras, reach = views.cameras, 0.0
    lenses = cameras.intrinsics.double().expand(cameras.count, 4)
    for motion, lens, picture in zip(
        cameras.world_to_camera.double(), lenses, views.pictures, strict=True
    ):
        row, column = (picture[..., 3] > SEEN).nonzero(as_tuple=True)
        if len(row) == 0:
            continue
        pixel = torch.stack((column, row), dim=-1) + 0.5
        ray = torch.nn.functional.pad((pixel - lens[2:]) / lens[:2], (0, 1), value=1.0)
        ray /= ray.norm(dim=1, keepdim=True)
        # The origin in the camera's frame, and its distance from each ray.
        away = torch.linalg.cross(ray, motion[:3, 3].expand_as(ray)).norm(dim=1)
        reach = max(reach, float(away.max()))
    return reach


def _scaled(views: Views, scale: float) -> Views:
    motions = views.cameras.world_to_camera.clone()
    motions[:, :3, 3] *= scale
    cameras = replace(views.cameras, world_to_camera=motions)
    return Views(cameras, views.pictures)


def _views(split: _Split, resolution: int, count: int) -> Views:
    chosen = _evenly(len(split.files), count)
    poses = split.poses[chosen]
    turned = poses.clone()
    turned[:, :3] = torch.tensor(UPRIGHT, dtype=poses.dtype) @ poses[:, :3]
    try:
        cameras: Cameras = cameras_of_poses(
            turned.float(), split.angle, width=resolution, height=resolution
        )
    except NPAError as error:
        raise NPAError(f"in {str(split.path)!r}: {error}") from error
    pictures = [_read_picture(split.files[k], resolution) for k in chosen]
    return Views(cameras, torch.stack(pictures))


def _evenly(total: int, count: int) -> list[int]:
    return [k * total // min(count, total) for k in range(min(count, total))]


def _read_picture(path: Path, resolution: int) -> Tensor:
    image = open_image(path)
    if image.width != image.height:
        raise NPAError(
            f"views must be square, {str(path)!r} has {image.width} x {image.height} pixels: "
            "cut them to squares around the middle, and mend camera_angle_x"
        )
    # Pillow's premultiplied mode: colours of transparent pixels do not leak.
    kind = Image.Resampling.BOX if image.width >= resolution else Image.Resampling.BICUBIC
    scaled = image.convert("RGBa").resize((resolution, resolution), kind)
    return torch.from_numpy(np.asarray(scaled).astype(np.float32) / 255.0)


def _read_split(path: Path) -> _Split:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise NPAError(
            f"a folder of views must hold {path.name}, {str(path.parent)!r} does not: give a "
            "folder as NeRF-synthetic scenes are"
        ) from error
    except (OSError, ValueError) as error:
        raise NPAError(f"cannot read {str(path)!r} as JSON: {error}") from error
    angle = content.get("camera_angle_x") if isinstance(content, dict) else None
    frames = content.get("frames") if isinstance(content, dict) else None
    if not is_real(angle) or not 0.0 < float(angle or 0.0) < math.pi:
        raise NPAError(
            f"camera_angle_x in {str(path)!r} must be an angle between 0 and pi radians, "
            f"got {angle!r}"
        )
    if not isinstance(frames, list) or not frames:
        raise NPAError(f"frames in {str(path)!r} must be a list with at least one view")
    files, poses = zip(
        *(_read_frame(path, k, frame) for k, frame in enumerate(frames)), strict=True
    )
    return _Split(path, float(angle or 0.0), files, torch.stack(poses))


def _read_frame(path: Path, number: int, frame: Any) -> tuple[Path, Tensor]:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str) or not name:
        raise NPAError(f"frame {number} in {str(path)!r} must have a file_path, got {name!r}")
    try:
        pose = torch.tensor(frame.get("transform_matrix"), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        pose, cause = torch.empty(0), error
        fault = f" ({cause})"
    else:
        fault = ""
    if pose.shape != (4, 4):
        raise NPAError(
            f"transform_matrix of frame {number} in {str(path)!r} must be 4 x 4 numbers, "
            f"got shape {tuple(pose.shape)}{fault}"
        )
    file = path.parent / name
    # Their file_path has no suffix.
    return (file if file.suffix else file.with_name(file.name + ".png")), pose
