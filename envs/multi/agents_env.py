"""Base class of environments with several agents, in one world or many; checks of actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.base import ShownEnv, action_tensor
from npa_envs.envs.core.config import as_python
from npa_envs.envs.core.vector import rng_keys
from npa_envs.envs.multi.species_worlds import SpeciesWorlds
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.world.environment_steps import Physics


class AgentsEnv(ShownEnv):
    """Base class of environments with several agents: species, or particles with `by_particle`."""

    metadata = ShownEnv.metadata | {"name": "npa_multispecies_v0", "is_parallelizable": True}
    worlds: SpeciesWorlds

    def __init__(
        self, task: str, keywords: dict[str, Any], world_count: int, *, by_particle: bool
    ) -> None:
        self.worlds = worlds = SpeciesWorlds(task, keywords, world_count, by_particle=by_particle)
        self._task_name, self.config = task, worlds.config
        self.render_mode, self.max_cycles = worlds.config.render_mode, worlds.config.max_cycles
        """Steps after which an episode is truncated for all agents."""
        played = self.config.agent_particle_counts
        word, count = ("particle", sum(played)) if by_particle else ("species", len(played))
        self.possible_agents = [f"{word}_{k}" for k in range(count)]
        """Names of the agents."""
        physics, limits = worlds.physics, worlds.physics.limits
        self.single_observation_spaces: dict[str, Box] = {}
        self.single_action_spaces: dict[str, Box] = {}
        for agent, span in zip(self.possible_agents, worlds.spans[:count], strict=True):
            rows = () if by_particle else (span.stop - span.start,)
            limit, observed = limits.perception, (*rows, worlds.perception_dim)
            self.single_observation_spaces[agent] = Box(-limit, limit, observed, np.float32)
            self.single_action_spaces[agent] = Box(
                -1.0, 1.0, (*rows, physics.action_dim), np.float32
            )
        self.single_state_space = state_space(physics, worlds.particle_count)
        """Space of one world's `state`: float32, shape [N, 2 + C + 1]."""
        self.np_random: np.random.Generator | None = None

    def _start(self, worlds: NDArray[np.int64], seed: Any, key_seed: Any) -> Tensor:
        """Start episodes in worlds, int64 [B']; return all worlds' perception, [B, N, P].

        `seed` is that of `reset`; where it gives none, streams begin at seeds from `key_seed`.
        """
        keys, batch = None, self.worlds
        # The first reset may have failed, so that there are no sequences of episodes yet.
        if seed is not None or not self._started:
            self.np_random, _ = seeding.np_random(as_python(key_seed))
            keys = rng_keys(seed, batch.world_count, self.np_random)[worlds]
        with batch.device_context():
            observation = batch.start(worlds, keys)
            if len(worlds) < batch.world_count:
                observation = batch.perception()
        self._started = True
        self._show()
        return observation

    def _state(self) -> Tensor:
        self.check_begun("state needs a world")
        return self.worlds.state()

    def _show(self) -> None:
        self._show_in_window(f"{self.metadata['name']}: {self._task_name}")


def state_space(physics: Physics, particle_count: int) -> Box:
    """Return the space of a world's `state`: a row [position; state; 1] for each particle."""
    limits = physics.limits
    high = [limits.position] * physics.space_dim + [limits.state] * physics.state_dim
    upper = np.tile(np.array([*high, 1.0], np.float32), (particle_count, 1))
    return Box(upper * np.array([-1.0] * len(high) + [0.0], np.float32), upper)


def joined_actions(
    actions: Any, agents: Sequence[str], shapes: Sequence[tuple[int, ...]], device: torch.device
) -> Tensor:
    """Return the actions of `agents`, of these shapes, as rows of one tensor, [N, A] or [B, N, A].

    Actions must be finite, and given for exactly these agents.
    """
    at_once = _joined_at_once(actions, agents, shapes, device)
    if at_once is not None:
        return at_once
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
            f"actions must be of live agents only, got one for {_names(extra)}: see env.agents"
        )
    rows = [
        action_tensor(
            f"actions[{shown(agent)}]", actions[agent], shape, f"env.action_space({shown(agent)})"
        )
        for agent, shape in zip(agents, shapes, strict=True)
    ]
    # The action of a single particle has no dimension of rows.
    blocks = [row if row.ndim > 1 else row[None] for row in rows]
    joined = torch.cat([block.to(device) for block in blocks], dim=-2)
    if not bool(torch.isfinite(joined).all()):
        bad = next(k for k, row in enumerate(rows) if not bool(torch.isfinite(row).all()))
        wrong = rows[bad][~torch.isfinite(rows[bad])]
        raise DivergedError(
            f"actions[{shown(agents[bad])}] must be finite, got {wrong[0].item()} ({wrong.numel()} "
            "such numbers): check the policy; the world is not changed"
        )
    return joined


def _joined_at_once(
    actions: Any, agents: Sequence[str], shapes: Sequence[tuple[int, ...]], device: torch.device
) -> Tensor | None:
    """Return the result of `joined_actions` for NumPy arrays, whose checks are of all together.

    None: actions have to be looked at one by one, to be converted or to find which one is wrong.
    """
    if type(actions) is not dict or actions.keys() != set(agents):
        return None
    rows = [actions[agent] for agent in agents]
    alike = {type(row) for row in rows} == {np.ndarray} and [row.shape for row in rows] == shapes
    if not alike or not {row.dtype for row in rows} <= {np.dtype("f4"), np.dtype("f8")}:
        return None
    joined = np.concatenate(rows, -min(rows[0].ndim, 2), dtype=np.float32)
    if not np.isfinite(joined).all():
        return None
    # The action of a single particle has no dimension of rows.
    return torch.from_numpy(joined.reshape(*joined.shape[:-2], -1, shapes[0][-1])).to(device)


def _names(agents: Sequence[str]) -> str:
    some = ", ".join(agents[:3])
    return some if len(agents) <= 3 else f"{some} and {len(agents) - 3} more"
