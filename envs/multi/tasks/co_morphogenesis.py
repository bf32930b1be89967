"""`npa/CoMorphogenesis-v0`: each species grows a picture of its own, in one world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.envs.multi.task import Population, by_species
from npa_envs.envs.multi.tasks.picture_loss import PictureLossConfig, PictureLossTask
from npa_envs.errors import NPAError

USUAL = ("gecko", "heart", "butterfly", "flower", "octopus", "ring")
"""What species grow that are told nothing, in turn."""


@dataclass(frozen=True, kw_only=True)
class CoMorphogenesisConfig(PictureLossConfig):
    """What growing side by side, or through each other, can be told besides."""

    targets: tuple[str, ...] = ()
    """What each species grows: built-in names (`npa-envs list`), emoji, or paths of pictures;
    empty: built-in ones."""

    seed_distance: float = 1.0
    """Distance between the centres of neighbouring disks [length units]; 0 grows pictures through
    each other, 2 side by side."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        names = self.targets
        named = isinstance(names, tuple) and all(isinstance(n, str) and n for n in names)
        if names and (not named or len(names) != self.species_count):
            raise NPAError(
                f"targets must be {self.species_count} names, emoji or paths, one for each of "
                f"species_count = {self.species_count}, got {names!r}: for example "
                f"targets={self._usual}"
            )

    @property
    def goals(self) -> tuple[str, ...]:
        """What each species grows."""
        return self.targets or self._usual

    @property
    def _usual(self) -> tuple[str, ...]:
        return tuple(USUAL[k % len(USUAL)] for k in range(self.species_count))


class CoMorphogenesisTask(PictureLossTask):
    """A splat loss for each species, of its own particles against its own target."""

    config_type = CoMorphogenesisConfig
    least_species = 1

    def __init__(self, config: CoMorphogenesisConfig, device: torch.device) -> None:
        super().__init__(config, device, *zip(config.goals, config.counts, strict=True))

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the density error and the weighted colour error of each species' picture."""
        parts = [self.picture_parts(k, *population.of(k)) for k in present(population)]
        return {name: by_species([part[name] for part in parts], population) for name in parts[0]}

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return each particle's share of its species' splat loss."""
        shares = [self.goals[k].particle_shares(*population.of(k)) for k in present(population)]
        return {"picture": torch.cat(shares, dim=1)}


def present(population: Population) -> list[int]:
    """Return the species that have particles."""
    return [k for k, count in enumerate(population.counts) if count]
