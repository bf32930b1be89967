"""Mean within each world as a torch operator: the same in every batch, bit for bit."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.checks import check_floating
from npa_envs.errors import NPAError
from npa_envs.kernels.portable.world_mean import CHUNK, MEAN_LANES, mean_kernels
from npa_envs.ops.custom_op import check_derivatives, custom_op
from npa_envs.ops.launch import SCALARS, launch


def average_sums(partial_sums: Tensor, value_count: int, like: Tensor) -> Tensor:
    """Return `partial_sums`, float64 [B, K, F], summed over K, / `value_count`, typed as `like`."""
    world_count, _, width = partial_sums.shape
    lanes = _lanes(like.device)
    kernels = mean_kernels(SCALARS[like.dtype], lanes)
    means = like.new_empty(world_count, width)
    launch(
        kernels.average_sums,
        (world_count, width, lanes),
        like.device,
        float(value_count),
        partial_sums,
        means,
    )
    return means


def _lanes(device: torch.device) -> int:
    return MEAN_LANES if device.type == "cuda" else 1


def average(values: Tensor) -> Tensor:
    """Return what `world_mean` does, within another operator, for checked values."""
    world_count, value_count, width = values.shape
    lanes = _lanes(values.device)
    kernels = mean_kernels(SCALARS[values.dtype], lanes)
    chunk_count = -(-value_count // CHUNK)
    partial_sums = values.new_empty(world_count, chunk_count, width, dtype=torch.float64)
    launch(
        kernels.sum_chunks,
        (world_count, width, chunk_count, lanes),
        values.device,
        values.contiguous(),
        partial_sums,
    )
    return average_sums(partial_sums, value_count, values)


_world_mean = custom_op("npa::world_mean")(average)


class _WorldMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.value_count = values.shape[1]
        means: Tensor = _world_mean(values)
        return means

    @staticmethod
    def backward(ctx: Any, means_bar: Tensor) -> Tensor:
        count: int = ctx.value_count
        return (means_bar / count)[:, None].expand(-1, count, -1)


def world_mean(values: Tensor) -> Tensor:
    """Return the mean within each world; differentiable, bit for bit independent of other worlds.

    It is summed in float64 in an order that depends only on M. The order of torch's own means may
    change with the number of worlds, and with it their last bit.

    Args:
        values: Values to average over M, shape [B, M, F], float32 or float64.

    Returns:
        The means, shape [B, F].

    Raises:
        NPAError: A wrong shape or dtype, or nothing to average.
    """
    check_floating("values", values)
    if values.ndim != 3 or 0 in values.shape:
        raise NPAError(
            f"values must have shape [B, M, F] with at least one of each, "
            f"got {tuple(values.shape)}: reshape it"
        )
    check_derivatives(values=values)
    if not (torch.is_grad_enabled() and values.requires_grad):
        return _world_mean(values)
    means: Tensor = _WorldMean.apply(values)  # type: ignore[no-untyped-call]
    return means


def scalar_world_mean(values: Tensor) -> Tensor:
    """Return the mean within each world of all its numbers [B, ...], as `world_mean`, [B]."""
    return world_mean(values.flatten(1)[..., None])[:, 0]
