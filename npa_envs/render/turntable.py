"""Films of 3D worlds that turn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.ops import Cameras, orbit
from npa_envs.ops.checks import checked_count, checked_finite
from npa_envs.render.picture import Background, to_uint8
from npa_envs.tasks.targets.views import ANGLE, DISTANCE


def turntable_frames(
    views: Callable[[Cameras], Tensor],
    *,
    frame_count: int = 60,
    resolution: int = 256,
    elevation: float = 20.0,
    azimuth: float = 0.0,
    background: Background = "white",
    device: str | torch.device = "cpu",
) -> list[NDArray[np.uint8]]:
    """Return pictures of a world from cameras that go once around it.

    Args:
        views: Draws the world: colours times alpha, and alpha, shape [1, V, H, W, 4].
        frame_count: Pictures of one turn.
        resolution: Pixels along each side.
        elevation: How far above the horizon the cameras are [degrees].
        azimuth: How far the first camera has gone round [degrees].
        background: A colour name, "#rrggbb", or red, green and blue in [0, 1].
        device: Where the world is.

    Returns:
        Pixels, uint8, shape [R, R, 3] each; the first row is the upper one.

    Raises:
        NPAError: A number is out of its range, or the colour is unknown.
    """
    frame_count = checked_count("frame_count", frame_count)
    azimuth = checked_finite("azimuth", azimuth, " [degrees]")
    frames = []
    with torch.no_grad():
        for k in range(frame_count):
            cameras = orbit(
                1,
                elevation,
                DISTANCE,
                ANGLE,
                width=resolution,
                height=resolution,
                azimuth=azimuth + 360.0 * k / frame_count,
            )
            picture = views(cameras.to(torch.device(device)))[0, 0]
            frames.append(to_uint8(picture.flip(0), background))
    return frames
