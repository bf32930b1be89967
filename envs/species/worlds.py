"""The worlds that several species share: how they start, act, perceive, and lose particles.

Neither Gymnasium nor PettingZoo is known here. A single environment is a batch of one; world k of a
batch is, bit for bit, that world alone.
"""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.arrays import checked_particles
from npa_envs.envs.memory import OBSERVATION_COPIES, check_memory
from npa_envs.envs.species.cohort import Cohort, Judge
from npa_envs.envs.species.task import Population, SpeciesTask
from npa_envs.envs.task import EnvTask
from npa_envs.envs.worlds import make_physics
from npa_envs.world.cuda_graph import sent
from npa_envs.world.randomness import WorldRandom


class SpeciesWorlds:
    """B worlds; particles of each species lie one after the other, and those removed are gone.

    A world that lost particles is computed without them. Worlds that have the same ones are
    computed together, as a cohort: all of the batch as long as nobody is gone.

    Args:
        task_type: Gives starts and losses.
        config: The environment's configuration, of the task's kind.
        world_count: Worlds B.
        by_particle: Whether every particle is an agent, and not every species.

    Raises:
        NPAError: The worlds do not fit into memory, or the task cannot be made.
    """

    def __init__(
        self, task_type: type[SpeciesTask], config: Any, world_count: int, *, by_particle: bool
    ) -> None:
        self.config = config
        self.device = config.world.torch_device
        self.world_count = world_count
        self.particle_count = count = sum(config.counts)
        """Particles of all species at the start of an episode, N."""
        self.physics = make_physics(config.world, EnvTask)
        """The worlds' constants."""
        told_apart = 4 * OBSERVATION_COPIES * world_count * count * self._appended
        check_memory(world_count, count, self.physics, self.device, told_apart)
        self.task = task_type(config, self.device)
        self.species = np.repeat(np.arange(config.species_count), config.counts)
        """Species of each particle that an episode starts with, int64, shape [N]."""
        self.owner = np.arange(count) if by_particle else self.species
        """Number of the agent that owns each of them, never falling, int64, shape [N]."""
        self._judge = Judge(self.task, self.physics, self.owner, by_particle)
        self.there = np.zeros((world_count, self._judge.agent_count), dtype=bool)
        """Whether each agent's particles are in its world, shape [B, A]."""
        self.open = np.zeros(world_count, dtype=bool)
        """Whether each world goes on; the others stay as they are, shape [B]."""
        self.elapsed = np.zeros(world_count, dtype=np.int64)
        """Steps since the start of each episode, shape [B]."""
        self._x = torch.zeros(world_count, count, 2, device=self.device)
        self._s = torch.zeros(world_count, count, config.state_dim, device=self.device)
        keys = torch.zeros(world_count, dtype=torch.int64, device=self.device)
        self._random = WorldRandom.from_keys(keys)
        everyone, all_worlds = np.arange(count), np.arange(world_count)
        # Its work is recorded on CUDA, and worlds come back to it when their next episodes start.
        self._whole = Cohort(self._judge, all_worlds, everyone, self._x, self._s, self._random)
        self._cohorts: list[Cohort] | None = None

    @property
    def perception_dim(self) -> int:
        """Numbers that a particle perceives: P, and K (1 + D) more where species are told apart."""
        return self.physics.perception_dim + self._appended

    @property
    def _appended(self) -> int:
        """Numbers that a particle perceives of species one by one."""
        if self.config.perception == "shared":
            return 0
        return int(self.config.species_count * (1 + self.physics.space_dim))

    @property
    def agent_count(self) -> int:
        """Agents of a world, A."""
        return self._judge.agent_count

    @torch.no_grad()
    def start(self, worlds: NDArray[np.int64], keys: Tensor | None = None) -> Population:
        """Start episodes in some worlds, and return their particles.

        Args:
            worlds: Which, shape [M].
            keys: Keys of new streams of randomness, int64, shape [M], which begin with their first
                episode; None: each world goes on to its next one.
        """
        self._disband()
        index = sent(worlds, self.device)
        if keys is not None:
            random = WorldRandom.from_keys(keys.to(self.device))
        else:
            random = self._random.take(index)
            random.restart()
        x, s = self.task.start(random)
        self._random.put(index, random)
        self._x.index_copy_(0, index, x)
        self._s.index_copy_(0, index, s)
        self.there[worlds] = self.open[worlds] = True
        self.elapsed[worlds] = 0
        return self._whole.population._replace(x=x.contiguous(), s=s)

    @torch.no_grad()
    def act(self, action: Tensor) -> None:
        """Apply actions to the worlds that go on; nothing waits for the device.

        Args:
            action: Finite, on the device, shape [B, N, A]; what it says of particles that are gone
                is not read.
        """
        for cohort in self.cohorts:
            cohort.act(action if cohort is self._whole else action[_places(cohort)])
        self.elapsed[self.open] += 1

    @torch.no_grad()
    def perceived(self, *, stepped: bool = False) -> Tensor:
        """Return what particles perceive, shape [B, N, P]; zeros where they or their world ended.

        Args:
            stepped: Nothing has changed since the last `act`.
        """
        if self.cohorts == [self._whole]:
            return self._whole.perceived(stepped=stepped)
        shape = self.world_count, self.particle_count, self.perception_dim
        seen = self._x.new_zeros(shape)
        for cohort in self.cohorts:
            seen[_places(cohort)] = cohort.perceived(stepped=stepped)
        return seen

    @torch.no_grad()
    def measured(self, *, stepped: bool = False) -> dict[str, Tensor]:
        """Return the parts of every agent's loss, float32, shape [B, A]; 0 of those that ended.

        Args:
            stepped: Nothing has changed since the last `act`.
        """
        found: dict[str, Tensor] = {}
        for cohort in self.cohorts:
            for name, part in (cohort.parts if stepped else cohort.measured()).items():
                if name not in found:
                    found[name] = part.new_zeros(self.world_count, self.agent_count)
                found[name].index_copy_(0, cohort.worlds, part)
        return found

    @torch.no_grad()
    def opened(self, population: Population) -> tuple[dict[str, Tensor], Tensor]:
        """Return losses, shape [M, A], and perception, shape [M, N, P], of worlds just started.

        Args:
            population: What `start` returned.
        """
        judge = self._judge
        return judge.measured(population, self._whole.columns), judge.perceived(population)

    @torch.no_grad()
    def left(self) -> Tensor:
        """Return which agents have no particle within bounds after a step, bool, shape [B, A]."""
        gone = torch.zeros(self.world_count, self.agent_count, dtype=torch.bool, device=self.device)
        for cohort in self.cohorts:
            gone.index_copy_(0, cohort.worlds, cohort.gone)
        return gone

    def remove(self, agents: NDArray[np.bool_]) -> None:
        """Take agents' particles out of their worlds.

        Args:
            agents: Whose, shape [B, A].
        """
        self._disband()
        self.there &= ~agents

    def close(self, worlds: NDArray[np.bool_]) -> None:
        """Let some worlds stay as they are until they start again.

        Args:
            worlds: Which, shape [B].
        """
        self._disband()
        self.open &= ~worlds

    def place(self, x: Any, s: Any) -> None:
        """Replace the particles that are in the worlds, which all have the same ones.

        Args:
            x: Positions [length units], shape [B, N now, 2].
            s: States, dimensionless, shape [B, N now, C].

        Raises:
            NPAError: A shape is another one, or a number is not finite or beyond its limit.
        """
        (cohort,) = self.cohorts
        there = cohort.population
        count = there.x.shape[1]
        placed = checked_particles(x, s, self.world_count, count, self.physics, self.device)
        there.x.copy_(placed.x)
        there.s.copy_(placed.s)

    def population(self, world: int) -> Population:
        """Return the particles that are in a world.

        Args:
            world: Its number.
        """
        self._collect()
        columns = np.flatnonzero(self.there[world][self.owner])
        kind = self.species[columns]
        counts = np.bincount(kind, minlength=self.config.species_count)
        index = sent(columns, self.device)
        x, s = self._x[world : world + 1, index], self._s[world : world + 1, index]
        return Population(x, s, tuple(counts.tolist()), sent(kind, self.device))

    @torch.no_grad()
    def state(self) -> Tensor:
        """Return position, state and 1 of each particle, 0s of those gone, [B, N, 2 + C + 1]."""
        self._collect()
        there = sent(self.there[:, self.owner], self.device)[..., None]
        rows = torch.cat((self._x, self._s, there.float()), dim=-1)
        return torch.where(there, rows, 0.0)

    def here(self) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which the worlds' device is the current one."""
        device = self.device
        return contextlib.nullcontext() if device.type != "cuda" else torch.cuda.device(device)

    @property
    def cohorts(self) -> list[Cohort]:
        """The worlds that go on, those together that have the same particles."""
        if self._cohorts is None:
            if self.open.all() and self.there.all():
                self._cohorts = [self._whole]
            else:
                self._cohorts = self._gathered()
        return self._cohorts

    def _gathered(self) -> list[Cohort]:
        going_on = np.flatnonzero(self.open & self.there.any(axis=1))
        if not len(going_on):
            return []
        kinds, number = np.unique(self.there[going_on], axis=0, return_inverse=True)
        cohorts = []
        for k, kind in enumerate(kinds):
            worlds = going_on[number.reshape(-1) == k]
            columns = np.flatnonzero(kind[self.owner])
            index = sent(worlds, self.device)
            places = index[:, None], sent(columns, self.device)
            x, s, random = self._x[places], self._s[places], self._random.take(index)
            cohorts.append(Cohort(self._judge, worlds, columns, x, s, random))
        return cohorts

    def _disband(self) -> None:
        """Let cohorts be gathered anew when they are needed."""
        self._collect()
        self._cohorts = None

    def _collect(self) -> None:
        """Copy the cohorts' particles to their places in the batch."""
        for cohort in self._cohorts or ():
            if cohort is not self._whole:
                self._x[_places(cohort)] = cohort.population.x
                self._s[_places(cohort)] = cohort.population.s
                self._random.put(cohort.worlds, cohort.random)


def _places(cohort: Cohort) -> tuple[Tensor, Tensor]:
    """Return where the batch has a cohort's particles, as an index of two dimensions."""
    return cohort.worlds[:, None], cohort.columns
