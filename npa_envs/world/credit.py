"""Marginal credit: what a world would have lost without one particle's action."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from npa_envs.ops import world_mean
from npa_envs.ops.update import wrapped


def marginal_gains(
    losses: Callable[[Tensor, Tensor], Mapping[str, Tensor]],
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
    box: tuple[float, ...] | None,
) -> Tensor | None:
    """Return how much less each particle's action made the loss, times N; shape [B, N].

    A particle's part of a step is what it changed, times the loss's slope in the middle of the
    step. For losses that are quadratic in what particles change, that is the mean of its marginal
    contribution to what all others did and to what they had not yet done (its Shapley value), and
    the mean over the particles is what the loss fell; for others it is so up to third order. What a
    task holds constant in its gradients is constant here.

    Args:
        losses: The named parts of each world's loss, shape [B] each, of positions and states.
        before: Positions [length units], shape [B, N, D], and states, shape [B, N, C], before a
            step.
        after: The same after it.
        box: Sides of the periodic box [length units], or None in open space.

    Returns:
        The gains, or None where no gradient leads from the losses to positions or states.
    """
    moved = wrapped(after[0] - before[0], box)
    changed = after[1] - before[1]
    with torch.enable_grad():
        x = wrapped(after[0] - 0.5 * moved, box).requires_grad_()
        s = (after[1] - 0.5 * changed).requires_grad_()
        total = torch.stack(list(losses(x, s).values())).sum()
        if not total.requires_grad:
            return None
        slopes = torch.autograd.grad(total, (x, s), allow_unused=True)
    gains = torch.zeros_like(moved[..., 0])
    for slope, change in zip(slopes, (moved, changed), strict=True):
        if slope is not None:
            # Added one by one: the order of torch's own sums is not promised.
            for column in (slope * change).unbind(dim=-1):
                gains = gains - column
    return gains * gains.shape[1]


def with_mean_reward(gains: Tensor, reward: Tensor) -> Tensor:
    """Return particles' gains, [B, N], with what they miss of the worlds' rewards, [B], shared."""
    missed = reward - world_mean(gains[..., None])[:, 0]
    return gains + missed[:, None]
