"""What the tasks share in which species grow pictures."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.envs.multi.config import SpeciesConfig
from npa_envs.tasks.checks import check_non_negative, check_positive
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig


@dataclass(frozen=True, kw_only=True)
class GrowthConfig(SpeciesConfig):
    """What tasks with pictures can be told besides."""

    resolution: int = 64
    """Pixels on each side of the picture that the loss compares."""

    sigma: float = 1.0
    """Standard deviation of a particle's splat, in pixels of the target (dimensionless)."""

    colour_weight: float = 5.0
    """Weight of the colour error against the density error (dimensionless)."""

    render_style: str = "particles"
    """What pictures show: "species" (a colour each), "particles" (their own colours), "density" or
    "states" (hidden channels)."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        super().__post_init__()
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=8)
        check_positive(self, float, "sigma")
        check_non_negative(self, "colour_weight")


def make_goal(
    config: GrowthConfig, target: str, particle_count: int, device: torch.device
) -> Morphogenesis2D:
    """Return the task of growing a target with so many particles.

    Args:
        config: The environment's configuration.
        target: A built-in name, an emoji, or the path of a picture.
        particle_count: Particles that the target is made for; as many points are in it.
        device: Where worlds are compared with it.

    Raises:
        NPAError: The target cannot be loaded.
    """
    return Morphogenesis2D(
        Morphogenesis2DConfig(
            target=target,
            target_point_count=particle_count,
            particle_count=particle_count,
            state_dim=config.state_dim,
            eps=config.eps,
            alpha=config.alpha,
            seed_radius=config.seed_radius,
            resolution=config.resolution,
            sigma=config.sigma,
            colour_weight=config.colour_weight,
        ),
        device=device,
    )


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
