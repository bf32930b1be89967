"""Sums over the points under brushes, and gusts, as torch operators, without gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.kernels.portable.brush_sums import brush_kernel, gust_kernel
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import SCALARS, launch


@custom_op("npa::brush_sums")
def brush_sums(
    centres: Tensor, points: Tensor, values: Tensor, radius: float, box: list[float], moments: bool
) -> Tensor:
    """Return sums of values, [B, I, W], of points, [B, I, 2], under brushes, [B, J, 2].

    A point at r radii from a centre has the weight (1 - r²)², and none beyond. With `moments` the
    sums of 1 and of offsets from the centre, in radii, come first: [B, J, 3 + W], else [B, J, W].
    They are summed in float64, in the order of the points. `box` has two sides, 0 in open space.
    """
    width = int(values.shape[2])
    sums = points.new_empty(*centres.shape[:2], 3 * moments + width)
    kernel, size = brush_kernel(SCALARS[points.dtype], width, moments), sums.shape[:2]
    places = centres.contiguous(), points.contiguous()
    launch(kernel, tuple(size), points.device, radius, tuple(box), *places, values, sums)
    return sums


@custom_op("npa::gusts")
def gusts(
    x: Tensor, streams: list[Tensor], moves: Tensor, hits: Tensor, radius: float, box: list[float]
) -> tuple[Tensor, Tensor]:
    """Return positions after gusts, [B, N, 2], and which particles are hit then, bool, [B, N].

    A gust carries particles around a random one by `moves`, [B, 2], as `push` does with `radius`;
    `hits` are radii around another one, [B]. `streams`: keys, episodes and steps as for `draw`.
    """
    moved, hit = torch.empty_like(x), x.new_empty(x.shape[:2], dtype=torch.uint8)
    lanes = x.shape[1] if x.is_cuda else 1
    arrays, size = (*streams, moves, hits, x, moved, hit), (x.shape[0], lanes)
    launch(gust_kernel(SCALARS[x.dtype]), size, x.device, radius, tuple(box), lanes, *arrays)
    return moved, hit.view(torch.bool)
