"""Checks at the door of `render_gaussians`."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.pictures.gaussians import CHANNELS
from npa_envs.sph.cameras import Cameras
from npa_envs.sph.cells import LARGEST_INDEX
from npa_envs.sph.checks import DTYPES, check_dense


def check_gaussians(
    means: Tensor, scales: Tensor, quaternions: Tensor, opacities: Tensor, colours: Tensor
) -> None:
    """Check shapes, dtypes and devices of Gaussians; on the CPU also the scales' signs.

    Raises:
        NPAError: They do not fit.
    """
    _check_tensor("means", means, means, "[B, N, 3]")
    lead = tuple(means.shape[:2])
    if means.ndim != 3 or means.shape[2] != 3 or 0 in lead:
        cure = "add a world dimension with means[None]" if means.ndim == 2 else "reshape it"
        raise NPAError(
            f"means must have shape [B, N, 3] with at least one world and one particle, "
            f"got {tuple(means.shape)}: {cure}"
        )
    shapes = (
        ("scales", scales, "[B, N, 3]", ((3,),)),
        ("quaternions", quaternions, "[B, N, 4]", ((4,),)),
        ("opacities", opacities, "[B, N]", ((),)),
        (
            "colours",
            colours,
            f"[B, N, K] with K from 1 to {CHANNELS}, or [B, N, 4, 3]",
            (*((k,) for k in range(1, CHANNELS + 1)), (4, 3)),
        ),
    )
    for name, tensor, shape, ends in shapes:
        _check_tensor(name, tensor, means, shape)
        if tuple(tensor.shape) not in [(*lead, *end) for end in ends]:
            raise NPAError(
                f"{name} must have shape {shape} with [B, N] = {list(lead)} as means has, "
                f"got {tuple(tensor.shape)}"
            )
    if scales.device.type == "cpu" and not torch.compiler.is_compiling():
        negative = scales.detach() < 0.0
        if bool(negative.any()):
            world, particle, _ = (int(k) for k in negative.nonzero()[0])
            raise NPAError(
                f"scales must not be negative [length units], got "
                f"{scales[world, particle].tolist()} at world {world}, particle {particle} "
                f"({int(negative.any(-1).sum())} such particles): make them with exp or softplus"
            )


def _check_tensor(name: str, tensor: Tensor, means: Tensor, shape: str) -> None:
    if not isinstance(tensor, Tensor):
        raise NPAError(
            f"{name} must be a torch tensor of shape {shape}, got {type(tensor).__name__}: "
            f"convert it with torch.as_tensor"
        )
    if tensor.dtype not in DTYPES:
        raise NPAError(
            f"{name} must be float32 or float64, got {tensor.dtype}: convert it with .float()"
        )
    check_dense(name, tensor)
    if tensor.dtype != means.dtype or tensor.device != means.device:
        raise NPAError(
            f"{name} and means must share dtype and device, got {tensor.dtype} on {tensor.device} "
            f"and {means.dtype} on {means.device}: convert one with .to(other)"
        )


def check_cameras(
    cameras: Cameras, means: Tensor, background: Tensor | None, channels: int
) -> None:
    """Check that cameras and a background fit the worlds.

    Raises:
        NPAError: They do not.
    """
    if not isinstance(cameras, Cameras):
        raise NPAError(
            f"cameras must be Cameras, got {type(cameras).__name__}: "
            f"make them with orbit, or Cameras(world_to_camera=..., intrinsics=..., ...)"
        )
    if cameras.world_to_camera.device != means.device:
        raise NPAError(
            f"cameras and means must share a device, got {cameras.world_to_camera.device} and "
            f"{means.device}: move them with cameras.to(means.device)"
        )
    if cameras.world_count not in (None, means.shape[0]):
        raise NPAError(
            f"cameras of their own must be there for each of {means.shape[0]} worlds, got "
            f"world_to_camera of shape {tuple(cameras.world_to_camera.shape)}: share cameras with "
            f"shape [V, 4, 4]"
        )
    image = (means.shape[0], cameras.count, cameras.height, cameras.width, channels)
    entries = means.shape[0] * cameras.count * max(means.shape[1], cameras.height * cameras.width)
    if entries * 12 > LARGEST_INDEX:
        raise NPAError(
            f"pictures and footprints must stay below {LARGEST_INDEX // 12} in one batch, got "
            f"{entries}, of {image[0]} worlds and {image[1]} views: split the batch"
        )
    if background is None:
        return
    _check_tensor("background", background, means, "that broadcasts to [B, V, H, W, K]")
    try:
        joined = torch.broadcast_shapes(background.shape, image)  # type: ignore[no-untyped-call]
        fits = tuple(joined) == image
    except RuntimeError:
        fits = False
    if not fits:
        raise NPAError(
            f"background must broadcast to [B, V, H, W, K] = {list(image)}, "
            f"got {tuple(background.shape)}: for example one colour of shape [{channels}]"
        )
