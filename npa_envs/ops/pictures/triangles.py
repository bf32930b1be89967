"""Pictures of coloured triangles, for targets that are meshes."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.kernels.pictures.triangles import draw_triangles
from npa_envs.ops.launch import launch


def nearest_triangles(
    positions: Tensor,
    nearness: Tensor,
    colours: Tensor,
    faces: Tensor,
    visible: Tensor,
    *,
    width: int,
    height: int,
) -> Tensor:
    """Return pictures [V, H, W, 4] of triangles, on the CPU in float64.

    A pixel has the colour of the nearest triangle over its centre, and 1; without one it is 0. Q
    corners have `positions` in the pictures of V cameras [pixels], [V, Q, 2], `nearness` 1 / depth
    [1 / length units], [V, Q]. `faces`, [F, 3], are the corners of triangles, `colours`, [F, 3, 3],
    what they have there, and `visible`, [V, F], says which cameras see them.
    """
    count = len(positions)
    nearest = positions.new_zeros(count, height * width)
    picture = positions.new_zeros(count, height * width, 4)
    launch(
        draw_triangles,
        count,
        torch.device("cpu"),
        width,
        height,
        positions.contiguous(),
        nearness.contiguous(),
        colours.contiguous(),
        faces.int().contiguous(),
        visible.to(torch.uint8).contiguous(),
        nearest,
        picture,
    )
    return picture.view(count, height, width, 4)
