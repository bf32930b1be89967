"""Configuration and loss of the tasks in which species grow pictures."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.envs.multi.task import SpeciesConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig


@dataclass(frozen=True, kw_only=True)
class GrowthConfig(SpeciesConfig):
    """Adds the loss of `Morphogenesis2DConfig`, which explains it."""

    task_config_type = Morphogenesis2DConfig

    resolution: int = 64
    sigma: float = Morphogenesis2DConfig.sigma
    colour_weight: float = Morphogenesis2DConfig.colour_weight
    render_style: str = "particles"

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        super().__post_init__()
        _ = self.goal_config()

    def goal_config(
        self, target: str = Morphogenesis2DConfig.target, particle_count: int = 1
    ) -> Morphogenesis2DConfig:
        """Return what the task of growing a target with so many particles is told.

        Args:
            target: A built-in name, an emoji, or the path of a picture.
            particle_count: Particles that the target is made for; as many points are in it.
        """
        return self.task_config(
            Morphogenesis2DConfig,
            target=target,
            target_point_count=particle_count,
            particle_count=particle_count,
        )


@dataclass(frozen=True, kw_only=True)
class OneTargetConfig(GrowthConfig):
    """Adds the one picture of tasks that have no other."""

    target: str = Morphogenesis2DConfig.target

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        super().__post_init__()
        _ = self.goal_config(self.target)


def make_goal(
    config: GrowthConfig, target: str, particle_count: int, device: torch.device
) -> Morphogenesis2D:
    """Return the task of growing a target with so many particles.

    Args:
        config: The environment's configuration.
        target: A built-in name, an emoji, or the path of a picture.
        particle_count: Particles that the target is made for.
        device: Where worlds are compared with it.

    Raises:
        NPAError: The target cannot be loaded.
    """
    return Morphogenesis2D(config.goal_config(target, particle_count), device=device)


def row_half_width(config: GrowthConfig) -> float:
    """Return half of a picture that shows a target in the place of every seed [length units].

    Args:
        config: The environment's configuration.
    """
    return float(1.0 + 0.5 * (config.species_count - 1) * config.seed_distance)


def picture_parts(goal: Morphogenesis2D, x: Tensor, s: Tensor) -> dict[str, Tensor]:
    """Return the density error and the weighted colour error of worlds, shape [B] each."""
    density, colour = goal.splat_losses(x, s)
    return {"density": density, "colour": goal.config.colour_weight * colour}
