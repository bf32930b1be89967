"""Losses of 2D worlds' pictures against a target, without gradient, in fused kernels."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.pictures.errors import BLOCK_TILES, ROUND_TILES, gather_errors, sum_errors
from npa_envs.kernels.pictures.splat import CHANNELS, make_view
from npa_envs.kernels.primitives import CUDA_BLOCK
from npa_envs.ops.backend import multiprocessor_count
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import aligned, launch, scalar_type
from npa_envs.ops.pictures.splat import (
    Splats,
    check_particles,
    checked_window,
    scatter_splats,
    sort_splats,
)
from npa_envs.ops.world_mean import average_sums

BLOCKS_OF_PROCESSOR = 4
"""Blocks per multiprocessor that gather errors in parallel."""


@custom_op("npa::picture_losses")
def _picture_losses(
    x: Tensor,
    states: Tensor,
    goal: Tensor,
    target: Tensor,
    shift: float,
    pixel_size: float,
    sigma: float,
    low: float,
    high: float,
) -> Tensor:
    world_count, device, scalar = x.shape[0], x.device, scalar_type(x.dtype)
    view = make_view(scalar, int(target.shape[0]), pixel_size, sigma, low, high)
    splats = Splats(x, states, shift, goal)
    if device.type == "cuda":
        starts, footprints, _ = sort_splats(splats, view)
        tile_total = view.tile_columns * view.tile_rows
        partial_sums = x.new_empty(world_count, tile_total, 2, dtype=torch.float64)
        # Fewer tiles for a block if many would leave multiprocessors idle.
        tile_count, fewest = BLOCK_TILES, BLOCKS_OF_PROCESSOR * multiprocessor_count(device)
        while tile_count > ROUND_TILES and world_count * tile_total < fewest * tile_count:
            tile_count //= 2
        threads = world_count * -(-tile_total // tile_count) * CUDA_BLOCK
        pixels = aligned(target).view(-1, CHANNELS)
        gathered = (tile_count, starts, footprints, pixels, partial_sums)
        launch(gather_errors(scalar), threads, device, view, *gathered)
    else:
        picture, *_ = scatter_splats(splats, view)
        rows = (world_count, view.resolution)
        partial_sums = x.new_empty(*rows, 2, dtype=torch.float64)
        launch(sum_errors(scalar), rows, device, picture, target.contiguous(), partial_sums)
    return average_sums(partial_sums, view.resolution**2, x)


def picture_losses(
    x: Tensor,
    states: Tensor,
    target: Tensor,
    *,
    goal: Tensor,
    shift: float,
    pixel_size: float,
    sigma: float = 1.0,
    lo: float = -1.0,
    hi: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """Compare worlds with a picture without writing theirs (on CUDA); without gradient.

    Each world's mean position is moved to `goal` and drawn as by `splat`; colours are the last
    three states plus `shift`. With d the difference from the target and e = |d| + d^2, a pixel's
    density error is that of the densities, its colour error is the mean of e over the colours times
    exp(-(density error)). The target has shape [R, R, 4], the goal [2].

    Returns:
        Means over the pixels of the density error and of the colour error, shape [B] each, bit for
        bit the same in every batch.
    """
    check_particles(x, states, None)
    resolution = target.shape[0] if target.ndim else 0
    if tuple(target.shape) != (resolution, resolution, CHANNELS) or tuple(goal.shape) != (2,):
        raise NPAError(
            f"target and goal must have shapes [R, R, {CHANNELS}] and [2], "
            f"got {tuple(target.shape)} and {tuple(goal.shape)}"
        )
    window = checked_window(resolution, pixel_size, sigma, lo, hi)
    x, states, target, goal = (t.detach() for t in (x, states, target.to(x), goal.to(x)))
    losses = _picture_losses(
        x.contiguous(), states.contiguous(), goal.contiguous(), target, shift, *window[1:]
    )
    return losses[:, 0], losses[:, 1]
