"""Particles of several species: each is told which one it is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Space
from gymnasium.utils import RecordConstructorArgs
from torch import Tensor

from npa_envs.envs.core.spaces import to_output
from npa_envs.errors import NPAError, suggest
from npa_envs.tasks.checks import is_real, is_whole
from npa_envs.world.randomness import Purpose, WorldRandom
from npa_envs.wrappers.base import (
    AnyVectorEnv,
    AnyWrapper,
    VectorObservations,
    single_env,
    vector_env,
    world_indices,
)

ASSIGNMENTS = ("blocks", "random")
"""How particles come by their species."""


class SpeciesPlan:
    """How many particles each species has, and which.

    Args:
        particle_count: Particles N.
        species_count: Species K.
        fractions: Share of each species, of any sum; None: equal shares.
        assignment: "blocks" or "random".

    Raises:
        NPAError: An argument is wrong, or a species would have no particle.
    """

    def __init__(
        self,
        particle_count: int,
        species_count: int,
        fractions: Sequence[float] | None,
        assignment: str,
    ) -> None:
        if not is_whole(species_count) or species_count < 1:
            raise NPAError(
                f"species_count must be a whole number of at least 1, got {species_count!r}"
            )
        if not isinstance(assignment, str) or assignment not in ASSIGNMENTS:
            hint = suggest(str(assignment), ASSIGNMENTS)
            raise NPAError(f"assignment must be a known word, got {assignment!r}: {hint}")
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
        self.species_count = species_count
        self.random = assignment == "random"
        self.blocks = torch.arange(species_count).repeat_interleave(torch.from_numpy(sizes))
        """Species of particles 0 to N - 1 where they stand in blocks, int64, shape [N]."""

    def draw(self, random: WorldRandom, worlds: Tensor) -> Tensor:
        """Return the species of all particles of some worlds, int64, shape [M, N].

        Args:
            random: The worlds' own streams, at the start of their episodes; left as they are.
            worlds: Which worlds, int64, shape [M].
        """
        blocks = self.blocks.to(worlds.device)
        if not self.random:
            return blocks.expand(len(worlds), -1)
        keys = random.take(worlds).beside(Purpose.SPECIES).uniform(len(blocks))
        return blocks[keys.argsort(dim=1, stable=True)]

    def space(self, space: Space[Any], wrapper: str) -> Box:
        """Return the space of observations with tags.

        Args:
            space: The space of the observations as they are, shape [N, P].
            wrapper: Name of the wrapper that appends them, for the error.

        Raises:
            NPAError: It has no row for each particle.
        """
        count = len(self.blocks)
        if not isinstance(space, Box) or len(space.shape) != 2 or space.shape[0] != count:
            raise NPAError(
                f"observations must be a row for each of {count} particles, got {space}: "
                f"put {wrapper} under the wrappers that reshape observations"
            )
        shape = (count, self.species_count)
        low = np.concatenate((space.low, np.zeros(shape, np.float32)), axis=1)
        high = np.concatenate((space.high, np.ones(shape, np.float32)), axis=1)
        return Box(low, high, dtype=np.float32)


def tags(species: Tensor, species_count: int) -> Tensor:
    """Return species as float32 one-hot vectors, shape [..., K]."""
    return torch.nn.functional.one_hot(species, species_count).to(torch.float32)


def tagged(observation: Any, tag: Any) -> Any:
    """Return observations with tags behind them, arrays or tensors."""
    if isinstance(observation, Tensor):
        return torch.cat((observation, tag), dim=-1)
    return np.concatenate((observation, tag), axis=-1)


class SpeciesTags(AnyWrapper, RecordConstructorArgs):
    """Give each particle a species for the episode, and append it to its observation as one-hot.

    Args:
        env: An environment of this package.
        species_count: Species K.
        fractions: Share of each species, of any sum; None: equal shares.
        assignment: "blocks": the first particles are species 0, the next species 1, and so on, in
            every episode; "random": drawn anew for each episode from the world's own seed, in the
            same numbers.

    Raises:
        NPAError: An argument is wrong, or a species would have no particle.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        species_count: int = 2,
        *,
        fractions: Sequence[float] | None = None,
        assignment: str = "blocks",
    ) -> None:
        RecordConstructorArgs.__init__(
            self, species_count=species_count, fractions=fractions, assignment=assignment
        )
        self._base = base = single_env(env, type(self).__name__)
        super().__init__(env)
        self._plan = SpeciesPlan(base.config.particle_count, species_count, fractions, assignment)
        self.observation_space = self._plan.space(env.observation_space, type(self).__name__)
        self._world = torch.zeros(1, dtype=torch.int64, device=base.task.device)
        self._assign()

    @property
    def species(self) -> Any:
        """Species of each particle from 0 on, int64, shape [N]."""
        return to_output(self._species, self._base.config.output)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; as for the environment itself."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._assign()
        return tagged(observation, self._tags), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; as for the environment itself."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return tagged(observation, self._tags), reward, terminated, truncated, info

    def _assign(self) -> None:
        self._species = self._plan.draw(self._base.worlds.random, self._world)[0].clone()
        tag = tags(self._species, self._plan.species_count)
        self._tags = to_output(tag, self._base.config.output)


class VectorSpeciesTags(VectorObservations, RecordConstructorArgs):
    """`SpeciesTags` for vector environments.

    World k has the species of the single environment with the same seed.

    Args:
        env: A vector environment of this package.
        species_count: Species K.
        fractions: Share of each species, of any sum; None: equal shares.
        assignment: "blocks" or "random", as for `SpeciesTags`.

    Raises:
        NPAError: An argument is wrong, or a species would have no particle.
    """

    def __init__(
        self,
        env: AnyVectorEnv,
        species_count: int = 2,
        *,
        fractions: Sequence[float] | None = None,
        assignment: str = "blocks",
    ) -> None:
        RecordConstructorArgs.__init__(
            self, species_count=species_count, fractions=fractions, assignment=assignment
        )
        self._base = base = vector_env(env, type(self).__name__)
        super().__init__(env)
        self._plan = SpeciesPlan(base.config.particle_count, species_count, fractions, assignment)
        self.single_observation_space = self._plan.space(
            env.single_observation_space, type(self).__name__
        )
        everyone = torch.arange(env.num_envs, device=base.task.device)
        self._put(self._plan.draw(base.worlds.random, everyone).clone())

    @property
    def species(self) -> Any:
        """Species of each particle from 0 on, int64, shape [B, N]."""
        return to_output(self._species, self._base.config.output)

    def observations(self, observations: Any) -> Any:
        """Return observations with tags; worlds in a new episode get new ones."""
        restarted = self.clock.restarted
        self._last_tags = self._tags
        if self._plan.random and restarted.any():
            chosen = world_indices(restarted, self._base.task.device)
            drawn = self._plan.draw(self._base.worlds.random, chosen)
            self._put(self._species.index_copy(0, chosen, drawn))
        return tagged(observations, self._tags)

    def final_observations(self, observations: Any) -> Any:
        """Return observations with the tags that particles had in the step before."""
        return tagged(observations, self._last_tags)

    def _put(self, species: Tensor) -> None:
        self._species = species
        tag = tags(species, self._plan.species_count)
        self._tags = to_output(tag, self._base.config.output)
