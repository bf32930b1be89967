"""What an environment of several species asks of its task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import accumulate
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from npa_envs.envs.multi.config import SpeciesConfig
from npa_envs.errors import NPAError
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.randomness import WorldRandom


class Population(NamedTuple):
    """The particles of worlds that have the same ones, those of each species one after the other.

    Here N counts the particles that are there.
    """

    x: Tensor
    """Positions [length units], shape [B, N, 2]."""

    s: Tensor
    """States, dimensionless, shape [B, N, C]."""

    counts: tuple[int, ...]
    """Particles of each species in each world; 0 where it is gone. Known to the host."""

    species: Tensor
    """Species of each particle, int64, shape [N]."""

    @property
    def spans(self) -> list[slice]:
        """Where each species' particles stand."""
        ends = list(accumulate(self.counts))
        return [slice(end - count, end) for end, count in zip(ends, self.counts, strict=True)]

    def of(self, species: int) -> tuple[Tensor, Tensor]:
        """Return positions and states of one species, shapes [B, N_k, 2] and [B, N_k, C]."""
        span = self.spans[species]
        return self.x[:, span].contiguous(), self.s[:, span].contiguous()


class SpeciesTask:
    """One task of several species; a loss for each, and one for each particle.

    An agent's reward is how much its loss falls in a step, so losses go down where it does well.

    Args:
        config: The environment's configuration.
        device: Where the world lives.

    Raises:
        NPAError: There are too few species.
    """

    config_type: ClassVar[type[SpeciesConfig]] = SpeciesConfig
    """The configuration's class: its fields are the environment's keywords."""

    least_species: ClassVar[int] = 2
    """The task makes no sense with fewer."""

    def __init__(self, config: Any, device: torch.device) -> None:
        if config.species_count < self.least_species:
            raise NPAError(
                f"species_count must be at least {self.least_species} in this task, got "
                f"{config.species_count}: with one species there is nobody to meet"
            )
        self.config = config
        self.device = device
        middle = 0.5 * (config.species_count - 1)
        places = [config.seed_distance * (k - middle) for k in range(config.species_count)]
        # Sent once: worlds that restart would wait for it.
        self._shift = torch.tensor(places).repeat_interleave(torch.tensor(config.counts)).to(device)

    def start(self, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return fresh worlds: each species uniform in a disk of its own, all states zero.

        Args:
            random: Where positions come from, one stream a world.

        Returns:
            Positions [length units], shape [B, N, 2]; states, dimensionless, shape [B, N, C].
        """
        config = self.config
        shape = random.world_count, sum(config.counts)
        x = uniform_ball(*shape, 2, config.seed_radius, generator=random, device=self.device)
        x[..., 0] += self._shift
        return x, x.new_zeros(*shape, config.state_dim)

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the named parts of each species' loss, shape [B, K] each; their sum is its loss.

        World k's are the same, bit for bit, in every batch, and nothing may wait for the device.

        Args:
            population: At least one particle; the loss of a species that is gone is never read.
        """
        raise NotImplementedError

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the named parts of each particle's loss, shape [B, N] each; their sum is its loss.

        Args:
            population: At least one particle.
        """
        raise NotImplementedError

    def settle(self, rewards: Tensor, live: Tensor, species: Tensor) -> Tensor:
        """Return what agents are paid; by default what each has earned.

        Args:
            rewards: How much each agent's loss fell in the step, 0 for agents that did not act,
                float64, shape [B, agents].
            live: Whether each agent acted, bool, shape [B, agents].
            species: Species of each agent, int64, shape [agents].
        """
        return rewards

    def is_over(self, counts: tuple[int, ...]) -> bool:
        """Return whether the episode ends for all, where species are gone; by default it goes on.

        Args:
            counts: Particles of each species.
        """
        return False

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: their distance where all fill the unit disk."""
        return math.sqrt(math.pi / sum(self.config.counts))

    @property
    def half_width(self) -> float:
        """From the middle of a picture to its edge [length units]."""
        if self.config.boundary == "periodic":
            return max(1.0, 0.5 * float(self.config.box_size))
        return max(1.0, self.open_half_width)

    @property
    def open_half_width(self) -> float:
        """The same in open space, where it is 1 at least [length units]."""
        return 1.25 * float(self.config.seed_span)


def by_species(losses: list[Tensor], population: Population) -> Tensor:
    """Return losses of the species that are there as one tensor, shape [B, K], 0 for the others.

    Args:
        losses: One for each species with particles, shape [B] each, in order.
        population: Who is there.
    """
    remaining = iter(losses)
    nothing = population.x.new_zeros(len(population.x))
    found = [next(remaining) if count else nothing for count in population.counts]
    return torch.stack(found, dim=1)
