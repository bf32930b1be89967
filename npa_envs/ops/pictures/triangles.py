"""Pictures of coloured triangles, for targets that are meshes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.pictures.triangles import WRAPS, draw_triangles
from npa_envs.ops.launch import launch

WRAP_NUMBERS = {wrap: k for k, wrap in enumerate(WRAPS)}
"""The number of what a texture shows beyond its edges: "repeat", "mirror" or "clamp"."""


class TexturedFaces(NamedTuple):
    """Textures, and where they lie on triangles."""

    texels: Tensor
    """Texels of all levels of all textures, sRGB, row by row, uint8, shape [any, 3]."""
    levels: Tensor
    """First texel, width and height of each level of each texture, from the finest, int32, shape
    [T, L, 3]; 0 where a texture has fewer."""
    wrap: Tensor
    """Numbers of `WRAP_NUMBERS` along u and v, int32, shape [T, 2]."""
    brightness: Tensor
    """Linear brightness of each sRGB value, float64, shape [256]."""
    of_face: Tensor
    """Index of each triangle's texture, -1 for none, int32, shape [F]."""
    places: Tensor
    """u and v of each corner of each triangle, float64, shape [F, 3, 2]."""
    light: Tensor
    """Factor on the sRGB colour at each corner of each triangle, float64, shape [F, 3]."""


def nearest_triangles(
    positions: Tensor,
    nearness: Tensor,
    colours: Tensor,
    faces: Tensor,
    visible: Tensor,
    textures: TexturedFaces | None = None,
    *,
    width: int,
    height: int,
) -> Tensor:
    """Return pictures [V, H, W, 4] of triangles, on the CPU in float64.

    A pixel has the colour of the nearest triangle over its centre, and 1; without one it is 0. Q
    corners have `positions` in the pictures of V cameras [pixels], [V, Q, 2], `nearness` 1 / depth
    [1 / length units], [V, Q]. `faces`, [F, 3], are the corners of triangles, `colours`, [F, 3, 3],
    what they have there, and `visible`, [V, F], says which cameras see them. On a triangle with a
    texture, `colours` multiply the texture in linear light.
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
        *(textures or (None,) * len(TexturedFaces._fields)),
        nearest,
        picture,
    )
    return picture.view(count, height, width, 4)
