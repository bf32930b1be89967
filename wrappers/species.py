"""Species tags: each particle observes which species it is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from torch import Tensor

from npa_envs.checks import is_real, is_whole
from npa_envs.envs.core.base import to_output
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.world.randomness import StreamId
from npa_envs.wrappers.base import (
    Observations,
    VectorObservations,
    WrapperBase,
    world_indices,
)

ASSIGNMENTS = ("blocks", "random")
"""Ways to assign species to particles."""


def tagged(observation: Any, tags: Any) -> Any:
    """Return observations with tags as their last columns, arrays or tensors."""
    if isinstance(observation, Tensor):
        return torch.cat((observation, tags), dim=-1)
    return np.concatenate((observation, tags), axis=-1)


class _TagsSpecies(WrapperBase):
    """Mixin with the species of all particles and their tags, for one world or many."""

    def __init__(
        self,
        env: Any,
        species_count: int = 2,
        *,
        fractions: Sequence[float] | None = None,
        assignment: str = "blocks",
    ) -> None:
        super().__init__(
            env, species_count=species_count, fractions=fractions, assignment=assignment
        )
        particle_count, self._worlds = self._base.config.particle_count, self._base.worlds
        if not is_whole(species_count) or species_count < 1:
            raise NPAError(
                f"species_count must be a whole number of at least 1, got {shown(species_count)}"
            )
        if not isinstance(assignment, str) or assignment not in ASSIGNMENTS:
            hint = suggest(assignment, ASSIGNMENTS)
            raise NPAError(f"assignment must be a known word, got {shown(assignment)}: {hint}")
        if species_count > particle_count:
            raise NPAError(
                f"species_count must be at most the {particle_count} particles, got {species_count}"
            )
        shares: list[Any] = [1.0] * species_count
        if fractions is not None:
            listed = isinstance(fractions, Iterable) and getattr(fractions, "ndim", 1) != 0
            shares = list(fractions) if listed else []
        if len(shares) != species_count or not all(is_real(f) and f > 0 for f in shares):
            raise NPAError(
                f"fractions must be {species_count} numbers greater than 0, one for each species, "
                f"got {fractions}: for example {[1.0] * species_count}"
            )
        bounds = np.round(np.cumsum(shares) / np.sum(shares) * particle_count).astype(np.int64)
        sizes = np.diff(bounds, prepend=0)
        if sizes.min() < 1:
            raise NPAError(
                f"fractions must leave each species a particle, got {sizes.tolist()} of "
                f"{particle_count}: give more particles or larger fractions"
            )
        self._species_count, self._random = species_count, assignment == "random"
        blocks = torch.arange(species_count).repeat_interleave(torch.from_numpy(sizes))
        # Species of particles 0 to N - 1 with assignment="blocks".
        self._blocks = blocks.to(self._base.task.device)
        setattr(self, self.space_name, self._tagged_space(getattr(env, self.space_name)))
        everyone = torch.arange(self._worlds.world_count, device=self._base.task.device)
        self._assign(self._drawn(everyone).clone())

    def _drawn(self, worlds: Tensor) -> Tensor:
        """Return the species of all particles of some worlds, int64, shape [M, N]."""
        if not self._random:
            return self._blocks.expand(len(worlds), -1)
        streams = self._worlds.random.take(worlds).substream(StreamId.SPECIES)
        return self._blocks[streams.uniform(len(self._blocks)).argsort(dim=1, stable=True)]

    def _tagged_space(self, space: Space[Any]) -> Box:
        count = len(self._blocks)
        if not isinstance(space, Box) or len(space.shape) != 2 or space.shape[0] != count:
            raise NPAError(
                f"observations must be a row for each of {count} particles, got {space}: "
                f"put {type(self).__name__} under the wrappers that reshape observations"
            )
        shape = (count, self._species_count)
        low = np.concatenate((space.low, np.zeros(shape, np.float32)), axis=1)
        high = np.concatenate((space.high, np.ones(shape, np.float32)), axis=1)
        return Box(low, high, dtype=np.float32)

    @property
    def species(self) -> Any:
        """Species of each particle from 0 on, int64, shape [N], or [B, N] of several worlds."""
        return to_output(self._species if self.many else self._species[0], self._output)

    @property
    def _output(self) -> str:
        return str(self._base.config.output)

    def _assign(self, species: Tensor) -> None:
        self._species = species
        tags = torch.nn.functional.one_hot(species, self._species_count).to(torch.float32)
        self._tags = to_output(tags if self.many else tags[0], self._output)

    def observations(self, observations: Any) -> Any:
        """Return observations with tags, which restarted worlds draw again if they are random."""
        restarted = self.restarted_worlds
        self._last_tags = self._tags
        if self._random and restarted.any():
            chosen = world_indices(restarted, self._base.task.device)
            self._assign(self._species.index_copy(0, chosen, self._drawn(chosen)))
        return tagged(observations, self._tags)

    def final_observations(self, observations: Any) -> Any:
        """Return observations with the tags of the previous step."""
        return tagged(observations, self._last_tags)


class SpeciesTags(_TagsSpecies, Observations):
    """Give each particle a species for the episode, and append it to its observation as one-hot.

    Args:
        env: An environment of this package.
        species_count: Species K.
        fractions: Relative size of each species, with any sum; None: equal sizes.
        assignment: "blocks": the first particles are species 0, the next species 1, and so on, in
            every episode; "random": drawn for each episode from the world's own seed, with the
            same sizes.

    Raises:
        NPAError: An argument is wrong, or a species would have no particle.
    """


class VectorSpeciesTags(_TagsSpecies, VectorObservations):
    """`SpeciesTags` for vector environments.

    World k has the species of the single environment with the same seed. Arguments and errors are
    those of `SpeciesTags`, but for `env`, a vector environment of this package.
    """
