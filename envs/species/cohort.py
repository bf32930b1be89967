"""Worlds of a batch in which the same particles are there, packed without the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.species.task import Population, SpeciesTask
from npa_envs.world.actions import (
    Actions,
    Physics,
    SurveyedWorlds,
    perceive_each_species,
    survey_worlds,
)
from npa_envs.world.cuda_graph import Replayed, sent
from npa_envs.world.randomness import WorldRandom


class Judge:
    """What is computed of worlds that have the same particles, whichever of a batch they are.

    Args:
        task: Gives losses.
        physics: The worlds' constants.
        owner: Number of the agent that owns each particle, int64, shape [N].
        by_particle: Whether every particle is an agent, and not every species.
    """

    def __init__(
        self, task: SpeciesTask, physics: Physics, owner: NDArray[np.int64], by_particle: bool
    ) -> None:
        self.task = task
        self.physics = physics
        self.owner = owner
        self.by_particle = by_particle
        self.agent_count = int(owner[-1]) + 1
        """Agents A."""

    def measured(self, population: Population, columns: Tensor) -> dict[str, Tensor]:
        """Return the parts of every agent's loss, float32, shape [M, A]; 0 of those that are gone.

        Args:
            population: Particles of M worlds.
            columns: Their numbers, int64, shape [N now].
        """
        if not self.by_particle:
            return dict(self.task.losses(population))
        found = {}
        for name, loss in self.task.particle_losses(population).items():
            found[name] = loss.new_zeros(len(loss), self.agent_count)
            found[name].index_copy_(1, columns, loss)
        return found

    def perceived(self, population: Population, surveyed: SurveyedWorlds | None = None) -> Tensor:
        """Return what particles perceive, by one pass for all species, shape [M, N now, P].

        Telling species apart takes another one, again for all of them.

        Args:
            population: Particles of M worlds.
            surveyed: The same worlds sorted, where they are already.
        """
        x, s, physics = population.x, population.s, self.physics
        seen = (surveyed or survey_worlds(x, s, physics)).perceive()
        if self.task.config.perception == "per_species":
            apart = perceive_each_species(x, population.counts, physics)
            seen = torch.cat((seen, apart), dim=-1)
        return seen

    def gone(self, population: Population, owners: Tensor) -> Tensor:
        """Return which agents have no particle within bounds, bool, shape [M, A].

        Args:
            population: Particles of M worlds.
            owners: The agent of each of them, int64, shape [N now].
        """
        inside = (population.s.abs() < self.physics.state_limit).all(dim=-1)
        # In a box nobody gets to the bound but by wrapping onto an edge that may lie there.
        if self.physics.box is None:
            inside &= (population.x.abs() < self.physics.position_limit).all(dim=-1)
        # Sums of ones are exact in any order.
        count = torch.zeros(len(inside), self.agent_count, device=inside.device)
        return count.index_add_(1, owners, inside.float()) == 0.0


class Cohort:
    """Some worlds of a batch with the same particles, stepped together.

    On CUDA what a step computes is recorded at the second one, so it pays where many follow.

    Args:
        judge: Computes losses, perception and bounds.
        worlds: Which worlds of the batch these are, int64, shape [M].
        columns: Which of the particles that an episode starts with are there, int64, shape [N now].
        x: Their positions [length units], shape [M, N now, 2]; changed in place.
        s: Their states, dimensionless, shape [M, N now, C]; changed in place.
        random: One stream a world; goes on in place.
    """

    def __init__(
        self,
        judge: Judge,
        worlds: NDArray[np.int64],
        columns: NDArray[np.int64],
        x: Tensor,
        s: Tensor,
        random: WorldRandom,
    ) -> None:
        device, config = x.device, judge.task.config
        kind = np.repeat(np.arange(config.species_count), config.counts)[columns]
        counts = np.bincount(kind, minlength=config.species_count)
        self._judge = judge
        self.random = random
        self.worlds = sent(worlds, device)
        self.columns = sent(columns, device)
        self.population = Population(x, s, tuple(counts.tolist()), sent(kind, device))
        """The particles."""
        self.parts: dict[str, Tensor] = {}
        """Parts of every agent's loss after the last step, shape [M, A]."""
        self.gone = torch.zeros(len(worlds), judge.agent_count, dtype=torch.bool, device=device)
        """Which agents have no particle within bounds after the last step, shape [M, A]."""
        self._owners = sent(judge.owner[columns], device)
        self._surveyed: SurveyedWorlds | None = None
        self._actions = Actions(
            x,
            s,
            judge.physics,
            random,
            enabled=torch.ones(1, dtype=torch.uint8, device=device),
            diverged=torch.zeros(len(worlds), dtype=torch.uint8, device=device),
        )
        self._draw = Replayed(self._actions.draw, device)
        self._look = Replayed(self._look_around, device)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what only the next perception needs, and which cannot be pickled."""
        return self.__dict__ | {"_surveyed": None}

    def act(self, action: Tensor) -> None:
        """Apply actions, and see what came of them; nothing waits for the device.

        Args:
            action: Finite, shape [M, N now, A].
        """
        self._draw()
        self._actions.apply(action)
        self._look()

    def measured(self) -> dict[str, Tensor]:
        """Return the parts of every agent's loss in the worlds as they are, shape [M, A]."""
        return self._judge.measured(self.population, self.columns)

    def perceived(self, *, stepped: bool = False) -> Tensor:
        """Return what the particles perceive, shape [M, N now, P].

        Args:
            stepped: Nothing has changed since the last `act`.
        """
        return self._judge.perceived(self.population, self._surveyed if stepped else None)

    def _look_around(self) -> None:
        self.gone = self._judge.gone(self.population, self._owners)
        self.parts = self.measured()
        population = self.population
        self._surveyed = survey_worlds(population.x, population.s, self._judge.physics)
