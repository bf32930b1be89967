"""`npa/Segregation-v0`: species that start all mixed are to part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from npa_envs.envs.species.config import SpeciesConfig
from npa_envs.envs.species.mixing import MixingTask
from npa_envs.envs.species.task import Population


@dataclass(frozen=True, kw_only=True)
class SegregationConfig(SpeciesConfig):
    """What segregation can be told besides: nothing, but species start in one disk."""

    seed_distance: float = 0.0
    """Distance between the centres of neighbouring disks, which lie in a row [length units]."""


class SegregationTask(MixingTask):
    """Every particle is to see its own species alone: its loss is the local entropy."""

    config_type = SegregationConfig

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the entropy of species around each particle."""
        return {"mixture": self._entropy(population)}
