"""What a 3D world is learned from: pictures with alpha from known cameras, some held out."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import Cameras, look_at, orbit
from npa_envs.tasks.meshes import load_mesh
from npa_envs.tasks.raster import draw_mesh

DISTANCE = 3.2
"""How far cameras are from the origin [length units]."""

ANGLE = 40.0
"""Their angle of view [degrees]: the unit ball fits into the picture."""


@dataclass(frozen=True, eq=False)
class Views:
    """Pictures and the cameras that took them."""

    cameras: Cameras
    """V cameras."""

    pictures: Tensor
    """Red, green and blue, each times alpha, and alpha, dimensionless, shape [V, H, W, 4]; the
    first row is the upper one."""

    def to(self, device: str | torch.device) -> Views:
        """Return the views on another device.

        Args:
            device: The device.
        """
        return Views(self.cameras.to(torch.device(device)), self.pictures.to(device))


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """A thing to grow, seen from all sides."""

    name: str
    """The built-in name, or the file's or folder's name."""

    training: Views
    """What the loss compares with."""

    held_out: Views
    """What rules are measured by."""

    def to(self, device: str | torch.device) -> ViewTarget:
        """Return the target on another device.

        Args:
            device: The device.
        """
        return ViewTarget(self.name, self.training.to(device), self.held_out.to(device))


def load_views(
    source: str | Path,
    *,
    resolution: int = 192,
    training_count: int = 48,
    held_out_count: int = 12,
    device: str | torch.device = "cpu",
) -> ViewTarget:
    """Make a target from a built-in mesh, a mesh file, or a folder as NeRF-synthetic scenes are.

    A mesh is drawn from cameras all around. A folder gives pictures and cameras, evenly spaced ones
    where it holds more than asked for; its scene is turned so that y is up, and scaled so that what
    is seen lies within 0.85 of the origin.

    Args:
        source: A name from `builtin_meshes`, the path of a mesh file, or a folder that holds
            `transforms_train.json`.
        resolution: Pixels along each side of a view.
        training_count: Views to train with, at most.
        held_out_count: Views to measure by, at most.
        device: Where the tensors are made.

    Raises:
        NPAError: The name is unknown, the file or folder is missing or damaged, or a number is not
            positive.
    """
    if not isinstance(source, str | Path) or not str(source):
        raise NPAError(
            f"target must be a built-in mesh, a mesh file or a folder of views, got {source!r}: "
            "for example 'mushroom'"
        )
    counts = {"training_count": training_count, "held_out_count": held_out_count}
    for name, value in {"resolution": resolution, **counts}.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise NPAError(f"{name} must be an integer of at least 1, got {value!r}")
    folder = Path(os.path.expanduser(source))
    if folder.is_dir():
        # Imported here: folders are read by a module that makes views.
        from npa_envs.tasks.nerf import read_nerf

        return read_nerf(folder, resolution, training_count, held_out_count).to(device)
    mesh = load_mesh(source)
    views = []
    for count, turn in ((training_count, 0.0), (held_out_count, 0.5)):
        cameras = surrounding_cameras(count, resolution, turn=turn)
        views.append(Views(cameras, torch.from_numpy(draw_mesh(mesh, cameras))))
    return ViewTarget(folder.stem, views[0], views[1]).to(device)


def surrounding_cameras(count: int, resolution: int, *, turn: float = 0.0) -> Cameras:
    """Return cameras evenly spread over a sphere around the origin, which they look at.

    They lie on a Fibonacci spiral from below to above, so that any number of them is spread evenly.

    Args:
        count: Cameras V.
        resolution: Pixels along each side of their pictures.
        turn: The spiral is turned by so much of a full turn: others than those at 0.
    """
    k = torch.arange(count, dtype=torch.float64)
    height = (2.0 * k + 1.0) / count - 1.0
    angle = math.tau * (k * (0.5 * (math.sqrt(5.0) - 1.0)) + turn)
    flat = (1.0 - height * height).sqrt()
    outward = torch.stack((flat * angle.sin(), height, flat * angle.cos()), dim=-1)
    # A single camera would lie on the horizon, as those of an orbit do; it gives the lens.
    lens = orbit(1, 0.0, DISTANCE, ANGLE, width=resolution, height=resolution)
    return Cameras(
        world_to_camera=look_at(DISTANCE * outward, (0.0, 0.0, 0.0)).float(),
        intrinsics=lens.intrinsics,
        width=resolution,
        height=resolution,
    )


def over(views: Tensor, background: Tensor) -> Tensor:
    """Return colours before a background, shape [..., 3].

    Args:
        views: Colours times alpha, and alpha, shape [..., 4].
        background: Red, green and blue; broadcasts to [..., 3].
    """
    return views[..., :3] + (1.0 - views[..., 3:]) * background


def some_views(views: Views, index: Tensor) -> Views:
    """Return some of the views.

    Args:
        views: All of them.
        index: Which, on their device, shape [V].
    """
    cameras = views.cameras
    intrinsics = cameras.intrinsics
    chosen = replace(
        cameras,
        world_to_camera=cameras.world_to_camera.index_select(0, index),
        intrinsics=intrinsics if intrinsics.ndim == 1 else intrinsics.index_select(0, index),
    )
    return Views(chosen, views.pictures.index_select(0, index))


def nearest_elevation(cameras: Cameras, elevation: float) -> int:
    """Return which camera looks at the origin from nearest to an elevation.

    Args:
        cameras: V cameras.
        elevation: Above the horizon [degrees].
    """
    motions = cameras.world_to_camera.double().cpu()
    places = -(motions[:, :3, :3].mT @ motions[:, :3, 3:])[..., 0]
    heights = places[:, 1] / places.norm(dim=1)
    return int((heights - math.sin(math.radians(elevation))).abs().argmin())
