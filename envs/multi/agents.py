"""Agents that own particles of shared worlds: names, spaces, actions laid one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.screen import Screen, ShownEnv
from npa_envs.envs.core.spaces import action_tensor
from npa_envs.envs.core.vector import plain_seed, rng_keys
from npa_envs.envs.multi.worlds import AgentReferee
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.world.actions import Physics


class AgentsEnv(ShownEnv):
    """What environments of agents are made of, be it one world or many."""

    metadata: ClassVar[dict[str, Any]] = {
        "name": "npa_multispecies_v0",
        "render_modes": ["rgb_array", "human"],
        "render_fps": 25,
        "is_parallelizable": True,
    }

    def __init__(
        self, task: str, keywords: dict[str, Any], world_count: int, *, by_particle: bool
    ) -> None:
        self._episodes = episodes = AgentReferee(
            task, keywords, world_count, by_particle=by_particle
        )
        self._by_particle = by_particle
        self._task_name = task
        self.config = episodes.config
        self.render_mode = self.config.render_mode
        self.max_cycles = self.config.max_cycles
        """Steps after which an episode is cut off for all."""
        self.worlds = worlds = episodes.worlds
        """The particles."""
        played = self.config.played_counts
        word, count = ("particle", sum(played)) if by_particle else ("species", len(played))
        self.possible_agents = [f"{word}_{k}" for k in range(count)]
        """Names of the agents."""
        limit = worlds.physics.limits.perception
        self._observation_spaces: dict[str, Box] = {}
        self._action_spaces: dict[str, Box] = {}
        for agent, span in zip(self.possible_agents, episodes.spans[:count], strict=True):
            ahead = () if by_particle else (span.stop - span.start,)
            seen, done = (*ahead, worlds.perception_dim), (*ahead, worlds.physics.action_dim)
            self._observation_spaces[agent] = Box(-limit, limit, seen, np.float32)
            self._action_spaces[agent] = Box(-1.0, 1.0, done, np.float32)
        self._state_space = state_space(worlds.physics, worlds.particle_count)
        self.np_random: np.random.Generator | None = None
        self._screen = Screen(worlds, self.config, self.metadata["render_fps"])

    def close(self) -> None:
        """Close the window, if there is one."""
        self._screen.close()

    def _next_keys(self, seed: int | Sequence[int] | None, first: int | None) -> Tensor | None:
        """Return keys of all worlds' randomness where it begins anew, [B], or None to go on.

        The seed is what `reset` was given; the generator of later keys begins with the first one.
        """
        # After a first reset that was refused there are no worlds to go on with.
        if seed is None and self._started:
            return None
        self.np_random, _ = seeding.np_random(plain_seed(first))
        return rng_keys(seed, self.worlds.world_count, self.np_random)

    def _state(self) -> Tensor:
        if not self._started:
            raise NPAError("state needs a world: call reset first")
        state: Tensor = self.worlds.state()
        return state

    def _pictures(self) -> NDArray[np.uint8] | None:
        if not self._started:
            raise NPAError("render needs a world: call reset first")
        return self._screen.render()

    def _show(self) -> None:
        self._screen.show(f"{self.metadata['name']}: {self._task_name}")


def state_space(physics: Physics, particle_count: int) -> Box:
    """Return the space of [position ; state ; present] of N particles, [N, D + C + 1], float32."""
    places = [physics.limits.position] * physics.space_dim
    high = np.array([*places, *[physics.limits.state] * physics.state_dim, 1.0], np.float32)
    low = np.append(-high[:-1], np.float32(0.0))
    shape = (particle_count, 1)
    return Box(np.tile(low, shape), np.tile(high, shape), dtype=np.float32)


def joined_actions(
    actions: Any, agents: Sequence[str], shapes: Sequence[tuple[int, ...]], device: torch.device
) -> Tensor:
    """Return the actions of all live agents as rows, float32, shape [N, A] or [B, N, A]."""
    if not isinstance(actions, Mapping):
        raise NPAError(
            f"actions must be a dict with an action for each live agent, got "
            f"{type(actions).__name__}: see env.agents"
        )
    missing = [agent for agent in agents if agent not in actions]
    if missing:
        raise NPAError(
            f"actions must have one for each live agent, got none for {_names(missing)}: "
            "zeros leave an agent's particles as they are"
        )
    live = set(agents)
    extra = [str(agent) for agent in actions if agent not in live]
    if extra:
        raise NPAError(
            f"actions must be of live agents only, got one for {_names(extra)}: agents that ended "
            "get no more actions until reset; see env.agents"
        )
    rows = [
        action_tensor(
            f"actions[{shown(agent)}]", actions[agent], shape, f"env.action_space({shown(agent)})"
        )
        for agent, shape in zip(agents, shapes, strict=True)
    ]
    # What has one row only has no dimension for it.
    blocks = [row if row.ndim > 1 else row[None] for row in rows]
    joined = torch.cat([block.to(device) for block in blocks], dim=-2)
    if not bool(torch.isfinite(joined).all()):
        bad = next(k for k, row in enumerate(rows) if not bool(torch.isfinite(row).all()))
        wrong = rows[bad][~torch.isfinite(rows[bad])]
        raise DivergedError(
            f"actions[{shown(agents[bad])}] must be finite, got {wrong[0].item()} ({wrong.numel()} "
            "such "
            "numbers): check the policy; the world is as it was"
        )
    return joined


def _names(agents: Sequence[str]) -> str:
    some = ", ".join(agents[:3])
    return some if len(agents) <= 3 else f"{some} and {len(agents) - 3} more"
