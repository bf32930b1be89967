"""Losses of 2D worlds' pictures against a target, without gradient and at once."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.pictures.splat import CHANNELS, group_count, make_lens
from npa_envs.ops.launch import launch, scalar_type
from npa_envs.ops.mean import average_sums
from npa_envs.ops.opaque import opaque
from npa_envs.ops.pictures.splat import (
    Splats,
    aligned,
    check_particles,
    checked_window,
    device_kernels,
    gather_threads,
    scatter_splats,
    sort_splats,
)


@opaque("npa::picture_losses")
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
    lens = make_lens(scalar, target.shape[0], pixel_size, sigma, low, high)
    splats = Splats(x, states, shift, goal)
    group_total = group_count(lens.resolution) if device.type == "cuda" else lens.resolution
    partial_sums = x.new_empty(world_count, group_total, 2, dtype=torch.float64)
    if device.type == "cuda":
        starts, footprints, _ = sort_splats(splats, lens)
        pixels = aligned(target).view(-1, CHANNELS)
        threads = gather_threads(world_count, lens.resolution, device)
        gathered = (starts, footprints, pixels, partial_sums)
        launch(device_kernels(x).gather_errors, threads, device, lens, *gathered)
    else:
        picture, *_ = scatter_splats(splats, lens)
        rows = (world_count, group_total)
        launch(
            device_kernels(x).sum_errors, rows, device, picture, target.contiguous(), partial_sums
        )
    return average_sums(partial_sums, lens.resolution**2, x)


@_picture_losses.register_fake
def _(x: Tensor, *rest: Any) -> Tensor:
    return x.new_empty(x.shape[0], 2)


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
    """Compare worlds with a picture at once; without gradient.

    Each world's mean position is moved to `goal` and drawn as by `splat`; colours are the last
    three states plus `shift`. With d the difference from the target and e = |d| + d^2, a pixel's
    density error is that of the densities, its colour error is the mean of e over the colours times
    exp(-(density error)).

    Args:
        x: Particle positions [length units], shape [B, N, 2].
        states: States, dimensionless, shape [B, N, C], C at least 3.
        target: Picture to compare with, dimensionless, shape [R, R, 4].
        goal: Where each world's mean is moved to [length units], shape [2].
        shift: What is added to states to give colours, dimensionless.
        pixel_size: As for `splat`.
        sigma: As for `splat`.
        lo: As for `splat`.
        hi: As for `splat`.

    Returns:
        Means over the pixels of the density error and of the colour error, shape [B] each. World
        k's are the same, bit for bit, in every batch.

    Raises:
        NPAError: A shape does not fit or a number is out of its range.
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
        x.contiguous(),
        states.contiguous(),
        goal.contiguous(),
        target,
        shift,
        *window[1:],
    )
    return losses[:, 0], losses[:, 1]
