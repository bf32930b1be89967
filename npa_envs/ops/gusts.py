"""Gusts and blights of gardens as a torch operator, without gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.kernels.portable.gusts import gust_kernel
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import SCALARS, launch


@custom_op("npa::blow")
def blow(
    x: Tensor,
    keys: Tensor,
    episodes: Tensor,
    steps: Tensor,
    moves: Tensor,
    chances: list[float],
    radii: list[float],
    box: list[float],
) -> tuple[Tensor, Tensor]:
    """Return positions after gusts, [B, N, 2], and which particles blights hit, bool, [B, N].

    In each world a gust happens by the first of two `chances` and carries the particles around a
    random one by `moves`, [B, 2], as `push` does with the first of the `radii`. Then a blight hits
    by the second chance the particles within the second radius of a random one. Chances and places
    are draws 0, 2 and 3 of streams as `draw` takes them. `box` has two sides, 0 in open space.
    """
    moved, hit = torch.empty_like(x), x.new_empty(x.shape[:2], dtype=torch.uint8)
    lanes = x.shape[1] if x.is_cuda else 1
    numbers = tuple(chances), tuple(radii), tuple(box), lanes
    streams, size = (keys, episodes, steps), (x.shape[0], lanes)
    launch(gust_kernel(SCALARS[x.dtype]), size, x.device, *numbers, *streams, moves, x, moved, hit)
    return moved, hit.view(torch.bool)
