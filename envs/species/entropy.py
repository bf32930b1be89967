"""How well species are mixed around every particle."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from npa_envs import perceive
from npa_envs.envs.species.task import Population


def local_entropy(population: Population, *, eps: float, box: float | None) -> Tensor:
    """Return the entropy of species around each particle, in [0, 1], shape [B, N].

    The share of species k around particle i is f_k = b_k / Σ b, where b are the SPH-smoothed tags
    (1 for a particle of species k, else 0). The entropy is −Σ f_k ln f_k / ln K: 0 where a particle
    sees its own species alone, 1 where all K are there in equal parts.

    Args:
        population: The particles; K is the number of species that there were at the start.
        eps: Perception radius [length units].
        box: Side of the periodic box [length units], or None in open space.
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
    # Beside a share of exactly 0 the entropy has no finite derivative, and NaN would come of it.
    there = shares > 0.0
    terms = torch.where(there, torch.special.entr(torch.where(there, shares, 1.0)), 0.0)
    entropy: Tensor = terms.sum(dim=2)
    return entropy / math.log(species_count)
