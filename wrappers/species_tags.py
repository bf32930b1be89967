"""Species tags: each particle observes which species it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from torch import Tensor

from npa_envs.checks import check_count
from npa_envs.envs.core.base import to_output
from npa_envs.errors import NPAError
from npa_envs.wrappers.base import Observations, VectorObservations, WrapperBase


class _TagsSpecies(WrapperBase):
    """Mixin that appends one-hot species to particles' observations, for one world or many."""

    def __init__(self, env: Any, species_count: int = 2) -> None:
        super().__init__(env, species_count=species_count)
        particle_count = self._base.config.particle_count
        check_count("species_count", species_count, at_most=particle_count)
        bounds = np.round(np.arange(1, species_count + 1) / species_count * particle_count)
        counts = np.diff(bounds.astype(np.int64), prepend=0)
        species = torch.arange(species_count).repeat_interleave(torch.from_numpy(counts))
        species = species.to(self._base.task.device)
        tags = torch.nn.functional.one_hot(species, species_count).to(torch.float32)
        if self.many:
            species, tags = (
                values.expand(self._base.num_envs, *values.shape).clone()
                for values in (species, tags)
            )
        output = self._base.config.output
        self._tags = to_output(tags, output)
        self.species = to_output(species, output)
        """Species of each particle from 0 on, int64, shape [N], or [B, N] of several worlds."""
        space: Space[Any] = getattr(env, self.space_name)
        if not isinstance(space, Box) or len(space.shape) != 2 or space.shape[0] != particle_count:
            raise NPAError(
                f"observations must be a row for each of {particle_count} particles, got {space}: "
                f"put {type(self).__name__} under the wrappers that reshape observations"
            )
        shape = (particle_count, species_count)
        low = np.concatenate((space.low, np.zeros(shape, np.float32)), axis=1)
        high = np.concatenate((space.high, np.ones(shape, np.float32)), axis=1)
        setattr(self, self.space_name, Box(low, high, dtype=np.float32))

    def changed(self, observations: Any) -> Any:
        """Return observations [..., N, P], whose last columns are the one-hot species."""
        if isinstance(observations, Tensor):
            return torch.cat((observations, self._tags), dim=-1)
        return np.concatenate((observations, self._tags), axis=-1)


class SpeciesTags(_TagsSpecies, Observations):
    """Give each particle a species, and append it to its observation as one-hot.

    The first particles are species 0, the next species 1, and so on, in groups of equal sizes.

    Args:
        env: An environment of this package.
        species_count: Number of species.
    """


class VectorSpeciesTags(_TagsSpecies, VectorObservations):
    """`SpeciesTags` for vector environments.

    Arguments and errors are those of `SpeciesTags`, except `env`, a vector environment of this
    package.
    """
