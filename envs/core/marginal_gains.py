"""Rewards of single particles: how much each one's action lowered the loss of its world."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from npa_envs.world.environment_steps import wrapped


def marginal_gains(
    losses: Callable[[Tensor, Tensor], Mapping[str, Tensor]],
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
    box: tuple[float, ...] | None,
) -> Tensor | None:
    """Return marginal rewards: how much each particle's action lowered the loss, times N; [B, N].

    It is the change that the particle made in the step, times the gradient of the loss in the
    middle of the step. The mean over the particles is the decrease of the loss, and the reward is
    the particle's Shapley value: exactly for losses that are quadratic in the changes, and up to
    third order for others. Detached parts of the loss do not count.

    `losses` maps positions and states to the named parts of each world's loss, shape [B] each. The
    result is None if no gradient flows from them to positions or states.
    """
    moved, changed = wrapped(after[0] - before[0], box), after[1] - before[1]
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
            # Added one by one, because torch's sums have no fixed order.
            for column in (slope * change).unbind(dim=-1):
                gains = gains - column
    return gains * gains.shape[1]
