"""Worlds that are acted on from outside: what particles perceive, and what an action does.

The same dynamics as `npa_envs.rollout`, with the rule taken out: an action stands where a rule's
bounded output stands. Nothing here waits for the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
from npa_envs.ops.passes import Terms
from npa_envs.ops.perceive import NeighbourState, build_neighbours
from npa_envs.ops.species import perceive_by_species
from npa_envs.ops.update import ActionRules, PreparedActions
from npa_envs.world.randomness import WorldRandom

__all__ = [
    "DIVERGED",
    "NOT_FINITE",
    "SUCCESS",
    "TIME_LIMIT",
    "Actions",
    "EpisodeRules",
    "MomentInverse",
    "NeighbourState",
    "Physics",
    "PreparedJudgement",
    "find_neighbours",
    "perceive_each_species",
]


@dataclass(frozen=True, kw_only=True)
class Physics:
    """The constants of a world that is acted upon."""

    space_dim: int
    """Space dimension D."""

    state_dim: int
    """State channels C."""

    eps: float
    """Perception radius ε [length units]."""

    eps0: float
    """Radius that perception is scaled to, that of the rule's training [length units]."""

    max_displacement: float
    """Largest displacement of a step, α ε [length units]."""

    state_scale: float
    """State step of an action of 1, dimensionless."""

    update_prob: float
    """Probability p of a particle's update in a step, dimensionless."""

    dt: float
    """Time step, dimensionless."""

    position_noise: float
    """Standard deviation of the noise on every position in a step [length units]."""

    box: tuple[float, ...] | None
    """Sides of the periodic box [length units], or None in open space."""

    moving: bool
    """Whether particles move; otherwise an action has no displacement."""

    moment_inverse: MomentInverse
    """How perceived state gradients are corrected, as in `npa_envs.perceive`."""

    perception_limit: float
    """What is perceived is clipped to plus and minus this, dimensionless."""

    position_limit: float
    """A coordinate beyond this is out of bounds [length units]."""

    state_limit: float
    """A state beyond this is out of bounds, dimensionless."""

    @property
    def perception_dim(self) -> int:
        """Length P of a perception vector."""
        return Terms().perception_dim(self.space_dim, self.state_dim)

    @property
    def action_dim(self) -> int:
        """Length A of an action: D + C, or C where particles are static."""
        return self.state_dim + (self.space_dim if self.moving else 0)


def find_neighbours(
    x: Tensor, s: Tensor, physics: Physics, places: Tensor | None = None
) -> NeighbourState:
    """Return worlds made ready for perception: sorted, their densities known.

    Args:
        x: Positions [length units], shape [B, N, D], finite.
        s: States, dimensionless, shape [B, N, C], finite; they may be read again later, where they
            are.
        physics: The worlds' constants.
        places: Which worlds of a larger batch these are, int64, shape [B]; default: their own one.
    """
    return build_neighbours(
        x,
        s,
        eps=physics.eps,
        eps0=physics.eps0,
        box=physics.box,
        terms=Terms(moment_inverse=physics.moment_inverse),
        limit=physics.perception_limit,
        places=places,
    )


def perceive_each_species(x: Tensor, counts: Sequence[int], physics: Physics) -> Tensor:
    """Return what particles perceive of each species besides `find_neighbours`, clipped.

    Args:
        x: Positions [length units], shape [B, N, D], finite, species after species.
        counts: Particles of each species, which sum to N; zeros for species that are gone.
        physics: The worlds' constants.

    Returns:
        c^D ρ_k / N of each species, then L(c^(1+D) ∇ρ_k / N) of each, species by species, zeros for
        those that are gone, dimensionless, shape [B, N, K (1 + D)].
    """
    found = perceive_by_species(
        x,
        tuple(counts),
        eps=physics.eps,
        eps0=physics.eps0,
        box=physics.box,
    )
    return found.clamp(-physics.perception_limit, physics.perception_limit)


class Actions:
    """What actions do to some worlds, in place, with the masks and the noise of `rollout`.

    Args:
        x: Positions [length units], shape [B, N, D], finite.
        s: States, dimensionless, shape [B, N, C], finite.
        physics: The worlds' constants.
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
        self._physics = physics
        self._random = random
        self._diverged = diverged
        self._mask = self._noise = None
        self._everyone = torch.ones((), dtype=torch.bool, device=x.device).expand(x.shape[:2])
        if physics.update_prob < 1.0:
            self._mask = torch.zeros(x.shape[:2], dtype=torch.uint8, device=x.device)
        if physics.position_noise > 0.0:
            self._noise = torch.zeros_like(x)
        rules = ActionRules(
            max_displacement=physics.max_displacement,
            dt=physics.dt,
            state_scale=physics.state_scale,
            moving=physics.moving,
            box=physics.box,
            position_limit=physics.position_limit,
            state_limit=physics.state_limit,
        )
        self._apply = PreparedActions(
            x, s, rules, mask=self._mask, noise=self._noise, enabled=enabled, diverged=diverged
        )

    @torch.no_grad()
    def draw(self) -> None:
        """Draw the next step's masks and noise; may be captured in a CUDA graph."""
        physics, random = self._physics, self._random
        self._diverged.zero_()
        random.advance()
        if self._mask is not None:
            self._mask.copy_(random.bernoulli(physics.update_prob, self._mask.shape[1]))
        if self._noise is not None:
            noise = random.normal(*self._noise.shape[1:], dtype=self._noise.dtype)
            self._noise.copy_(noise * physics.position_noise)

    def updated(self) -> Tensor:
        """Return which particles what was drawn last updates, bool, shape [B, N]."""
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
