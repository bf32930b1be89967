"""`npa/Mixing-v0` and `npa/Segregation-v0`: species that start apart mix, or mixed ones part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs import perceive, world_mean
from npa_envs.envs.multi.task import Population, SpeciesConfig, SpeciesTask, by_species


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
        return local_entropy(population, eps=self.config.eps, box=self.config.box)


@dataclass(frozen=True, kw_only=True)
class SegregationConfig(SpeciesConfig):
    """As elsewhere, but species start in one disk."""

    seed_distance: float = 0.0


class SegregationTask(MixingTask):
    """Every particle is to see its own species alone: its loss is the local entropy."""

    config_type = SegregationConfig

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the entropy of species around each particle."""
        return {"mixture": self._entropy(population)}


def local_entropy(population: Population, *, eps: float, box: float | None) -> Tensor:
    """Return the entropy of species around each particle, in [0, 1], shape [B, N].

    The share of species k around particle i is f_k = b_k / Σ b, where b are the SPH-smoothed tags
    (1 for a particle of species k, else 0). The entropy is −Σ f_k ln f_k / ln K: 0 where a particle
    sees its own species alone, 1 where all K are there in equal parts.
    """
    species_count = len(population.counts)
    kinds = torch.arange(species_count, device=population.x.device)
    tags = (population.species[:, None] == kinds).to(population.x)
    seen = perceive(
        population.x,
        tags.expand(len(population.x), -1, -1).contiguous(),
        eps,
        box=box,
        detach_positions=False,
        state_gradient=False,
        moment_correction=False,
        density_gradient=False,
    )
    blur = seen[..., species_count:]
    shares = blur / blur.sum(dim=2, keepdim=True)
    # At a share of exactly 0 the entropy has no finite derivative, and NaN would come of it.
    there = shares > 0.0
    terms = torch.where(there, torch.special.entr(torch.where(there, shares, 1.0)), 0.0)
    entropy: Tensor = terms.sum(dim=2)
    return entropy / math.log(species_count)
