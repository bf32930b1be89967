"""One world as a PettingZoo environment: agents own particles, and all act at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.arrays import to_output
from npa_envs.envs.screen import Screen
from npa_envs.envs.species.actions import joined_actions
from npa_envs.envs.species.episodes import Episodes
from npa_envs.envs.species.pictures import SpeciesView
from npa_envs.envs.species.spaces import agent_spaces, state_space
from npa_envs.envs.species.zoo import ParallelEnv
from npa_envs.envs.vector_options import world_keys
from npa_envs.errors import NPAError, suggest

Flags = dict[str, bool]
Infos = dict[str, dict[str, Any]]
Outcome = tuple[dict[str, Any], dict[str, float], Flags, Flags, Infos]
"""What a step returns: observations, rewards, terminations, truncations, infos."""


class CrowdEnv(ParallelEnv):  # type: ignore[misc]
    """A world whose particles belong to agents; subclasses say to which.

    Args:
        task: A name from `npa_envs.envs.species.TASKS`.
        keywords: Fields of the task's configuration.

    Raises:
        NPAError: There is no such task, a keyword is unknown or wrong, or the world does not fit
            into memory.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "npa_crowd",
        "render_modes": ["rgb_array", "human"],
        "render_fps": 25,
        "is_parallelizable": True,
    }

    def __init__(self, task: str, keywords: dict[str, Any]) -> None:
        self._episodes = episodes = Episodes(task, keywords, 1, by_particle=not self.rows)
        self.config = episodes.config
        self.render_mode = self.config.render_mode
        self.max_cycles = self.config.max_cycles
        """Steps after which the episode is cut off for all."""
        self.worlds = worlds = episodes.worlds
        """The particles: a batch of one world."""
        self._task_name = task
        self.possible_agents = [f"{self.agent_word}_{k}" for k in range(worlds.agent_count)]
        self.agents: list[str] = []
        self._live: list[int] = []
        sizes = [span.stop - span.start for span in episodes.spans]
        rows = [(count,) if self.rows else () for count in sizes]
        self.observation_spaces, self.action_spaces = agent_spaces(
            worlds.physics, worlds.perception_dim, self.possible_agents, rows
        )
        self.state_space = state_space(worlds.physics, worlds.particle_count)
        """Space of `state`: float32, shape [N, 2 + C + 1]."""
        self.np_random: np.random.Generator | None = None
        self._started = False
        self._screen = Screen(SpeciesView(worlds), self.metadata["render_fps"])

    agent_word: ClassVar[str]
    """Agents are called this, with a number behind it."""

    rows: ClassVar[bool]
    """Whether agents are species, whose observations and actions have a row for each particle."""

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations, the same object each time.

        Args:
            agent: One of `possible_agents`.

        Raises:
            NPAError: There is no such agent.
        """
        self._check_agent(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's actions, the same object each time.

        Args:
            agent: One of `possible_agents`.

        Raises:
            NPAError: There is no such agent.
        """
        self._check_agent(agent)
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], Infos]:
        """Start an episode with all agents.

        Args:
            seed: Begin the sequence of episodes that belongs to this number; without it the
                sequence goes on.
            options: Not used.

        Returns:
            Observations, and each agent's loss with its parts.

        Raises:
            gymnasium.error.Error: The seed is no integer of at least 0.
        """
        key = None
        if seed is not None or self.np_random is None:
            self.np_random, _ = seeding.np_random(seed)
            key = world_keys(None, 1, self.np_random)
        with self.worlds.here():
            observation = self._episodes.start(np.arange(1), key)
        self._count_agents()
        self._started = True
        self._show()
        infos = self._infos(self._episodes.account.numbers())
        return self._handed_out(observation), infos

    def step(self, actions: Mapping[str, Any]) -> Outcome:
        """Apply the actions of all live agents, take those that ended out of the world, perceive.

        Args:
            actions: One for each live agent, as its action space says.

        Returns:
            Observations, rewards, whether an agent's episode ended by itself, whether it was cut
            off, and infos: of all agents that acted.

        Raises:
            NPAError: The episode is over, or an action is missing, not wanted, or of another
                shape; the world is then as it was.
            DivergedError: An action is not finite, and the world is as it was; or an agent is out
                of bounds, and `on_divergence` is "raise".
        """
        if not self.agents:
            raise NPAError("step needs a live agent, and there is none: call reset first")
        worlds, acted, live = self.worlds, self.agents, self._live
        shapes = [self.action_spaces[agent].shape for agent in acted]
        action = joined_actions(actions, acted, shapes, worlds.device)
        with worlds.here():
            outcome = self._episodes.step(self._everyones(action))
        ended, late = outcome.endings[0] > 0, bool(outcome.late[0])
        infos = self._infos(outcome.numbers)
        for k, agent in zip(live, acted, strict=True):
            if ended[k] or late:
                infos[agent]["reason"] = outcome.reasons[0, k]
        observations = self._handed_out(outcome.observation)
        paid = outcome.rewards[0].tolist()
        rewards = {agent: paid[k] for k, agent in zip(live, acted, strict=True)}
        terminations = {agent: bool(ended[k]) for k, agent in zip(live, acted, strict=True)}
        self._count_agents()
        self._show()
        return observations, rewards, terminations, dict.fromkeys(acted, late), infos

    def state(self) -> Any:
        """Return what there is to know of the world, for central critics; see `state_space`.

        Returns:
            A row [position ; state ; 1] for each particle that an episode starts with, zeros for
            those that are gone, shape [N, 2 + C + 1].

        Raises:
            NPAError: There is no world yet.
        """
        if not self._started:
            raise NPAError("state needs a world: call reset first")
        return to_output(self.worlds.state()[0], self.config.output)

    def render(self) -> NDArray[np.uint8] | None:
        """Return the world's picture, shape [R, R, 3], in the mode "rgb_array"."""
        if not self._started:
            raise NPAError("render needs a world: call reset first")
        pictures = self._screen.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Close the window, if there is one."""
        self._screen.close()

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [N now, 2], and states, [N now, C]."""
        there = self.worlds.population(0)
        return there.x[0], there.s[0]

    def place_particles(self, x: Any, s: Any) -> dict[str, Any]:
        """Replace the particles of all live agents, at no reward, and return the observations.

        Args:
            x: Positions [length units], shape [N now, 2].
            s: States, dimensionless, shape [N now, C].

        Raises:
            NPAError: A shape is another one, or a number is not finite or beyond its limit.
        """
        if not self.agents:
            raise NPAError("particles need live agents: call reset first")
        with self.worlds.here():
            self.worlds.place(_one_world("x", x), _one_world("s", s))
            observation = self._episodes.carry_over()
        self._show()
        return self._handed_out(observation)

    def _count_agents(self) -> None:
        """Take down who is to act next."""
        self._live = np.flatnonzero(self._episodes.live[0]).tolist()
        self.agents = [self.possible_agents[k] for k in self._live]

    def _everyones(self, action: Tensor) -> Tensor:
        """Return actions of live agents, [N now, A], with zeros for all others, [1, N, A]."""
        count = self.worlds.particle_count
        if len(action) == count:
            return action[None]
        everyone = action.new_zeros(1, count, action.shape[1])
        live = self._episodes.live[0][self.worlds.owner]
        everyone[0, torch.from_numpy(live).to(action.device)] = action
        return everyone

    def _infos(self, numbers: dict[str, Tensor]) -> Infos:
        """Return what `info` says of live agents' losses."""
        rows = torch.stack(list(numbers.values()))[:, 0].tolist()
        columns = dict(zip(numbers, rows, strict=True))
        species = self._episodes.species
        return {
            agent: {"species": int(species[k])} | {name: row[k] for name, row in columns.items()}
            for k, agent in zip(self._live, self.agents, strict=True)
        }

    def _handed_out(self, observation: Tensor) -> dict[str, Any]:
        """Return the rows of what all particles perceive, [1, N, P], that are of `agents`."""
        rows, spans = to_output(observation[0], self.config.output), self._episodes.spans
        return {
            agent: rows[spans[k]] if self.rows else rows[spans[k].start]
            for k, agent in zip(self._live, self.agents, strict=True)
        }

    def _show(self) -> None:
        self._screen.show(f"{self.metadata['name']}: {self._task_name}")

    def _check_agent(self, agent: str) -> None:
        if agent not in self.observation_spaces:
            hint = suggest(str(agent), self.possible_agents[:8])
            raise NPAError(f"agent must be one that exists, got {agent!r}: {hint}")


def _one_world(name: str, value: Any) -> Tensor:
    try:
        return torch.as_tensor(value)[None]
    except (TypeError, ValueError, RuntimeError) as error:
        raise NPAError(
            f"{name} must be an array of numbers, got {type(value).__name__}: see env.particles()"
        ) from error
