"""How much better actions were than foreseen: generalised advantage estimation."""

from __future__ import annotations

import torch
from torch import Tensor


def generalised_advantages(
    rewards: Tensor,
    values: Tensor,
    following: Tensor,
    terminated: Tensor,
    ended: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Return advantages, shape [T, ...]: discounted sums of what the critic did not foresee.

    An episode that terminated is worth nothing more; one that was cut off would have gone on, and
    is worth what the critic says of where it was cut. No sum goes on into the next episode.
    Source: Schulman et al., arXiv 1506.02438, equation 16.

    Args:
        rewards: Of each step, shape [T, ...].
        values: What the critic says of the states before each step, likewise.
        following: What it says of the states after each step, before any restart, likewise.
        terminated: Whether the episode ended by itself in the step, bool, likewise.
        ended: Whether it ended or was cut off, bool, likewise.
        gamma: Discount of a reward one step later (dimensionless).
        gae_lambda: Discount of what was not foreseen, besides (dimensionless).
    """
    surprises = rewards + gamma * following.masked_fill(terminated, 0.0) - values
    discounts = (gamma * gae_lambda) * (~ended).to(rewards.dtype)
    advantages = torch.empty_like(surprises)
    later = torch.zeros_like(surprises[0])
    for step in reversed(range(len(surprises))):
        later = surprises[step] + discounts[step] * later
        advantages[step] = later
    return advantages
