"""`npa/Symbiosis-v0`: species grow one picture that none of them can grow alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.envs.multi.task import Population, SpeciesTask
from npa_envs.envs.multi.tasks.growth import OneTargetConfig, make_goal, picture_parts


@dataclass(frozen=True, kw_only=True)
class SymbiosisConfig(OneTargetConfig):
    """What symbiosis can be told besides: species start in one disk."""

    seed_distance: float = 0.0
    """Distance between the centres of neighbouring disks, which lie in a row [length units]."""


class SymbiosisTask(SpeciesTask):
    """The splat loss of all particles' picture, against a target of as many points.

    Args:
        config: The environment's configuration.
        device: Where the world lives.

    Raises:
        NPAError: The target cannot be loaded.
    """

    config_type = SymbiosisConfig
    least_species = 1

    def __init__(self, config: SymbiosisConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self.goal = make_goal(config, config.target, sum(config.counts), device)
        """The task with its target and its loss."""

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the density error and the weighted colour error, the same for every species."""
        parts = picture_parts(self.goal, population.x, population.s)
        count = len(population.counts)
        return {name: loss[:, None].expand(-1, count) for name, loss in parts.items()}

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return each particle's share of the splat loss."""
        return {"picture": self.goal.particle_shares(population.x, population.s)}

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: the distance of the target's points."""
        return self.goal.target.pixel_size
