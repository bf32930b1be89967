"""The one world that all species share: how it starts, acts, perceives, and loses particles."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.control import Actions, perceive_each_species, survey_worlds
from npa_envs.envs.arrays import checked_particles
from npa_envs.envs.memory import check_memory
from npa_envs.envs.species.task import Population, SpeciesTask
from npa_envs.envs.task import EnvTask
from npa_envs.envs.worlds import make_physics
from npa_envs.errors import NPAError
from npa_envs.randomness import WorldRandom


class SpeciesWorld:
    """One world; particles of each species lie one after the other, and those removed are gone.

    Args:
        task_type: Gives starts and losses.
        config: The environment's configuration, of the task's kind.

    Raises:
        NPAError: The world does not fit into memory, or the task cannot be made.
    """

    def __init__(self, task_type: type[SpeciesTask], config: Any) -> None:
        self.config = config
        self.device = config.world.torch_device
        self.counts: tuple[int, ...] = config.counts
        """Particles of each species at the start of an episode."""
        self.particle_count = sum(self.counts)
        """Particles of all species at the start of an episode."""
        self.physics = make_physics(config.world, EnvTask)
        """The world's constants."""
        check_memory(1, self.particle_count, self.physics, self.device)
        self.task = task_type(config, self.device)
        self.species = np.repeat(np.arange(len(self.counts)), self.counts)
        """Species of each particle that an episode starts with, int64, shape [N]."""
        self.present = np.arange(self.particle_count)
        """Which of those particles are there, int64, shape [N now]."""
        self.x = torch.zeros(1, self.particle_count, 2, device=self.device)
        """Positions of those that are there [length units], shape [1, N now, 2]."""
        self.s = torch.zeros(1, self.particle_count, config.state_dim, device=self.device)
        """Their states, dimensionless, shape [1, N now, C]."""
        self.elapsed = torch.zeros(1, dtype=torch.int32)
        """Steps since the start of the episode, shape [1]."""
        self._random: WorldRandom | None = None
        self._actions: Actions | None = None
        self._enabled = torch.ones(1, dtype=torch.uint8, device=self.device)
        self._diverged = torch.zeros(1, dtype=torch.uint8, device=self.device)

    @property
    def perception_dim(self) -> int:
        """Numbers that a particle perceives: P, and K (1 + D) more where species are told apart."""
        told_apart = self.config.perception == "per_species"
        appended = len(self.counts) * (1 + self.physics.space_dim) if told_apart else 0
        return self.physics.perception_dim + appended

    @property
    def population(self) -> Population:
        """The particles that are there."""
        counts = np.bincount(self.species[self.present], minlength=len(self.counts))
        return Population(self.x, self.s, tuple(counts.tolist()))

    @torch.no_grad()
    def start(self, key: Tensor | None) -> None:
        """Start an episode.

        Args:
            key: Key of a new stream of randomness, int64, shape [1], which begins with its first
                episode; None: the stream goes on to its next one.
        """
        if key is not None:
            self._random = WorldRandom.from_keys(key.to(self.device))
        else:
            assert self._random is not None, "the first episode brings a key"
            self._random.restart()
        x, s = self.task.start(self._random)
        self.elapsed.zero_()
        self._put(x, s, np.arange(self.particle_count))

    def place(self, x: Any, s: Any) -> None:
        """Replace the particles that are there.

        Args:
            x: Positions [length units], shape [N now, 2].
            s: States, dimensionless, shape [N now, C].

        Raises:
            NPAError: There is no array of numbers, a shape is another one, or a number is not
                finite or beyond its limit.
        """
        placed = checked_particles(
            _one_world("x", x), _one_world("s", s), 1, len(self.present), self.physics, self.device
        )
        self._put(placed.x.clone(), placed.s.clone(), self.present)

    @torch.no_grad()
    def perceive(self) -> Tensor:
        """Return what all particles perceive, by one pass for all species, [N now, perception_dim].

        Telling species apart takes another one, again for all of them.
        """
        seen = survey_worlds(self.x, self.s, self.physics).perceive()
        if self.config.perception == "per_species":
            apart = perceive_each_species(self.x, self.population.counts, self.physics)
            seen = torch.cat((seen, apart), dim=-1)
        return seen[0]

    @torch.no_grad()
    def act(self, action: Tensor) -> None:
        """Apply actions.

        Args:
            action: Finite, shape [N now, A].
        """
        assert self._actions is not None, "the world was started"
        self._actions.draw()
        self._actions.apply(action[None])
        self.elapsed += 1

    def within_bounds(self) -> NDArray[np.bool_]:
        """Return which particles are not held at a bound, shape [N now]."""
        inside = self.s.abs() < self.s.new_tensor(self.physics.state_limit)
        inside = inside.all(dim=-1)
        # In a box nobody gets to the bound but by wrapping onto an edge that may lie there.
        if self.physics.box is None:
            limit = self.x.new_tensor(self.physics.position_limit)
            inside &= (self.x.abs() < limit).all(dim=-1)
        held: NDArray[np.bool_] = inside[0].cpu().numpy()
        return held

    @torch.no_grad()
    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Take all other particles out of the world.

        Args:
            kept: Which remain, shape [N now].
        """
        index = torch.from_numpy(np.flatnonzero(kept)).to(self.device)
        self._put(self.x[:, index], self.s[:, index], self.present[kept])

    @torch.no_grad()
    def state(self) -> Tensor:
        """Return position, state and 1 for each particle, zeros for those gone, [N, 2 + C + 1]."""
        ones = self.x.new_ones(1, len(self.present), 1)
        rows = torch.cat((self.x, self.s, ones), dim=-1)[0]
        everyone = rows.new_zeros(self.particle_count, rows.shape[1])
        everyone[torch.from_numpy(self.present).to(self.device)] = rows
        return everyone

    def _put(self, x: Tensor, s: Tensor, present: NDArray[np.int64]) -> None:
        self.x, self.s, self.present = x.contiguous(), s.contiguous(), present
        self._actions = None
        if len(present) and self._random is not None:
            self._actions = Actions(
                self.x,
                self.s,
                self.physics,
                self._random,
                enabled=self._enabled,
                diverged=self._diverged,
            )


def _one_world(name: str, value: Any) -> Tensor:
    try:
        return torch.as_tensor(value)[None]
    except (TypeError, ValueError, RuntimeError) as error:
        raise NPAError(
            f"{name} must be an array of numbers, got {type(value).__name__}: see env.particles()"
        ) from error
