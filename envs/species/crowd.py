"""One world as a PettingZoo environment: agents own particles, and all act at once."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, ClassVar, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.arrays import to_output
from npa_envs.envs.screen import Screen
from npa_envs.envs.species.account import Account, Losses
from npa_envs.envs.species.actions import joined_actions
from npa_envs.envs.species.pictures import SpeciesView
from npa_envs.envs.species.spaces import agent_spaces, state_space
from npa_envs.envs.species.tables import task_type
from npa_envs.envs.species.world import SpeciesWorld
from npa_envs.envs.species.zoo import ParallelEnv
from npa_envs.envs.vector_options import world_keys
from npa_envs.errors import NPAError, suggest

REMOVED, LEFT, ALONE, LATE = "removed", "left the world", "no opponent", "time limit"
"""Why an agent's episode ends, as `info["reason"]` says it."""
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
        found = task_type(task)
        self.config = found.config_type.from_keywords(keywords)
        self.render_mode = self.config.render_mode
        self.max_cycles = self.config.max_cycles
        """Steps after which the episode is cut off for all."""
        self.world = SpeciesWorld(found, self.config)
        """The particles."""
        self._task_name = task
        self._owner = self.owners(self.world)
        sizes = np.bincount(self._owner)
        ends = np.cumsum(sizes)
        self._spans = [slice(int(e - n), int(e)) for e, n in zip(ends, sizes, strict=True)]
        self._species = self.world.species[ends - 1]
        self.possible_agents = [f"{self.agent_word}_{k}" for k in range(len(sizes))]
        self.agents: list[str] = []
        self._live = np.arange(0)
        rows = [(int(n),) if self.rows else () for n in sizes]
        physics = self.world.physics
        self.observation_spaces, self.action_spaces = agent_spaces(
            physics, self.world.perception_dim, self.possible_agents, rows
        )
        self.state_space = state_space(physics, self.world.particle_count)
        """Space of `state`: float32, shape [N, 2 + C + 1]."""
        self.np_random: np.random.Generator | None = None
        self._started = False
        team = self.config.reward == "team"
        self._account = Account(self.world.task, self._species, team)
        # A screen asks no more of worlds than the view has.
        self._screen = Screen(cast(Any, SpeciesView(self.world)), self.metadata["render_fps"])

    agent_word: ClassVar[str]
    """Agents are called this, with a number behind it."""

    rows: ClassVar[bool]
    """Whether an agent's observation and action have a row for each of its particles."""

    def owners(self, world: SpeciesWorld) -> NDArray[np.int64]:
        """Return the number of the agent that owns each particle, never falling, shape [N].

        Args:
            world: The world, before its first episode.
        """
        raise NotImplementedError

    def measured(self) -> Losses:
        """Return the parts of every agent's loss, shape [agents]; anything for those that ended."""
        raise NotImplementedError

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
        """
        key = None
        if seed is not None or self.np_random is None:
            self.np_random, _ = seeding.np_random(seed)
            key = world_keys(None, 1, self.np_random)
        with self._here():
            self.world.start(key)
            self._account.open(self.measured())
            observation = self._seen()
        self.agents = list(self.possible_agents)
        self._live = np.arange(len(self.agents))
        self._started = True
        self._show()
        infos = {agent: self._account.info(k) for k, agent in enumerate(self.agents)}
        return self._handed_out(observation), infos

    def step(self, actions: Mapping[str, Any]) -> Outcome:
        """Apply the actions of all live agents, take those that ended out of the world, perceive.

        Args:
            actions: One for each live agent, as its action space says.

        Returns:
            Observations, rewards, whether an agent's episode ended by itself, whether it was cut
            off, and infos: of all agents that acted.

        Raises:
            NPAError: The episode is over, or an action is missing, not wanted, of another shape or
                not finite; the world is then as it was.
        """
        if not self.agents:
            raise NPAError("step needs a live agent, and there is none: call reset first")
        shapes = [self.action_spaces[agent].shape for agent in self.agents]
        action = joined_actions(actions, self.agents, shapes, self.world.device)
        acted, live, world = self.agents, self._live.tolist(), self.world
        with self._here():
            world.act(action)
            reasons = self._gone()
            fled = [k for k, reason in reasons.items() if reason == LEFT]
            paid = self._account.pay(self.measured(), self._live, fled).tolist()
            infos = {self.possible_agents[k]: self._account.step_info(k) for k in live}
            observation = self._seen()
            if reasons:
                observation = self._take_out(reasons, observation)
        late = int(world.elapsed[0]) >= self.max_cycles
        terminations = {}
        for k, agent in zip(live, acted, strict=True):
            terminations[agent] = k in reasons
            if k in reasons or late:
                infos[agent]["reason"] = reasons.get(k, LATE)
        observations = self._handed_out(observation)
        self._live = np.array([k for k in live if k not in reasons and not late], dtype=np.int64)
        self.agents = [self.possible_agents[k] for k in self._live]
        self._show()
        rewards, truncations = dict(zip(acted, paid, strict=True)), dict.fromkeys(acted, late)
        return observations, rewards, terminations, truncations, infos

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
        return to_output(self.world.state(), self.config.output)

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
        return self.world.x[0].clone(), self.world.s[0].clone()

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
        with self._here():
            self.world.place(x, s)
            self._account.carry_over(self.measured())
            observation = self._seen()
        self._show()
        return self._handed_out(observation)

    def _gone(self) -> dict[int, str]:
        """Return why agents' episodes end by themselves in this step, by their numbers."""
        world = self.world
        inside = self._owner[world.present[world.within_bounds()]]
        kept = np.bincount(inside, minlength=len(self._spans))
        step = int(world.elapsed[0])
        doomed = {species for species, when in self.config.deaths if when == step}
        reasons = {int(k): REMOVED for k in self._live if int(self._species[k]) in doomed}
        reasons |= {int(k): LEFT for k in self._live if kept[k] == 0}
        staying = [k for k in self._live if k not in reasons]
        counts = np.bincount(self._species[staying], minlength=self.config.species_count)
        if world.task.is_over(tuple(counts.tolist())):
            reasons |= {int(k): ALONE for k in staying}
        return reasons

    def _take_out(self, reasons: dict[int, str], observation: Tensor) -> Tensor:
        """Take out particles of agents that ended; return what is perceived without them."""
        world = self.world
        dead = [k for k, reason in reasons.items() if reason != ALONE]
        world.keep(~np.isin(self._owner[world.present], dead))
        if len(reasons) == len(self._live):
            return observation
        # What others lose or gain by a death is nobody's merit: the next step counts from here.
        self._account.carry_over(self.measured())
        last, observation = observation, self._seen()
        for k in reasons:
            observation[self._spans[k]] = last[self._spans[k]]
        return observation

    def _seen(self) -> Tensor:
        """Return what particles perceive, in rows for all that an episode starts with, [N, P]."""
        seen = self.world.perceive()
        if len(seen) == self.world.particle_count:
            return seen
        everyone = seen.new_zeros(self.world.particle_count, seen.shape[1])
        everyone[torch.from_numpy(self.world.present).to(seen.device)] = seen
        return everyone

    def _handed_out(self, observation: Tensor) -> dict[str, Any]:
        rows = to_output(observation, self.config.output)
        return {
            agent: rows[self._spans[k]] if self.rows else rows[self._spans[k].start]
            for k, agent in zip(self._live, self.agents, strict=True)
        }

    def _show(self) -> None:
        self._screen.show(f"{self.metadata['name']}: {self._task_name}")

    def _here(self) -> contextlib.AbstractContextManager[Any]:
        device = self.world.device
        return contextlib.nullcontext() if device.type != "cuda" else torch.cuda.device(device)

    def _check_agent(self, agent: str) -> None:
        if agent not in self.observation_spaces:
            hint = suggest(str(agent), self.possible_agents[:8])
            raise NPAError(f"agent must be one that exists, got {agent!r}: {hint}")
