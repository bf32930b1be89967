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
from npa_envs.ops.mean import world_mean
from npa_envs.ops.perceive import NeighbourState, build_neighbours
from npa_envs.ops.physics import Limits, Physics, Terms
from npa_envs.ops.species import perceive_by_species
from npa_envs.ops.update import PreparedActions, wrapped
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.steps import draw_step

__all__ = [
    "DIVERGED",
    "NOT_FINITE",
    "SUCCESS",
    "TIME_LIMIT",
    "Actions",
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


class Actions:
    """What actions do to some worlds, in place, with the masks and the noise of `rollout`.

    Args:
        random: Where masks and noise come from; advanced by one step in each `draw`.
        enabled: Whether actions are applied, uint8, shape [1]: set to 0 where one is not finite,
            and no world changes; the caller sets it to 1 again.
        diverged: Set to 1 for worlds in which a number left its bounds or is not finite, to 0 for
            the others, uint8, shape [B]; such numbers are moved back to the bounds, NaN to 0.
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
        self._x = x
        self._physics = physics
        self._random = random
        self._diverged = diverged
        self._mask = self._noise = None
        self._everyone = torch.ones((), dtype=torch.bool, device=x.device).expand(x.shape[:2])
        if physics.update_prob < 1.0:
            self._mask = torch.zeros(x.shape[:2], dtype=torch.uint8, device=x.device)
        if physics.position_noise > 0.0:
            self._noise = torch.zeros_like(x)
        self._apply = PreparedActions(
            x, s, physics, mask=self._mask, noise=self._noise, enabled=enabled, diverged=diverged
        )

    @torch.no_grad()
    def draw(self) -> None:
        """Draw the next step's masks and noise; may be captured in a CUDA graph."""
        self._diverged.zero_()
        drawn = draw_step(self._x, self._physics, self._random)
        for own, new in ((self._mask, drawn.mask), (self._noise, drawn.noise)):
            if own is not None and new is not None:
                own.copy_(new)

    def updated(self) -> Tensor:
        """Return which particles the last draw updates, bool, shape [B, N]."""
        if self._mask is None:
            return self._everyone
        return self._mask.bool()

    def apply(self, action: Tensor) -> None:
        """Apply actions with what was drawn last.

        Args:
            action: Displacement as a fraction of α ε (D, norm clipped to 1), then state step as a
                fraction of `state_scale` (C, clipped to [-1, 1]); shape [B, N, A], any device.
        """
        self._apply(action)

    def hold(self, action: Tensor) -> None:
        """Copy actions, as `apply` takes them, to where `apply_held` reads them."""
        self._apply.hold(action)

    def apply_held(self) -> None:
        """Apply the actions held last with what was drawn last; may be captured in a CUDA graph."""
        self._apply.apply_held()


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

    Args:
        losses: The named parts of each world's loss, shape [B] each, of positions and states.
        after: The same after it.

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
