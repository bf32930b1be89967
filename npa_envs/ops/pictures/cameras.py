"""Cameras that look at 3D worlds.

A camera's frame is OpenCV's: x to the right of the picture, y down, z into the scene. A point p of
the world lies at R p + t in it and is seen at column fx x / z + cx and row fy y / z + cy, in pixels
from the picture's upper left corner: the first pixel's middle is at (0.5, 0.5).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.checks import (
    DTYPES,
    MAX_SIDE,
    check_alike,
    check_dense,
    check_floating,
    checked_count,
    checked_finite,
    checked_number,
    checked_positive,
    checked_side,
    number_tensor,
)
from npa_envs.errors import NPAError, shown

RIGID_TOLERANCE = 1e-3
"""How far R Rᵀ may be from the unit matrix, entry by entry, dimensionless."""

MIN_ANGLE = 1e-9
"""Angles of view are larger [radians]: focal lengths stay numbers of float32."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cameras:
    """V cameras with pictures of one size, shared by all worlds or separate for each world.

    Shapes are always checked, values only on the CPU: elsewhere reading them would wait for the
    device. So make cameras on the CPU and move them with `to`.
    """

    world_to_camera: Tensor
    """Rigid motions [R t; 0 1] into the cameras' frames [length units], shape [V, 4, 4] or
    [B, V, 4, 4]."""
    intrinsics: Tensor
    """fx, fy, cx and cy [pixels], shape [4], [V, 4] or [B, V, 4]."""
    width: int
    """Pixels across, W."""
    height: int
    """Pixels down, H."""
    near: float = 0.01
    """Smallest visible depth z [length units]."""

    def __post_init__(self) -> None:
        """Check every field."""
        self._check_shapes()
        for name in ("width", "height"):
            checked_side(name, getattr(self, name))
        checked_positive("near", self.near, " [length units]")
        if self.world_to_camera.device.type == "cpu":
            self._check_numbers()

    @property
    def count(self) -> int:
        """Number of cameras of a world, V."""
        return self.world_to_camera.shape[-3]

    @property
    def world_count(self) -> int | None:
        """Number of worlds with separate cameras, B; None if all worlds share the cameras."""
        return self.world_to_camera.shape[0] if self.world_to_camera.ndim == 4 else None

    def to(self, like: Tensor | torch.device | torch.dtype | str) -> Cameras:
        """Return the cameras on another device or in another dtype, for a tensor in both of its."""
        motions, intrinsics = self.world_to_camera.to(like), self.intrinsics.to(like)
        return dataclasses.replace(self, world_to_camera=motions, intrinsics=intrinsics)

    def _check_shapes(self) -> None:
        motions, intrinsics = self.world_to_camera, self.intrinsics
        check_floating("world_to_camera", motions)
        check_floating("intrinsics", intrinsics)
        if motions.ndim not in (3, 4) or motions.shape[-2:] != (4, 4) or 0 in motions.shape:
            hint = "add a dimension of views with world_to_camera[None]"
            raise NPAError(
                f"world_to_camera must have shape [V, 4, 4] or [B, V, 4, 4], "
                f"got {tuple(motions.shape)}: {hint if motions.ndim == 2 else 'reshape it'}"
            )
        views = motions.shape[:-2]
        if intrinsics.shape not in ((4,), (views[-1], 4), (*views, 4)):
            wanted = " or ".join(
                str([*lead, 4]) for lead in dict.fromkeys(((), tuple(views[-1:]), tuple(views)))
            )
            raise NPAError(
                f"intrinsics must hold fx, fy, cx and cy in shape {wanted} for world_to_camera of "
                f"shape {tuple(motions.shape)}, got {tuple(intrinsics.shape)}"
            )
        check_alike("world_to_camera", motions, "intrinsics", intrinsics)

    def _check_numbers(self) -> None:
        motions = self.world_to_camera.detach().flatten(0, -3).double()
        last = motions.new_tensor([0.0, 0.0, 0.0, 1.0])
        rotations = motions[:, :3, :3]
        away = (rotations @ rotations.mT - torch.eye(3, dtype=torch.float64)).abs().amax((1, 2))
        rigid = (away <= RIGID_TOLERANCE) & (torch.linalg.det(rotations) > 0.0)
        rigid &= motions.isfinite().all(-1).all(-1) & (motions[:, 3] == last).all(-1)
        if not bool(rigid.all()):
            k = int((~rigid).nonzero()[0])
            raise NPAError(
                f"world_to_camera must be rigid motions [R t; 0 1] with a rotation R (neither "
                f"singular nor scaled nor mirrored), got {motions[k].tolist()} as camera {k}: "
                f"make it with look_at, orbit or cameras_of_poses"
            )
        intrinsics = self.intrinsics.detach().view(-1, 4)
        fits = intrinsics.isfinite().all(-1) & (intrinsics[:, :2] > 0.0).all(-1)
        if not bool(fits.all()):
            k = int((~fits).nonzero()[0])
            raise NPAError(
                f"intrinsics must be finite with positive focal lengths fx and fy [pixels], "
                f"got {intrinsics[k].tolist()} as camera {k}: turn a flipped axis round in "
                f"world_to_camera"
            )


def look_at(
    eyes: Tensor, targets: Tensor | Sequence[float], up: Sequence[float] = (0.0, 1.0, 0.0)
) -> Tensor:
    """Return world-to-camera matrices of cameras that look at targets, shape [..., 4, 4].

    Args:
        eyes: Positions of the cameras [length units], shape [..., 3].
        targets: Points in the centres of the pictures [length units], shape [3] or [..., 3].
        up: Direction of the world that points up in the pictures, dimensionless.

    Raises:
        NPAError: A shape does not fit, or (on the CPU) a camera is at its target or looks along
            `up`.
    """
    if not isinstance(eyes, Tensor) or eyes.dtype not in DTYPES or eyes.shape[-1:] != (3,):
        got = tuple(eyes.shape) if isinstance(eyes, Tensor) else type(eyes).__name__
        raise NPAError(f"eyes must be a floating tensor of shape [..., 3], got {got}")
    check_dense("eyes", eyes)
    goal = number_tensor("targets", targets).to(eyes)
    if goal.shape not in ((3,), eyes.shape):
        raise NPAError(
            f"targets must have shape [3] or that of eyes, {tuple(eyes.shape)}, "
            f"got {tuple(goal.shape)}"
        )
    high = number_tensor("up", up).to(eyes)
    if high.shape != (3,):
        raise NPAError(f"up must be 3 numbers, got {shown(up)}")
    ahead = goal - eyes
    right = torch.linalg.cross(ahead, high.expand_as(ahead))
    lengths = (ahead.norm(dim=-1), right.norm(dim=-1))
    if eyes.device.type == "cpu":
        least = 1e-6 * lengths[0] * high.norm()
        if bool(((lengths[0] == 0.0) | ~(lengths[1] > least)).any()):
            raise NPAError(
                f"a camera must look at another point than its own and not along up = {up}, "
                f"got eyes {eyes.tolist()} and targets {goal.tolist()}: choose another up"
            )
    ahead, right = ahead / lengths[0][..., None], right / lengths[1][..., None]
    rotation = torch.stack((right, torch.linalg.cross(ahead, right), ahead), dim=-2)
    motion = torch.cat((rotation, -rotation @ eyes[..., None]), dim=-1)
    last = eyes.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*eyes.shape[:-1], 1, 4)
    return torch.cat((motion, last), dim=-2)


def _intrinsics(fov: float, width: int, height: int) -> Tensor:
    """Return fx, fy, cx, cy [pixels] of square pixels, `fov` [radians] across the width."""
    for name, side in (("width", width), ("height", height)):
        checked_side(name, side)
    fov = checked_number("the angle of view", fov)
    if not MIN_ANGLE < fov < math.pi:
        raise NPAError(
            f"the angle of view must lie between 0 and 180 degrees, got {math.degrees(fov):g}"
        )
    focal = 0.5 * width / math.tan(0.5 * fov)
    return torch.tensor([focal, focal, 0.5 * width, 0.5 * height], dtype=torch.float32)


def orbit(
    count: int,
    elevation: float = 20.0,
    radius: float = 3.0,
    fov: float = 45.0,
    *,
    width: int,
    height: int,
    azimuth: float = 0.0,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    near: float = 0.01,
) -> Cameras:
    """Return cameras evenly spaced on a circle around the vertical axis: a turntable.

    Angles are those of `npa_envs.render.draw_worlds`: y is up; azimuth 0 has x to the right and z
    towards the viewer; seen from above, azimuth increases counterclockwise.

    Args:
        count: Cameras V, 1 or more.
        elevation: Angle above the horizon [degrees], between -90 and 90.
        radius: Distance from the centre [length units].
        fov: Angle of view across the width [degrees].
        width: Pixels across.
        height: Pixels down.
        azimuth: Azimuth of the first camera [degrees].
        centre: Point at which they look [length units].
        near: Smallest visible depth [length units].

    Raises:
        NPAError: A number is out of its range.
    """
    if checked_count("count", count) < 1:
        raise NPAError(f"count must be at least 1 camera, got {shown(count)}")
    if count > MAX_SIDE:
        raise NPAError(f"count must be at most {MAX_SIDE} cameras, got {shown(count)}")
    elevation, azimuth = checked_finite("elevation", elevation), checked_finite("azimuth", azimuth)
    radius, angle = checked_finite("radius", radius), checked_number("fov", fov)
    if not abs(elevation) < 90.0:
        raise NPAError(
            f"elevation must lie between -90 and 90 degrees, got {elevation:g}: straight from "
            f"above nothing is up, use look_at with another up"
        )
    if not radius > 0.0:
        raise NPAError(f"radius must be positive [length units], got {radius:g}")
    turns = azimuth + 360.0 / count * torch.arange(count, dtype=torch.float64)
    turn, tilt = torch.deg2rad(turns), math.radians(elevation)
    flat = math.cos(tilt)
    heights = torch.full_like(turn, math.sin(tilt))
    outward = torch.stack((flat * turn.sin(), heights, flat * turn.cos()), dim=-1)
    middle = number_tensor("centre", centre).double()
    if middle.shape != (3,):
        raise NPAError(f"centre must be 3 numbers [length units], got {shown(centre)}")
    return Cameras(
        world_to_camera=look_at(middle + radius * outward, middle).float(),
        intrinsics=_intrinsics(math.radians(angle), width, height),
        width=width,
        height=height,
        near=near,
    )


def cameras_of_poses(
    camera_to_world: Tensor, angle: float, *, width: int, height: int, near: float = 0.01
) -> Cameras:
    """Return cameras of poses as the NeRF-synthetic scenes give them (Mildenhall et al. 2020).

    Their `transforms_*.json` hold a `transform_matrix` for each picture, whose camera's frame is
    OpenGL's: x right, y up, z out of the scene. The world is not rotated; theirs has z up.

    Args:
        camera_to_world: Poses [length units], shape [V, 4, 4] or [B, V, 4, 4].
        angle: Angle of view across the width [radians]: their `camera_angle_x`.
        width: Pixels across.
        height: Pixels down.
        near: Smallest visible depth [length units].

    Raises:
        NPAError: A shape does not fit, a pose is no rigid motion, or a number is out of its range.
    """
    if not isinstance(camera_to_world, Tensor) or camera_to_world.shape[-2:] != (4, 4):
        got = getattr(camera_to_world, "shape", type(camera_to_world).__name__)
        raise NPAError(f"camera_to_world must have shape [V, 4, 4] or [B, V, 4, 4], got {got}")
    check_floating("camera_to_world", camera_to_world)
    # Of a rigid motion: R and t become Rᵀ and -Rᵀ t. What is not rigid is rejected by `Cameras`.
    flip = camera_to_world.new_tensor([1.0, -1.0, -1.0])
    back = (camera_to_world[..., :3, :3] * flip).mT
    motion = torch.cat((back, -back @ camera_to_world[..., :3, 3:]), dim=-1)
    return Cameras(
        world_to_camera=torch.cat((motion, camera_to_world[..., 3:, :]), dim=-2),
        intrinsics=_intrinsics(angle, width, height).to(camera_to_world),
        width=width,
        height=height,
        near=near,
    )
