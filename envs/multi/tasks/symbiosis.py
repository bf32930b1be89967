"""`npa/Symbiosis-v0`: species grow one picture that none of them can grow alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.envs.multi.task import Population, SpeciesTask
from npa_envs.envs.multi.tasks.picture_loss import OnePictureConfig, PictureLossTask


@dataclass(frozen=True, kw_only=True)
class SymbiosisConfig(OnePictureConfig):
    """As other pictures, but all species start in one disk."""

    seed_distance: float = 0.0


class SymbiosisTask(PictureLossTask):
    """The splat loss of all particles' picture, against a target of as many points."""

    config_type = SymbiosisConfig
    least_species = 1

    def __init__(self, config: SymbiosisConfig, device: torch.device) -> None:
        super().__init__(config, device, (config.target, sum(config.counts)))
        self.goal = self.goals[0]
        """The picture of all particles, whose target's colour scripted policies take."""

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the density error and the weighted colour error, the same for every species."""
        parts = self.picture_parts(0, population.x, population.s)
        count = len(population.counts)
        return {name: loss[:, None].expand(-1, count) for name, loss in parts.items()}

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return each particle's share of the splat loss."""
        return {"picture": self.goal.particle_shares(population.x, population.s)}

    # One picture in the middle, however far from it species begin.
    open_half_width = SpeciesTask.open_half_width
