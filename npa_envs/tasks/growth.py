"""Growth from a ball of blank particles: what 2D and 3D morphogenesis have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from npa_envs.checks import check_non_negative, check_positive
from npa_envs.tasks.base import ParticleTask, TaskConfig, Worlds
from npa_envs.tasks.damage import PoolDamage, damage_pool, escape_motion
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.randomness import Randomness


@dataclass(frozen=True, kw_only=True)
class GrowthConfig(PoolDamage, TaskConfig):
    """What is grown from a ball, how it is damaged, and what the loss penalises."""

    target: str
    """What to grow."""

    alpha: float = 0.5
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    seed_radius: float = 0.2
    """Radius of the ball that the particles start in [length units]."""

    motion_weight: float = 0.01
    """Weight of the path length Σ|Δx| of a rollout (per length unit)."""

    bound_weight: float = 100.0
    """Weight of mean |x − clip(x, −1, 1)| (per length unit)."""

    escape_weight: float = 0.0
    """Weight of the mean path length of particles outside of [−1, 1] (per length unit)."""

    def __post_init__(self) -> None:
        """Check every field; raise NPAError where one has a wrong type or lies out of its range."""
        TaskConfig.__post_init__(self)
        PoolDamage.__post_init__(self)
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=8)
        check_positive(self, float, "alpha", "seed_radius")
        check_non_negative(self, "motion_weight", "bound_weight", "escape_weight")


GrowthConfigT = TypeVar("GrowthConfigT", bound=GrowthConfig)


class GrowthTask(ParticleTask[GrowthConfigT]):
    """A thing that grows in open space; a subclass compares it with its target."""

    aligned = True
    """What is grown is compared with the target pixel by pixel."""

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Further arguments of `NPARule`: all but channels, hidden width and ε0."""
        return {"space_dim": self.space_dim, "alpha": self.config.alpha}

    def places(self, world_count: int, generator: Randomness, device: torch.device) -> Tensor:
        """Return positions uniform in a ball around the origin."""
        count, radius = self.config.particle_count, self.config.seed_radius
        return uniform_ball(
            world_count, count, self.space_dim, radius, generator=generator, device=device
        )

    def damage(self, x: Tensor, s: Tensor, goal: Tensor | None, generator: Randomness) -> Worlds:
        """Return the worlds damaged as the configuration says, each at a place of its own."""
        return *damage_pool(x, s, self.config, generator=generator), goal

    def penalties(
        self, x: Tensor, s: Tensor, path_length: Tensor
    ) -> dict[str, tuple[float, Tensor]]:
        """Return motion, overflow, what lies outside of [-1, 1]^D, and the paths of strays."""
        config = self.config
        terms = {"motion": (config.motion_weight, path_length.mean())}
        terms |= super().penalties(x, s, path_length)
        inside = self.bounded(x)
        terms["bound"] = config.bound_weight, (inside - inside.clamp(-1.0, 1.0)).abs().mean()
        if config.escape_weight > 0.0:
            terms["stray"] = config.escape_weight, escape_motion(inside, path_length)
        return terms

    def bounded(self, x: Tensor) -> Tensor:
        """Return what should lie in [-1, 1], of positions [B, N, D]: their coordinates."""
        return x
