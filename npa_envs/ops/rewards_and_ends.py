"""Rewards, terminations and truncations of batched worlds, in one launch instead of forty."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.portable.rewards_and_ends import (
    CONTINUE,
    DIVERGED,
    END,
    LIMIT_LOSS,
    NOT_FINITE,
    SUCCESS,
    TIME_LIMIT,
    update_episodes,
)
from npa_envs.ops.launch import launch

__all__ = ["DIVERGED", "NOT_FINITE", "SUCCESS", "TIME_LIMIT", "EpisodeRules", "EpisodeUpdate"]

ON_DIVERGENCE = {"ignore": CONTINUE, "terminate": END, "reset": LIMIT_LOSS, "raise": LIMIT_LOSS}


class EpisodeRules(NamedTuple):
    """How losses become rewards, and when episodes end."""

    last_step: int | None
    """Step at which an episode is truncated, or None for never."""
    rewarded_step: int | None
    """Step at which, or earlier at its end, an episode is rewarded with minus its loss; None: each
    step is rewarded with the decrease of the loss."""
    on_divergence: Literal["ignore", "terminate", "reset", "raise"]
    """"ignore": divergence does not change the reward. Otherwise the loss of a diverged world is at
    least its first loss; with "terminate" its episode also ends."""


class EpisodeUpdate:
    """Computes rewards and endings of B worlds after each step, from their new losses.

    Args:
        enabled: Whether a step was made, uint8, shape [1]; 0: nothing changes.
        diverged: Which worlds diverged in the step, uint8, shape [B].
        first_loss: Loss at the start of each episode, shape [B].
        success_loss: Loss at which each episode ends in success, shape [B].
        elapsed: Steps of each episode, int32, shape [B]; increased by 1.
        numbers: Reward; loss; its L terms; their decreases; float32, shape [2 + 2 L, B]. Losses
            and terms of the step before are read; all become those of this step.
        flags: Terminated; truncated; success; diverged; bool, shape [4, B]; written.
        ending_bits: Bits of each world, such as `SUCCESS`, then `enabled`, uint8, shape [B + 1];
            written.
    """

    def __init__(
        self,
        rules: EpisodeRules,
        *,
        enabled: Tensor,
        diverged: Tensor,
        first_loss: Tensor,
        success_loss: Tensor,
        elapsed: Tensor,
        numbers: Tensor,
        flags: Tensor,
        ending_bits: Tensor,
    ) -> None:
        on_divergence = ON_DIVERGENCE[rules.on_divergence]
        self._rules = (rules.last_step or 0, rules.rewarded_step or 0, on_divergence)
        self._read = (enabled, diverged, first_loss, success_loss)
        self._written = (elapsed, numbers, flags.view(torch.uint8), ending_bits)
        self._world_count = len(elapsed)

    def __call__(self, loss_terms: Tensor, broken: Tensor | None = None) -> None:
        """Write this step's rewards and endings.

        A world's loss is the sum of its `loss_terms`, float32, contiguous, [L, B]. `broken`, uint8,
        [B], is 1 for worlds with another loss that is not finite; only "ignore" reads it.
        """
        launch(
            update_episodes,
            self._world_count,
            loss_terms.device,
            len(loss_terms),
            *self._rules,
            loss_terms,
            *self._read,
            broken,
            *self._written,
        )
