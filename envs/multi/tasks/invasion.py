"""`npa/Invasion-v0`: species 0 grows a picture, the others keep it from doing so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.multi.task import Population
from npa_envs.envs.multi.tasks.picture_loss import OnePictureConfig, PictureLossTask
from npa_envs.errors import NPAError


@dataclass(frozen=True, kw_only=True)
class InvasionConfig(OnePictureConfig):
    """As other pictures, but rewards cannot be shared."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        if self.reward != "individual":
            raise NPAError(
                f"reward must be 'individual' in invasion, got {self.reward!r}: the sum of all "
                "rewards is zero, so there is nothing to share"
            )


class InvasionTask(PictureLossTask):
    """The splat loss of species 0; what it gains, the others lose together."""

    config_type = InvasionConfig

    def __init__(self, config: InvasionConfig, device: torch.device) -> None:
        super().__init__(config, device, (config.target, config.counts[0]))
        self.goal = self.goals[0]
        """The picture of species 0, whose target's colour scripted policies take."""

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the parts of species 0's splat loss, and minus an equal share for each other."""
        counts = population.counts
        return {
            name: torch.stack([loss, *[-loss / _others(counts)] * (len(counts) - 1)], dim=1)
            for name, loss in self.picture_parts(0, *population.of(0)).items()
        }

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return shares of species 0's splat loss, and minus an equal share for each other one."""
        own = self.goal.particle_shares(*population.of(0))
        own_count, other_count = own.shape[1], sum(population.counts[1:])
        share = world_mean(own[..., None])[:, 0] * (-own_count / max(other_count, 1))
        return {"picture": torch.cat((own, share[:, None].expand(-1, other_count)), dim=1)}

    def settle(self, rewards: Tensor, live: Tensor, species: Tensor) -> Tensor:
        """Return rewards of which the sum is zero: invaders pay in equal parts for species 0."""
        invading = species > 0
        gained = torch.where(invading, 0.0, rewards).sum(dim=1, keepdim=True)
        payers = live & invading
        return torch.where(payers, -gained / payers.sum(dim=1, keepdim=True).clamp_min(1), rewards)

    def is_over(self, counts: tuple[int, ...]) -> bool:
        """Return whether one side is gone."""
        return counts[0] == 0 or sum(counts[1:]) == 0


def _others(counts: tuple[int, ...]) -> int:
    return max(sum(count > 0 for count in counts[1:]), 1)
