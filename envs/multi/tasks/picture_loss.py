"""The base of tasks in which species grow pictures: configuration, targets, splat loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.envs.multi.task import SpeciesConfig, SpeciesTask
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig


@dataclass(frozen=True, kw_only=True)
class PictureLossConfig(SpeciesConfig):
    """Adds the loss of `Morphogenesis2DConfig`, which explains it."""

    task_config_type = Morphogenesis2DConfig

    resolution: int = 64
    sigma: float = Morphogenesis2DConfig.sigma
    colour_weight: float = Morphogenesis2DConfig.colour_weight
    render_style: str = "particles"

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        _ = self.goal()

    def goal(
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
class OnePictureConfig(PictureLossConfig):
    """Adds the picture of tasks that have but one."""

    target: str = Morphogenesis2DConfig.target

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        _ = self.goal(self.target)


class PictureLossTask(SpeciesTask):
    """Pictures to grow, each compared by the splat loss of `npa_envs.tasks.morphogenesis2d`.

    Args:
        config: The environment's configuration.
        device: Where the world lives.
        pictures: Names of targets, and the particles that each is made for.

    Raises:
        NPAError: A target cannot be loaded.
    """

    def __init__(self, config: Any, device: torch.device, *pictures: tuple[str, int]) -> None:
        super().__init__(config, device)
        self.goals = [Morphogenesis2D(config.goal(*picture), device=device) for picture in pictures]
        """The tasks of growing each picture, with targets and losses."""

    def picture_parts(self, k: int, x: Tensor, s: Tensor) -> dict[str, Tensor]:
        """Return density error and weighted colour error against picture k, shape [B] each."""
        density, colour = self.goals[k].splat_losses(x, s)
        return {"density": density, "colour": self.config.colour_weight * colour}

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: the distance of the first target's points."""
        return self.goals[0].target.pixel_size

    @property
    def open_half_width(self) -> float:
        """Half of a picture [length units] in which a target fits where each seed was."""
        return float(1.0 + 0.5 * (self.config.species_count - 1) * self.config.seed_distance)
