"""What PPO maximises: how much better actions were than foreseen, and are now likelier."""

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


def over_particles(values: Tensor, weights: Tensor) -> Tensor:
    """Return weighted means over the particles of worlds, 0 where nothing has weight, [..., 1].

    Args:
        values: Shape [..., N].
        weights: Likewise, not negative.
    """
    total = (values * weights).sum(dim=-1, keepdim=True)
    return total / weights.sum(dim=-1, keepdim=True).clamp(min=1e-8)


def standardised(values: Tensor, weights: Tensor) -> Tensor:
    """Return numbers less each step's weighted mean, in units of the standard deviation of all.

    A step's mean over all worlds is what it is worth whatever is done: how far an episode has come,
    which a critic learns only with time. A single world is compared with its own other steps.

    Args:
        values: Shape [T, B, N], or [T, B, 1] for one number a world.
        weights: Shape [T, B, N], not negative.
    """
    shares = weights if values.shape == weights.shape else weights.amax(-1, True)
    alike = (1, 2) if values.shape[1] > 1 else (0, 1, 2)
    total = shares.sum(alike, keepdim=True).clamp(min=1e-8)
    centred = shares * (values - (values * shares).sum(alike, keepdim=True) / total)
    return centred / (centred.square().sum() / shares.sum().clamp(min=1e-8) + 1e-16).sqrt()


def clipped_gain(log_ratio: Tensor, advantages: Tensor, weights: Tensor, *, clip: float) -> Tensor:
    """Return the weighted mean of min(r A, clip(r) A), for r the ratio of likelihoods to before.

    Source: Schulman et al., arXiv 1707.06347, equation 7.

    Args:
        log_ratio: Logarithms of the ratios, one a particle or one a world, shape [M, N] or [M, 1].
        advantages: Likewise.
        weights: Likewise, not negative.
        clip: Ratios count up to 1 plus or minus this (dimensionless).
    """
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    gain = torch.minimum(ratio * advantages, clipped * advantages)
    return (weights * gain).sum() / weights.sum().clamp(min=1.0)
