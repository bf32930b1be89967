"""`npa/Mixing-v0`: species that start side by side are to mix."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.species.entropy import local_entropy
from npa_envs.envs.species.task import Population, SpeciesTask, by_species


class MixingTask(SpeciesTask):
    """Every particle is to see all species in equal parts: its loss is 1 less the local entropy."""

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the mean of each species' particle losses."""
        return {
            name: by_species(
                [
                    world_mean(loss[:, span, None])[:, 0]
                    for span in population.spans
                    if span.stop > span.start
                ],
                population,
            )
            for name, loss in self.particle_losses(population).items()
        }

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return 1 less the entropy of species around each particle."""
        return {"separation": 1.0 - self._entropy(population)}

    def _entropy(self, population: Population) -> Tensor:
        box = self.config.box_size if self.config.boundary == "periodic" else None
        return local_entropy(population, eps=self.config.eps, box=box)
