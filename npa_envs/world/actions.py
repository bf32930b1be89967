"""Worlds that environments act on: perception and actions.

The dynamics of `npa_envs.rollout`, with an action in the place of a rule's bounded output. Nothing
waits for the device.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from npa_envs.checks import MomentInverse
from npa_envs.ops.episodes import (
    DIVERGED,
    NOT_FINITE,
    SUCCESS,
    TIME_LIMIT,
    EpisodeRules,
    PreparedJudgement,
)
from npa_envs.ops.perceive import NeighbourState, build_neighbours
from npa_envs.ops.physics import Boundary, Limits, Physics, Terms
from npa_envs.ops.species import perceive_by_species
from npa_envs.ops.update import PreparedActions, wrapped
from npa_envs.ops.world_mean import world_mean
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.steps import draw_step

__all__ = [
    "DIVERGED",
    "NOT_FINITE",
    "SUCCESS",
    "TIME_LIMIT",
    "Actions",
    "Boundary",
    "EpisodeRules",
    "Limits",
    "MomentInverse",
    "NeighbourState",
    "Physics",
    "PreparedJudgement",
    "Terms",
    "build_neighbours",
    "marginal_gains",
    "perceive_each_species",
    "with_mean_reward",
]


def perceive_each_species(x: Tensor, counts: Sequence[int], physics: Physics) -> Tensor:
    """Return `perceive_by_species`, clipped, shape [B, N, K (1 + D)]; zeros for species gone."""
    limit = physics.limits.perception
    return perceive_by_species(x, tuple(counts), physics).clamp(-limit, limit)


class Actions(PreparedActions):
    """What actions do to some worlds, in place, with the masks and the noise of `rollout`.

    Displacements are fractions of α ε (D, norm clipped to 1), state steps fractions of
    `state_scale` (C, clipped to [-1, 1]). `enabled` (uint8, [1]) is set to 0 where an action is not
    finite, and no world changes; the caller sets it to 1 again. `diverged` (uint8, [B]) is set to 1
    for worlds in which a number left its bounds or is not finite, to 0 for the others; such numbers
    are moved back to the bounds, NaN to 0.
    """

    def __init__(
        self,
        x: Tensor,
        s: Tensor,
        physics: Physics,
        random: WorldRandom,
        *,
        enabled: Tensor,
        diverged: Tensor,
    ) -> None:
        self._random = random
        self._everyone = torch.ones((), dtype=torch.bool, device=x.device).expand(x.shape[:2])
        mask = noise = None
        if physics.update_prob < 1.0:
            mask = torch.zeros(x.shape[:2], dtype=torch.uint8, device=x.device)
        if physics.position_noise > 0.0:
            noise = torch.zeros_like(x)
        super().__init__(x, s, physics, mask=mask, noise=noise, enabled=enabled, diverged=diverged)

    apply = PreparedActions.__call__

    @torch.no_grad()
    def draw(self) -> None:
        """Draw the next step's masks and noise; may be captured in a CUDA graph."""
        *held, _, diverged = self._step
        diverged.zero_()
        drawn = draw_step(self._worlds[0], self._physics, self._random)
        for own, new in zip(held, drawn[:2], strict=True):
            if own is not None and new is not None:
                own.copy_(new)

    def updated(self) -> Tensor:
        """Return which particles the last draw updates, bool, shape [B, N]."""
        mask = self._step[0]
        return self._everyone if mask is None else mask.bool()


def marginal_gains(
    losses: Callable[[Tensor, Tensor], Mapping[str, Tensor]],
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
    box: tuple[float, ...] | None,
) -> Tensor | None:
    """Return marginal credit: how much each particle's action lowered the loss, times N; [B, N].

    A particle's part of a step is what it changed, times the loss's slope in the middle of the
    step. For losses that are quadratic in what particles change, that is the mean of its marginal
    contribution to what all others did and to what they had not yet done (its Shapley value), and
    the mean over the particles is what the loss fell; for others it is so up to third order. What a
    task holds constant in its gradients stays constant.

    `losses` gives the named parts of each world's loss, shape [B] each, of positions and states.
    None is returned where no gradient leads from them to positions or states.
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
