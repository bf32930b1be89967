"""One world as a PettingZoo parallel environment, whose agents own particles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import compress, repeat
from operator import attrgetter
from typing import Any, ParamSpec

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from npa_envs.envs.multi.agents_env import AgentsEnv, joined_actions
from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest

try:
    import pettingzoo
    from pettingzoo.utils.conversions import parallel_to_aec_wrapper
    from pettingzoo.utils.wrappers import ClipOutOfBoundsWrapper, OrderEnforcingWrapper
except ImportError as error:
    raise MissingDependencyError(
        f"environments of several species need PettingZoo, which is not installed ({error}): "
        "pip install 'npa-envs[envs]'"
    ) from error

Arguments = ParamSpec("Arguments")
Flags = dict[str, bool]
Infos = dict[str, dict[str, Any]]
Outcome = tuple[dict[str, Any], dict[str, float], Flags, Flags, Infos]
"""What a step returns: observations, rewards, terminations, truncations, infos."""


class KnownAgents(pettingzoo.ParallelEnv):  # type: ignore[misc]
    """A PettingZoo environment that checks the names of agents."""

    def observation_space(self, agent: str) -> Any:
        """Return the space of an agent's observations, the same object each time."""
        return self.observation_spaces[self._known(agent)]

    def action_space(self, agent: str) -> Any:
        """Return the space of an agent's actions, the same object each time."""
        return self.action_spaces[self._known(agent)]

    def __repr__(self) -> str:
        count, name = len(self.possible_agents), self.metadata["name"]
        return f"<{type(self).__name__} {name}: {count} agents, max_cycles={self.max_cycles}>"

    def _known(self, agent: str) -> str:
        if agent not in self.observation_spaces:
            hint = suggest(agent, self.possible_agents[:8])
            raise NPAError(f"agent must be one that exists, got {shown(agent)}: {hint}")
        return agent


class CrowdEnv(AgentsEnv, KnownAgents):
    """One world as a PettingZoo environment; agents are species, or particles."""

    def __init__(self, task: str, keywords: dict[str, Any], *, by_particle: bool) -> None:
        super().__init__(task, keywords, 1, by_particle=by_particle)
        self.observation_spaces = self.single_observation_spaces
        self.action_spaces = self.single_action_spaces
        self.state_space = self.single_state_space
        self.agents: list[str] = []
        self._live: list[bool] = []

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], Infos]:
        """Start an episode as `NPAEnv.reset` does; return all agents' observations and infos."""
        observation = self._start(np.arange(1), seed, seed)
        self._update_agents()
        # Nothing has been gained so far.
        numbers = self.worlds.agent_returns.loss_infos(stepped=True)
        return self._by_agent(observation), self._infos(numbers)

    def step(self, actions: Mapping[str, Any]) -> Outcome:
        """Apply an action of each live agent; return an `Outcome` for these agents.

        Actions of agents whose episodes have ended are ignored.

        Raises:
            NPAError: There is no world yet, or an action is missing, of an unknown agent, or of
                another shape; the world is not changed.
            DivergedError: An action is not finite, and the world is not changed; or an agent is
                out of bounds, and `on_divergence` is "raise".
        """
        self.check_begun("step needs a world")
        if not self.agents and isinstance(actions, Mapping):
            if not actions:
                return {}, {}, {}, {}, {}
            raise NPAError("step needs a live agent, and there is none: call reset first")
        if isinstance(actions, Mapping) and len(actions) > len(self.agents):
            # Frame skips of SuperSuit repeat the actions of agents that have ended meanwhile.
            over = self.action_spaces.keys() - set(self.agents)
            actions = {agent: action for agent, action in actions.items() if agent not in over}
        worlds, acted, live = self.worlds, self.agents, self._live
        action = joined_actions(actions, acted, self._shapes, worlds.device)
        with worlds.device_context():
            outcome = worlds.step(self._with_zeros(action))
        infos = self._infos(outcome.numbers)
        observations = self._by_agent(outcome.observation)
        rewards = dict(zip(acted, compress(outcome.rewards[0].tolist(), live), strict=True))
        ended, truncated = outcome.endings[0] > 0, bool(outcome.truncated[0])
        terminations = dict(zip(acted, compress(ended.tolist(), live), strict=True))
        truncations = dict.fromkeys(acted, truncated)
        if truncated or ended.any():
            for agent, cause in zip(acted, compress(outcome.causes[0].tolist(), live), strict=True):
                infos[agent]["reason"] = cause
            self._update_agents()
        self._show()
        return observations, rewards, terminations, truncations, infos

    def state(self) -> Any:
        """Return the full state of the world, for central critics; see `state_space`."""
        return self._out(self._state()[0])

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [N', 2], and states, [N', C]; N' remain."""
        population = self.worlds.population(0)
        return population.x[0], population.s[0]

    def place_particles(self, x: Any, s: Any) -> dict[str, Any]:
        """Replace what `particles` returns, without a reward; return all agents' observations."""
        if not self.agents:
            raise NPAError("particles need live agents: call reset first")
        with self.worlds.device_context():
            observation = self.worlds.place(x, s)
        self._show()
        return self._by_agent(observation)

    def _update_agents(self) -> None:
        self._live = self.worlds.live[0, : len(self.possible_agents)].tolist()
        self.agents = list(compress(self.possible_agents, self._live))
        self._shapes = [self.action_spaces[agent].shape for agent in self.agents]

    def _with_zeros(self, action: Tensor) -> Tensor:
        """Return all particles' actions, [1, N, A], from the live agents', [N', A], and zeros."""
        count = self.worlds.particle_count
        if len(action) == count:
            return action[None]
        all_rows = action.new_zeros(1, count, action.shape[1])
        live = np.isin(self.worlds.owner, np.flatnonzero(self._live))
        all_rows[0, torch.from_numpy(live).to(action.device)] = action
        return all_rows

    def _infos(self, numbers: dict[str, Tensor]) -> Infos:
        """Return infos of live agents: species, no reason, and theirs of `numbers`, [1, M] each."""
        columns = torch.stack(list(numbers.values()))[:, 0].tolist()
        species = self.worlds.agent_species.tolist()
        rows = zip(species, [0] * len(species), *columns, strict=True)
        # Iterators make a dict in half the time of a comprehension.
        names = "species", "reason", *numbers
        named = map(dict, map(zip, repeat(names), compress(rows, self._live)))
        return dict(zip(self.agents, named, strict=True))

    def _by_agent(self, observation: Tensor) -> dict[str, Any]:
        """Return each live agent's observation from all particles' perception, [1, N, P]."""
        rows, worlds = self._out(observation[0]), self.worlds
        parts = rows if worlds.by_particle else [rows[span] for span in worlds.spans]
        return dict(zip(self.agents, compress(parts, self._live), strict=True))


class TurnsEnv(OrderEnforcingWrapper):  # type: ignore[misc]
    """A parallel environment whose agents act in turn, with PettingZoo's checks of the order.

    The world is stepped after the last agent. `clips`: actions are clipped to their box. Calls are
    passed to PettingZoo's wrappers only if they have something to say: these are slow.
    """

    agents = property(attrgetter("_turns.agents"))
    agent_selection = property(attrgetter("_turns.agent_selection"))
    __str__ = ClipOutOfBoundsWrapper.__str__

    def __init__(self, parallel_env: KnownAgents, *, clips: bool) -> None:
        self._turns = turns = parallel_to_aec_wrapper(parallel_env)
        boxes = [isinstance(turns.action_space(a), Box) for a in turns.possible_agents]
        self._clips = clips and all(boxes)
        super().__init__(ClipOutOfBoundsWrapper(turns) if self._clips else turns)

    def last(self, observe: bool = True) -> Any:
        """Return the next agent's observation, reward since it acted, flags and info."""
        return self._turns.last(observe) if self._has_reset else super().last(observe)

    def step(self, action: Any) -> None:
        """Take the action of the agent whose turn it is."""
        turns = self._turns
        fits = self._has_reset and bool(turns.agents)
        if fits and self._clips and action is not None:
            fits = type(action) is np.ndarray and action.dtype == np.float32
            fits = fits and action.shape == turns.action_space(turns.agent_selection).shape
            # The box of all actions; not a number is outside of it.
            fits = fits and bool(np.abs(action).max() <= 1.0)
        self._has_updated |= fits
        (turns.step if fits else super().step)(action)


def in_turns(
    parallel_env: Callable[Arguments, KnownAgents],
) -> tuple[Callable[Arguments, Any], Callable[Arguments, Any]]:
    """Return functions `raw_env` and `env` for a `parallel_env`; their agents act in turn."""

    def raw_env(*args: Arguments.args, **config: Arguments.kwargs) -> Any:
        """Return `parallel_env` with agents that act in turn; the world steps after the last."""
        return TurnsEnv(parallel_env(*args, **config), clips=False)

    def env(*args: Arguments.args, **config: Arguments.kwargs) -> Any:
        """Return `raw_env` with actions clipped to their box."""
        return TurnsEnv(parallel_env(*args, **config), clips=True)

    return raw_env, env


def register(name: str, module: str, keywords: dict[str, Any]) -> None:
    """Register the id `name` with PettingZoo, for `parallel_env` and `env` of `module`."""
    for api, function in (("parallel", "parallel_env"), ("aec", "env")):
        # PettingZoo before 1.27 has no registries.
        if name not in getattr(pettingzoo, f"{api}_registry", {name}):
            pettingzoo.register(api, name, f"{module}:{function}", kwargs=keywords)
