"""Sums over the points under brushes as a torch operator, without gradients."""

from __future__ import annotations

from torch import Tensor

from npa_envs.kernels.portable.brush_sums import brush_kernel
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
