"""Pictures of coloured triangles, for targets that are meshes."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.kernels.pictures.triangles import draw_triangles
from npa_envs.ops.launch import launch


def nearest_triangles(
    place: Tensor,
    nearness: Tensor,
    colours: Tensor,
    faces: Tensor,
    seen: Tensor,
    *,
    width: int,
    height: int,
) -> Tensor:
    """Return red, green and blue of the nearest triangle at each pixel, and 1; elsewhere 0.

    Everything is on the CPU, in float64. A triangle covers a pixel where it covers its middle.

    Args:
        place: Where V cameras see K corners [pixels], shape [V, K, 2].
        nearness: One over the corners' depth [1 / length units], shape [V, K].
        colours: Of the corners, shape [K, 3].
        faces: Corners of each triangle, from 0 to K − 1, shape [F, 3].
        seen: Whether a camera sees a triangle, shape [V, F].
    """
    count = len(place)
    nearest = place.new_zeros(count, height * width)
    picture = place.new_zeros(count, height * width, 4)
    launch(
        draw_triangles,
        count,
        torch.device("cpu"),
        width,
        height,
        place.contiguous(),
        nearness.contiguous(),
        colours.contiguous(),
        faces.int().contiguous(),
        seen.to(torch.uint8).contiguous(),
        nearest,
        picture,
    )
    return picture.view(count, height, width, 4)
