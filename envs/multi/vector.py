"""Base class of environments of agents, and many worlds of several species as one batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import Space
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.base import ShownEnv, action_tensor
from npa_envs.envs.core.config import plain
from npa_envs.envs.core.vector import (
    checked_count,
    checked_mode,
    rng_keys,
    worlds_to_reset,
)
from npa_envs.envs.multi.species_worlds import AgentOutcome, SpeciesWorlds
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.world.cuda_graph import to_device_async

ByAgent = dict[str, Any]
"""An array for each species, whose first dimension is the world."""
Infos = dict[str, dict[str, Any]]
BatchOutcome = tuple[ByAgent, ByAgent, ByAgent, ByAgent, Infos]
"""What a step returns: observations, rewards, terminations, truncations, infos."""


class AgentsEnv(ShownEnv):
    """Base class of environments with several agents, of one world or many."""

    metadata: Any = {  # noqa: RUF012 (nobody writes to it)
        "name": "npa_multispecies_v0",
        "render_modes": ["rgb_array", "human"],
        "render_fps": 25,
        "is_parallelizable": True,
    }

    def __init__(
        self, task: str, keywords: dict[str, Any], world_count: int, *, by_particle: bool
    ) -> None:
        self.worlds = worlds = SpeciesWorlds(task, keywords, world_count, by_particle=by_particle)
        """The batch of worlds."""
        self._task_name = task
        self.config = worlds.config
        self.render_mode = self.config.render_mode
        self.max_cycles = self.config.max_cycles
        """Steps after which an episode is truncated for all agents."""
        played = self.config.agent_particle_counts
        word, count = ("particle", sum(played)) if by_particle else ("species", len(played))
        self.possible_agents = [f"{word}_{k}" for k in range(count)]
        """Names of the agents."""
        physics, limits = worlds.physics, worlds.physics.limits
        self._observation_spaces: dict[str, Box] = {}
        self._action_spaces: dict[str, Box] = {}
        for agent, span in zip(self.possible_agents, worlds.spans[:count], strict=True):
            rows = () if by_particle else (span.stop - span.start,)
            limit, observed = limits.perception, (*rows, worlds.perception_dim)
            self._observation_spaces[agent] = Box(-limit, limit, observed, np.float32)
            self._action_spaces[agent] = Box(-1.0, 1.0, (*rows, physics.action_dim), np.float32)
        # Position, state, present.
        high = [limits.position] * physics.space_dim + [limits.state] * physics.state_dim
        upper = np.tile(np.array([*high, 1.0], np.float32), (worlds.particle_count, 1))
        self._state_space = Box(upper * np.array([-1.0] * len(high) + [0.0], np.float32), upper)
        self.np_random: np.random.Generator | None = None

    def _start(self, worlds: NDArray[np.int64], seed: Any, key_seed: Any) -> Tensor:
        """Start episodes in worlds, indices [M]; return all worlds' perception, [B, N, P].

        `seed` is that of `reset`; `key_seed` seeds `np_random`, which draws keys without a seed.
        """
        keys, batch = None, self.worlds
        # The first reset may have failed, so that there are no sequences of episodes yet.
        if seed is not None or not self._started:
            self.np_random, _ = seeding.np_random(plain(key_seed))
            keys = rng_keys(seed, batch.world_count, self.np_random)[worlds]
        with batch.device_context():
            observation: Tensor = batch.start(worlds, keys)
            if len(worlds) < batch.world_count:
                observation = batch.perception()
        self._started = True
        self._show()
        return observation

    def _state(self) -> Tensor:
        if not self._started:
            raise NPAError("state needs a world: call reset first")
        state: Tensor = self.worlds.state()
        return state

    def _pictures(self) -> NDArray[np.uint8] | None:
        if not self._started:
            raise NPAError("render needs a world: call reset first")
        return super()._pictures()

    def _show(self) -> None:
        self._show_in_window(f"{self.metadata['name']}: {self._task_name}")


class MultiSpeciesVectorEnv(AgentsEnv):
    """B worlds of several species, stepped together: `MultiSpeciesEnv`, batched on the device.

    World k, reset with `seed`, is the single environment reset with `seed + k`, bit for bit. Dicts
    always have an entry for every species, whose first dimension is the world: observations
    [B, N_k, P], actions [B, N_k, A], rewards, terminations and truncations [B].

    A species that ends in one world is terminated only there. Until that world's next episode its
    observations and rewards there are zeros, its actions are ignored (but must be finite), and
    `infos[species]["live"]` is False. A world's episode is over once none of its species is left,
    or after `max_cycles` steps.

    | Key of `infos[species]` | In | Value, of shape [B] unless given |
    |---|---|---|
    | `species` | reset, step | its index |
    | `live` | reset, step | whether it acts in the next step |
    | `acted` | step | whether it acted in this step; mask the others when training |
    | `loss`, `loss_...`, `reward_...` | as single | after the step, before a restart; else 0 |
    | `reason` | a step in which it ended in a world | why, None for the other worlds |
    | `final_obs` | a step in which a world restarted | the last observations, [B, N_k, P] |
    | `_final_obs` | a step in which a world restarted | whether each world restarted |

    Args:
        task: A name from `npa_envs.envs.multi.TASKS`.
        world_count: Worlds B.
        autoreset_mode: "same-step": the step that ends a world's episode returns the next one's
            first observation, and the last one is in `infos[species]["final_obs"]`; "disabled":
            `reset(options={"reset_mask": ...})` starts it.
        config: Fields of the task's configuration.

    Raises:
        NPAError: A name is unknown, a value wrong, or the worlds do not fit into memory.
    """

    def __init__(
        self,
        task: str = "mixing",
        *,
        world_count: int = 1,
        autoreset_mode: str | AutoresetMode = "same-step",
        **config: Any,
    ) -> None:
        self.world_count = checked_count("world_count", world_count)
        """Worlds B."""
        self.autoreset_mode = checked_mode(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            raise NPAError(
                "autoreset_mode must be 'same-step' or 'disabled' where several species share a "
                "world, got 'next-step': one of these"
            )
        super().__init__(task, config, self.world_count, by_particle=False)
        self.agents = self.possible_agents
        """All agents, as every species always has arrays."""
        self.single_observation_spaces = self._observation_spaces
        self.single_action_spaces = self._action_spaces
        self.single_state_space = self._state_space
        """Space of one world's `state`: float32, shape [N, 2 + C + 1]."""

    @cached_property
    def observation_spaces(self) -> dict[str, Space[Any]]:
        """Spaces of all worlds' observations, [B, N_k, P]; large, so made at the first use."""
        return self._batched(self.single_observation_spaces)

    @cached_property
    def action_spaces(self) -> dict[str, Space[Any]]:
        """Spaces of all worlds' actions, [B, N_k, A]; large, so made at the first use."""
        return self._batched(self.single_action_spaces)

    def _batched(self, spaces: dict[str, Box]) -> dict[str, Space[Any]]:
        return {agent: batch_space(space, self.world_count) for agent, space in spaces.items()}

    def reset(
        self, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ByAgent, Infos]:
        """Start episodes with all species; return observations and infos of all worlds.

        Arguments are those of `NPAVectorEnv.reset`.
        """
        chosen = worlds_to_reset(options, self.world_count, started=self._started)
        first = int(seed) if isinstance(seed, int | np.integer) else None
        observation, worlds = self._start(chosen, seed, first), self.worlds
        return self._rows(observation), self._infos(worlds.agent_returns.loss_infos(), worlds.live)

    def step(self, actions: Mapping[str, Any]) -> BatchOutcome:
        """Apply every species' actions, shape [B, N_k, A], in [-1, 1], in all worlds.

        Returns:
            Observations, rewards (float32), terminations, truncations and infos.

        Raises:
            NPAError: An action is missing, superfluous or of another shape, or with
                autoreset_mode="disabled" a world's episode is over; the worlds are not changed.
            DivergedError: An action is not finite, and the worlds are not changed; or an agent is
                out of bounds, and `on_divergence` is "raise".
        """
        if not self._started:
            raise NPAError("step needs worlds: call reset first")
        worlds = self.worlds
        if not worlds.running.all():
            raise NPAError(
                f"the episodes of worlds {np.flatnonzero(~worlds.running).tolist()} are over: "
                "reset them with reset(options={'reset_mask': ...})"
            )
        shapes = [(self.world_count, *space.shape) for space in self.single_action_spaces.values()]
        with worlds.device_context():
            action = joined_actions(actions, self.possible_agents, shapes, worlds.device)
            rest = worlds.particle_count - action.shape[1]
            outcome = worlds.step(F.pad(action, (0, 0, 0, rest)) if rest else action)
            observation, final = outcome.observation, None
            over = np.flatnonzero(~worlds.running)
            if len(over) and self.autoreset_mode is AutoresetMode.SAME_STEP:
                final = self._rows(observation), over
                first, index = worlds.start(over), to_device_async(over, worlds.device)
                observation = observation.index_copy(0, index, first)
        self._show()
        return (
            self._rows(observation),
            self._columns(outcome.rewards.float()),
            self._columns(outcome.endings > 0),
            self._columns(outcome.acted & outcome.truncated[:, None]),
            self._step_infos(outcome, final),
        )

    def state(self) -> Any:
        """Return the full state of the worlds, for central critics, [B, N, 2 + C + 1]."""
        return self._out(self._state())

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each world, shape [R, R, 3], with the render mode "rgb_array"."""
        pictures = self._pictures()
        return None if pictures is None else tuple(pictures)

    def _infos(self, numbers: dict[str, Tensor], acted: NDArray[np.bool_]) -> Infos:
        """Return the infos of all species: `numbers`, [B, A] each, 0 where not `acted`, [B, A]."""
        mask = to_device_async(acted, self.worlds.device)
        all_numbers = torch.stack(list(numbers.values())).float()
        rows = self._out(torch.where(mask, all_numbers, 0.0).movedim(2, 0).contiguous())
        live = self._columns(self.worlds.live)
        return {
            agent: {"species": k, "live": live[agent]} | dict(zip(numbers, rows[k], strict=True))
            for k, agent in enumerate(self.possible_agents)
        }

    def _step_infos(
        self, outcome: AgentOutcome, final: tuple[ByAgent, NDArray[np.int64]] | None
    ) -> Infos:
        infos = self._infos(outcome.numbers, outcome.acted)
        acted = self._columns(outcome.acted)
        reasons = outcome.reasons
        for k, agent in enumerate(self.possible_agents):
            infos[agent]["acted"] = acted[agent]
            if reasons[:, k].any():
                infos[agent]["reason"] = reasons[:, k]
        if final is not None:
            which = np.zeros(self.world_count, dtype=bool)
            which[final[1]] = True
            restarted = self._out(which)
            for agent, rows in final[0].items():
                infos[agent] |= {"final_obs": rows, "_final_obs": restarted}
        return infos

    def _rows(self, observation: Tensor) -> ByAgent:
        """Split what particles perceive, [B, N, P], by agent."""
        rows, spans = self._out(observation), self.worlds.spans
        return {agent: rows[:, spans[k]] for k, agent in enumerate(self.possible_agents)}

    def _columns(self, values: Any) -> ByAgent:
        """Split values, [B, A], by agent, shape [B] each."""
        rows = values.T.contiguous() if isinstance(values, Tensor) else values.T.copy()
        columns = self._out(rows)
        return {agent: columns[k] for k, agent in enumerate(self.possible_agents)}


def joined_actions(
    actions: Any, agents: Sequence[str], shapes: Sequence[tuple[int, ...]], device: torch.device
) -> Tensor:
    """Return the checked actions of `agents`, joined by rows, float32, [N, A] or [B, N, A]."""
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


def _names(agents: Sequence[str]) -> str:
    some = ", ".join(agents[:3])
    return some if len(agents) <= 3 else f"{some} and {len(agents) - 3} more"
