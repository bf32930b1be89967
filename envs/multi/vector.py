"""Many worlds of several species, stepped as one batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import Space
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.vector import checked_count, checked_mode, worlds_to_reset
from npa_envs.envs.multi.agents_env import AgentsEnv, joined_actions
from npa_envs.envs.multi.species_worlds import AgentOutcome
from npa_envs.errors import NPAError
from npa_envs.world.cuda_graph import to_device_async

ByAgent = dict[str, Any]
"""An array for each species, whose first dimension is the world."""
Infos = dict[str, dict[str, Any]]
BatchOutcome = tuple[ByAgent, ByAgent, ByAgent, ByAgent, Infos]
"""What a step returns: observations, rewards, terminations, truncations, infos."""


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
    """

    _is_batch = True
    _of_particles = False
    """Whether agents are particles, with observations [B, P] and actions [B, A]."""

    def __init__(
        self,
        task: str = "mixing",
        *,
        world_count: int = 1,
        autoreset_mode: str | AutoresetMode = "same-step",
        **config: Any,
    ) -> None:
        self.num_envs = self.world_count = checked_count("world_count", world_count)
        """Worlds B; `num_envs` is the same number."""
        self.autoreset_mode = checked_mode(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            raise NPAError(
                "autoreset_mode must be 'same-step' or 'disabled' where several species share a "
                "world, got 'next-step': one of these"
            )
        super().__init__(task, config, self.world_count, by_particle=self._of_particles)
        self.agents = self.possible_agents
        """All agents, as every species always has arrays."""

    def __repr__(self) -> str:
        sizes = f"{self.world_count} worlds of {len(self.agents)} agents"
        return f"<{type(self).__name__} {self._task_name}: {sizes}, max_cycles={self.max_cycles}>"

    @cached_property
    def observation_spaces(self) -> dict[str, Space[Any]]:
        """Spaces of all worlds' observations, [B, N_k, P]; large, so made at the first use."""
        return self._batched(self.single_observation_spaces)

    @cached_property
    def action_spaces(self) -> dict[str, Space[Any]]:
        """Spaces of all worlds' actions, [B, N_k, A]; large, so made at the first use."""
        return self._batched(self.single_action_spaces)

    @cached_property
    def state_space(self) -> Space[Any]:
        """Space of all worlds' `state`, [B, N, 2 + C + 1]; large, so made at the first use."""
        return batch_space(self.single_state_space, self.world_count)

    def _batched(self, spaces: dict[str, Box]) -> dict[str, Space[Any]]:
        return {agent: batch_space(space, self.world_count) for agent, space in spaces.items()}

    def reset(
        self, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ByAgent, Infos]:
        """Start episodes as `NPAVectorEnv.reset` does; return all observations and infos."""
        chosen = worlds_to_reset(options, self.world_count, started=self._started)
        first = int(seed) if isinstance(seed, int | np.integer) else None
        observation, worlds = self._start(chosen, seed, first), self.worlds
        return self._rows(observation), self._infos(worlds.agent_returns.loss_infos(), worlds.live)

    def step(self, actions: Mapping[str, Any]) -> BatchOutcome:
        """Apply the actions of all species, [B, N_k, A] each; return a `BatchOutcome`.

        Rewards are float32. Errors are those of `CrowdEnv.step`.
        """
        self.check_begun("step needs worlds")
        worlds = self.worlds
        if not worlds.running.all():
            raise NPAError(
                f"the episodes of worlds {np.flatnonzero(~worlds.running).tolist()} are over: "
                "reset them with reset(options={'reset_mask': ...})"
            )
        shapes = [(self.world_count, *space.shape) for space in self.single_action_spaces.values()]
        with worlds.device_context():
            action = joined_actions(actions, self.possible_agents, shapes, worlds.device)
            if self._of_particles:
                # Joined agent by agent.
                action = action.view(-1, self.world_count, action.shape[-1]).transpose(0, 1)
            opponents = worlds.particle_count - action.shape[1]
            outcome = worlds.step(F.pad(action, (0, 0, 0, opponents)) if opponents else action)
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

    def _infos(self, numbers: dict[str, Tensor], acted: NDArray[np.bool_]) -> Infos:
        """Return all species' infos with their `numbers`, [B, M] each; 0 if not `acted`, [B, M]."""
        mask = to_device_async(acted, self.worlds.device)
        all_numbers = torch.stack(list(numbers.values())).float()
        rows = self._out(torch.where(mask, all_numbers, 0.0).movedim(2, 0).contiguous())
        live = self._columns(self.worlds.live)
        species = self.worlds.agent_species.tolist()
        return {
            agent: {"species": own, "live": live[agent]} | dict(zip(numbers, row, strict=True))
            for agent, own, row in zip(self.possible_agents, species, rows, strict=False)
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
        """Return each agent's observations, [B, N_k, P], from all particles' perception."""
        rows = self._out(observation)
        places = range(rows.shape[1]) if self._of_particles else self.worlds.spans
        return {a: rows[:, k] for a, k in zip(self.possible_agents, places, strict=False)}

    def _columns(self, values: Any) -> ByAgent:
        """Return each agent's column, [B], of `values`, [B, M]."""
        rows = self._out(values.T.contiguous() if isinstance(values, Tensor) else values.T.copy())
        return {agent: rows[k] for k, agent in enumerate(self.possible_agents)}
