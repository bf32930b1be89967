"""Two agents with brushes and opposed aims: `parallel_env`, `env`, `raw_env` and `batched`.

Importing this module registers `npa/Gardeners-v0` with PettingZoo (1.27 or newer).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import Space
from gymnasium.vector.utils import batch_space
from torch import Tensor

from npa_envs.envs.core.base import to_output
from npa_envs.envs.core.vector import NPAVectorEnv, checked_count
from npa_envs.envs.garden.brush_actions import BrushSpaces
from npa_envs.envs.gardener2d import Gardener2DEnv, GardenerTask
from npa_envs.envs.multi.agents_env import state_space
from npa_envs.envs.multi.parallel import KnownAgents, Outcome, in_turns, register
from npa_envs.envs.multi.species_worlds import AGENT_REASONS
from npa_envs.errors import NPAError, shown

AGENTS = ("keeper_0", "raider_0")


class _BothSpaces(BrushSpaces):
    """Spaces of one gardener; `action` takes a dict with both gardeners' actions."""

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return checked rows of both gardeners' brushes, float32, shape [B, 2 J, W]."""
        both = [super(_BothSpaces, self).action(action[agent], world_count) for agent in AGENTS]
        return torch.cat(both, dim=1)


class _SharedTask(GardenerTask):
    spaces_type = _BothSpaces


class _SharedGarden(Gardener2DEnv):
    task_type = _SharedTask


CALM = {"gust_chance": 0.0, "blight_chance": 0.0}
"""Defaults of gardens with a raider."""


class GardenersEnv(KnownAgents):
    """Two gardeners at one picture: the keeper keeps it intact, the raider spoils it.

    ## Description

    The world is that of [`npa/Gardener2D-v0`](Gardener2D.md): a trained rule has grown a picture
    from N particles and keeps stepping them. There are no gusts and blights; the raider takes their
    place. Both agents have the same brushes and the same observation. All brushes act at once, and
    their effects add up.

    `parallel_env`, `env` and `raw_env` are as for [several species](MultiSpecies.md); in turn, the
    world is stepped after the raider acts. Once `npa_envs.envs.gardeners_v0` is imported,
    `pettingzoo.make`, of PettingZoo 1.27 or newer, takes the id `npa/Gardeners-v0`.

    `garden` is the world as a Gymnasium environment. Policies of `npa_envs.agents.garden_policies`
    take it, and their actions fit either agent: `ScriptedGardener(env.garden)`.

    `gardeners_v0.batched(world_count=B)` steps B worlds together: observations [B, O], actions
    [B, J W], rewards and flags [B], by agent.

    ## Spaces, starting state and info

    As those of `npa/Gardener2D-v0`, for each agent. Every agent has to give an action. Infos are
    numbers with the same keys after resets and steps; `reason` is 0 until the last step, then 4 for
    the time limit, 5 for success or 6 for a world that diverged.

    ## State

    `state()` is for central critics: float32, shape [N, 2 + C + 1], a row [position; state; 1] for
    each particle, as with [several species](MultiSpecies.md#state). `state_space` is its space.

    ## Reward

    The keeper gets a gardener's reward: 1 for a picture as good as at the start, 0 for one as bad
    as a grey one, and at least −1. The raider gets minus that, so rewards sum to zero.

    ## Episode end

    After `max_cycles` steps both agents are truncated. A world that diverges terminates both.

    ## Arguments

    `max_cycles`, the steps of an episode, and all arguments of `npa/Gardener2D-v0`. Chances of
    gusts and blights are 0 by default.

    ## Version history

    - v0: first version.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "gardeners_v0",
        "is_parallelizable": True,
        **Gardener2DEnv.metadata,
    }

    def __init__(self, max_cycles: int = 32, **config: Any) -> None:
        self.max_cycles = checked_count("max_cycles", max_cycles)
        """Steps of an episode."""
        self.garden = _SharedGarden(**(CALM | config | {"episode_steps": self.max_cycles}))
        """The world as a Gymnasium environment, whose actions are dicts with both agents'."""
        self.render_mode, self.possible_agents = self.garden.render_mode, list(AGENTS)
        self.agents: list[str] = []
        self.observation_spaces = dict.fromkeys(AGENTS, self.garden.observation_space)
        self.action_spaces = dict.fromkeys(AGENTS, self.garden.action_space)
        worlds = self.garden.worlds
        self.state_space = state_space(worlds.physics, worlds.x.shape[1])
        """Space of `state`: float32, shape [N, 2 + C + 1]."""

    @property
    def np_random(self) -> np.random.Generator:
        """Generator of the seeds of episodes, which a `reset` with a seed begins anew."""
        return self.garden.np_random

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start an episode; return both agents' observations and infos."""
        observation, info = self.garden.reset(seed=seed)
        self.agents = list(AGENTS)
        return _for_both(observation), _infos(info)

    def step(self, actions: Mapping[str, Any]) -> Outcome:
        """Apply both agents' actions and step the rule; return an `Outcome`."""
        self.garden.check_begun("step needs a world")
        if not self.agents and not actions:
            return {}, {}, {}, {}, {}
        if not self.agents or set(actions) != set(self.agents):
            raise NPAError(
                f"actions must be given for the agents {self.agents}, got some for "
                f"{shown(list(actions))}: call reset where there are none"
            )
        observation, reward, terminated, truncated, info = self.garden.step(actions)
        if terminated or truncated:
            self.agents = []
        return (
            _for_both(observation),
            {"keeper_0": float(reward), "raider_0": -float(reward)},
            dict.fromkeys(AGENTS, terminated),
            dict.fromkeys(AGENTS, truncated),
            _infos(info),
        )

    def state(self) -> Any:
        """Return the whole world, for central critics: a row [position; state; 1] a particle."""
        return _state(self.garden)

    def render(self) -> Any:
        """Return the world's picture, uint8, [R, R, 3]; None unless `render_mode="rgb_array"`."""
        return self.garden.render()

    def close(self) -> None:
        """End the world, and close the window, if there is one."""
        self.garden.close()


class GardenersVectorEnv(NPAVectorEnv):
    """B worlds of `GardenersEnv`, stepped together, by an `NPAVectorEnv` with two agents.

    World k, reset with `seed`, is that with `seed + k` by itself. Each agent has observations
    [B, O], actions [B, J W], rewards and flags [B], and the infos of `npa/Gardener2D-v0`, with
    `live`, `acted` and `reason` as of `MultiSpeciesVectorEnv`, whose other attributes it has.
    """

    metadata = NPAVectorEnv.metadata | {"name": "gardeners_v0", "is_parallelizable": True}
    task_type = _SharedTask

    def __init__(self, max_cycles: int = 32, *, world_count: int = 1, **config: Any) -> None:
        count = checked_count("world_count", world_count)
        steps = {"episode_steps": checked_count("max_cycles", max_cycles)}
        super().__init__(count, max_episode_steps=max_cycles, **(CALM | config | steps))
        self.agents = self.possible_agents = list(AGENTS)
        self.world_count, self.max_cycles = count, steps["episode_steps"]
        self.single_observation_spaces = dict.fromkeys(AGENTS, self.single_observation_space)
        self.single_action_spaces = dict.fromkeys(AGENTS, self.single_action_space)
        self.observation_spaces = dict.fromkeys(AGENTS, self.observation_space)
        self.action_spaces = dict.fromkeys(AGENTS, self.action_space)
        self.single_state_space = state_space(self.worlds.physics, self.worlds.x.shape[1])

    @cached_property
    def state_space(self) -> Space[Any]:
        """Space of all worlds' `state`, [B, N, 2 + C + 1]; large, so made at the first use."""
        return batch_space(self.single_state_space, self.world_count)

    def reset(self, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Start episodes as `NPAVectorEnv.reset` does; return both agents' observations, infos."""
        observation, infos = super().reset(seed=seed, options=options)
        return _for_both(observation), self._by_agent(infos)

    def step(self, actions: Mapping[str, Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Apply both agents' actions; return what PettingZoo's `step` does, of all worlds."""
        if not isinstance(actions, Mapping) or set(actions) != set(AGENTS):
            raise NPAError(f"actions must be given for the agents {AGENTS}, got {shown(actions)}")
        acted = self._mask(~self._ended)
        observation, reward, *ends, infos = super().step(actions)
        ended, cut = (dict.fromkeys(AGENTS, end) for end in ends)
        rewards = {AGENTS[0]: reward, AGENTS[1]: -reward}
        # A restart has moved the reasons of the episodes that ended.
        last = infos.get("final_info", infos)
        infos |= {"acted": acted} | {n: last[n] for n in ("reason",) if n in last}
        return _for_both(observation), rewards, ended, cut, self._by_agent(infos)

    def state(self) -> Any:
        """Return the worlds as `GardenersEnv.state` does, [B, N, 2 + C + 1]."""
        return _state(self)

    def _by_agent(self, infos: dict[str, Any]) -> dict[str, Any]:
        live = self._mask(~self._ended)
        return {agent: infos | {"live": live} for agent in AGENTS}


def _state(garden: Any) -> Any:
    garden.check_begun("state needs a world")
    x, s = garden.particles()
    return to_output(torch.cat((x, s, torch.ones_like(x[..., :1])), dim=-1), garden.config.output)


def _for_both(observation: Any) -> dict[str, Any]:
    # Copies, so that one agent's changes do not reach the other's.
    copied = observation.clone if isinstance(observation, Tensor) else observation.copy
    return {agent: copied() for agent in AGENTS}


def _infos(info: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return both agents' infos: numbers, and the same entries after a reset as after a step."""
    gains = {f"reward_{n[5:]}": 0.0 for n in info if n.startswith("loss_")}
    info = gains | {"success": False, "diverged": False} | info
    info["reason"] = AGENT_REASONS.tolist().index(info.get("reason"))
    return {agent: dict(info) for agent in AGENTS}


def parallel_env(max_cycles: int = 32, **config: Any) -> GardenersEnv:
    """Return an environment whose two agents act at once; arguments: those of `GardenersEnv`."""
    return GardenersEnv(max_cycles, **config)


batched = GardenersVectorEnv
raw_env, env = in_turns(parallel_env)


register("npa/Gardeners-v0", __name__, {})
