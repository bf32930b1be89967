"""Base classes of tasks of several species: configuration, population, losses, pictures."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, ClassVar, Literal, NamedTuple, Self, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import check_field, check_non_negative, check_positive, is_whole
from npa_envs.envs.core.config import Interface, WorldConfig, as_python
from npa_envs.envs.core.task import WorldTask
from npa_envs.errors import NPAError
from npa_envs.render import STYLES
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.environment_steps import NeighbourState, Physics
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom

SpeciesReward = Literal["individual", "team"]
Perception = Literal["shared", "per_species"]
SpeciesOnDivergence = Literal["terminate", "raise", "ignore"]

SPECIES_STYLE = "species"
"""Style of pictures that draws each species in its own colour."""

MAX_SPECIES = 64
"""Maximum number of species."""


@dataclass(frozen=True, kw_only=True)
class SpeciesConfig(WorldConfig):
    """Configuration fields of all tasks of several species; each task adds its own."""

    choices = WorldConfig.choices | {
        "perception": get_args(Perception),
        "reward": get_args(SpeciesReward),
        "on_divergence": get_args(SpeciesOnDivergence),
        "render_style": (SPECIES_STYLE, *STYLES),
    }

    elsewhere = WorldConfig.elsewhere | {
        "num_envs": "many worlds at once are made by multispecies_v0.batched(..., world_count=8)"
    }

    species_count: int = 2
    """Species S."""

    particle_count: int = 1024
    """Particles of all species together, N, divided evenly."""

    particle_counts: tuple[int, ...] = ()
    """Particles of each species; empty: `particle_count`, divided evenly."""

    perception: Perception = "shared"
    """"shared": particles perceive each other whatever their species; "per_species": they also
    perceive the density and the density gradient of each species."""

    on_divergence: SpeciesOnDivergence = "terminate"
    """What happens to an agent once all of its particles have diverged: "terminate" removes it from
    the world; "raise" raises an error that names it; "ignore" continues with values clipped to the
    limits."""

    seed_radius: float = 0.2
    """Radius of the disk that each species starts in [length units]."""

    seed_distance: float = 0.4
    """Distance between the centres of neighbouring disks, which lie in a row [length units]."""

    deaths: tuple[tuple[int | str, int], ...] = ()
    """Pairs (species, step): the species, 1 or "species_1", is removed at the end of that step."""

    reward: SpeciesReward = "individual"
    """"individual": each agent is rewarded for its own improvement; "team": each gets the mean."""

    max_cycles: int = 256
    """Steps after which the episode is truncated for all agents."""

    render_style: str = SPECIES_STYLE
    """What pictures show: "species" (a colour each), "particles" (their own colours), "density" or
    "states" (hidden channels)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, int, "max_cycles")
        check_positive(self, int, "species_count", at_most=MAX_SPECIES)
        self._check_counts()
        check_positive(self, float, "seed_radius")
        check_non_negative(self, "seed_distance")
        self._check_deaths()
        half = self.position_limit if self.box is None else 0.5 * self.box
        if self.seed_span >= half:
            raise NPAError(
                f"seed_radius and seed_distance must keep all disks within {half:g}, got disks up "
                f"to {self.seed_span:g}: worlds would begin out of bounds"
            )

    def interface(self, physics: Physics) -> Interface:
        """Return what each column of observations and of actions means, also by species."""
        count = self.species_count if self.perception == "per_species" else 0
        return super().interface(physics)._replace(species_count=count)

    @property
    def counts(self) -> tuple[int, ...]:
        """Particles of each species at the start of an episode."""
        if self.particle_counts:
            return self.particle_counts
        even, remainder = divmod(self.particle_count, self.species_count)
        return tuple(even + int(k < remainder) for k in range(self.species_count))

    @property
    def death_steps(self) -> dict[Any, int]:
        """Steps of `deaths` by the species' index."""
        indices: dict[Any, int] = {f"species_{k}": k for k in range(self.species_count)}
        return {indices.get(k, k): step for k, step in self.deaths}

    @property
    def agent_particle_counts(self) -> tuple[int, ...]:
        """Particles of each species that agents control; the environment acts for the others."""
        return self.counts

    @property
    def seed_span(self) -> float:
        """Maximum distance from the origin at which particles start [length units]."""
        return self.seed_radius + 0.5 * (self.species_count - 1) * self.seed_distance

    @classmethod
    def from_keywords(cls, keywords: dict[str, Any]) -> Self:
        """Return a configuration with `keywords` as fields; only one gives particle counts."""
        if "particle_count" in keywords and as_python(keywords.get("particle_counts")):
            raise NPAError(
                "particle_count and particle_counts exclude each other: "
                "particle_counts gives the number of each species"
            )
        return super().from_keywords(keywords)

    def _check_counts(self) -> None:
        counts, species_count = self.particle_counts, self.species_count
        whole = isinstance(counts, tuple) and all(is_whole(count) for count in counts)
        fits = not counts or (whole and len(counts) == species_count and min(counts) >= 1)
        rule = f"be {species_count} whole numbers of at least 1, one for each species"
        hint = f"for example particle_counts={(64,) * species_count}"
        check_field(self, "particle_counts", fits, rule, hint)
        enough = bool(counts) or self.particle_count >= species_count
        rule = f"be at least species_count = {species_count}"
        check_field(self, "particle_count", enough, rule, "each species needs a particle")

    def _check_deaths(self) -> None:
        deaths, last = self.deaths, self.species_count - 1
        pairs = isinstance(deaths, tuple) and all(
            isinstance(pair, tuple)
            and len(pair) == 2
            and (is_whole(pair[0]) or isinstance(pair[0], str))
            and is_whole(pair[1])
            for pair in deaths
        )
        steps = self.death_steps if pairs else {}
        fits = pairs and len(steps) == len(deaths)
        fits = fits and all(k in range(last + 1) and step > 0 for k, step in steps.items())
        rule = (
            f"be pairs (species, step), each species from 0 to {last} at most once, each step at "
            "least 1"
        )
        check_field(self, "deaths", fits, rule, "for example deaths=((1, 50),)")


class Population(NamedTuple):
    """Particles of B worlds, sorted by species; if some were removed, the same in each world."""

    x: Tensor
    """Positions [length units], shape [B, N, 2]."""
    s: Tensor
    """States, dimensionless, shape [B, N, C]."""
    counts: tuple[int, ...]
    """Remaining particles of each species in a world."""
    species: Tensor
    """Species of each particle, int64, shape [N]."""
    neighbours: NeighbourState | None = None
    """The particles sorted by place, if they are already; only on a CPU, and without gradients."""

    @property
    def spans(self) -> list[slice]:
        """Slice of each species' particles in x and s."""
        ends = list(accumulate(self.counts))
        return [slice(end - count, end) for end, count in zip(ends, self.counts, strict=True)]

    def of(self, species: int) -> tuple[Tensor, Tensor]:
        """Return positions and states of one species, shapes [B, N_k, 2] and [B, N_k, C]."""
        span = self.spans[species]
        return self.x[:, span].contiguous(), self.s[:, span].contiguous()


class SpeciesTask(WorldTask[Any]):
    """Base class of tasks of several species; an agent's reward is its loss's decrease."""

    config_type: ClassVar[type[SpeciesConfig]] = SpeciesConfig
    controls = "species"

    least_species: ClassVar[int] = 2
    """Minimum number of species."""

    def __init__(self, config: Any, device: torch.device) -> None:
        if config.species_count < self.least_species:
            raise NPAError(
                f"species_count must be at least {self.least_species} in this task, got "
                f"{config.species_count}: one species has no task here"
            )
        super().__init__(config, device)
        middle = 0.5 * (config.species_count - 1)
        centres = [config.seed_distance * (k - middle) for k in range(config.species_count)]
        counts = torch.tensor(config.counts)
        # Copied to the device once, as a copy in each restart would synchronise.
        self._shift = torch.tensor(centres).repeat_interleave(counts).to(device)

    def start(self, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return positions and states of new worlds: a disk of particles for each species."""
        config = self.config
        shape = random.world_count, sum(config.counts)
        x = uniform_ball(*shape, 2, config.seed_radius, generator=random, device=self.device)
        x[..., 0] += self._shift
        return x, x.new_zeros(*shape, config.state_dim)

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the terms of each species' loss by name, [B, S] each; their sum is its loss.

        The losses of a world must not depend on the others, and nothing may synchronise. Losses of
        removed species are not read.
        """
        raise NotImplementedError

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the terms of each particle's loss by name, [B, N] each; their sum is its loss."""
        raise NotImplementedError

    def with_opponent(self, action: Tensor, population: Population, random: WorldRandom) -> Tensor:
        """Return `action`, [B, N, A], with the rows of an opponent's particles; by default none."""
        return action

    def final_rewards(self, rewards: Tensor, live: Tensor, species: Tensor) -> Tensor:
        """Return rewards, [B, M], which a task may change for `live` agents, [B, M]."""
        return rewards

    def is_over(self, counts: tuple[int, ...]) -> bool:
        """Return whether the episode ends for all; `counts`: live agents of each species."""
        return False

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: the spacing of all particles in the unit disk."""
        return math.sqrt(math.pi / sum(self.config.counts))

    @property
    def open_half_width(self) -> float:
        """Half of a picture's side in open space [length units], raised to 1 if it is less."""
        return 1.25 * float(self.config.seed_span)

    def draw(self, population: Population) -> NDArray[np.uint8]:
        """Return a picture of each world, uint8, [B, R, R, 3]; white without particles."""
        config, x, s = self.config, population.x, population.s
        if x.shape[1] == 0:
            return np.full((len(x), config.render_size, config.render_size, 3), 255, np.uint8)
        if config.render_style != SPECIES_STYLE:
            return self.draw_particles(Particles(x, s), config.render_style)
        # Hues of the species are evenly spaced.
        hues = [k / config.species_count for k in range(config.species_count)]
        colours = torch.tensor([colorsys.hsv_to_rgb(hue, 0.85, 0.8) for hue in hues]).to(s)
        colours = (colours[population.species] - COLOUR_OFFSET).expand(len(x), -1, -1)
        return self.draw_particles(Particles(x, colours), "particles")
