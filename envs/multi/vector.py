"""Many worlds of several species, batched on the device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import Space
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.vector import checked_count, checked_mode, worlds_to_reset
from npa_envs.envs.multi.agents import AgentsEnv, joined_actions
from npa_envs.envs.multi.worlds import AgentOutcome
from npa_envs.errors import NPAError
from npa_envs.world.cuda_graph import to_device_async

ByAgent = dict[str, Any]
"""An array for each species, whose first dimension is the world."""
Infos = dict[str, dict[str, Any]]
BatchOutcome = tuple[ByAgent, ByAgent, ByAgent, ByAgent, Infos]
"""What a step returns: observations, rewards, terminations, truncations, infos."""


class MultiSpeciesVectorEnv(AgentsEnv):
    """B worlds of several species, stepped together: `MultiSpeciesEnv`, batched on the device.

    World k, reset with `seed`, is the single environment reset with `seed + k`, bit for bit,
    whatever becomes of the others. Dicts have an entry for every species at all times, with the
    world first: observations [B, N_k, P], actions [B, N_k, A], rewards, terminations and
    truncations [B].

    A species that ends in one world is terminated there, and nowhere else. From then on, until the
    world's next episode, its observations and rewards there are zeros, its actions are not read
    (but must be finite), and `infos[species]["live"]` is False. A world's episode is over once none
    of its species is left, or `max_cycles` steps are done.

    | Key of `infos[species]` | In | Value, shape [B] but where said |
    |---|---|---|
    | `species` | reset, step | its number |
    | `live` | reset, step | whether it is to act next |
    | `acted` | step | whether it was alive in this step: what to leave out when training |
    | `loss`, `loss_...`, `reward_...` | as single | after the step, before a restart; else 0 |
    | `reason` | a step in which it ended in a world | why, None where it did not |
    | `final_obs` | a step in which a world restarted | the last observations, [B, N_k, P] |
    | `_final_obs` | likewise | which worlds restarted |

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
        """The same: every species gets and gives arrays at all times."""
        self.single_observation_spaces = self._observation_spaces
        self.single_action_spaces = self._action_spaces
        self.single_state_space = self._state_space
        """Space of one world's `state`: float32, shape [N, 2 + C + 1]."""

    @cached_property
    def observation_spaces(self) -> dict[str, Space[Any]]:
        """Each species' observations in all worlds, [B, N_k, P]; large, so made when asked for."""
        spaces = self.single_observation_spaces
        return {agent: batch_space(space, self.world_count) for agent, space in spaces.items()}

    @cached_property
    def action_spaces(self) -> dict[str, Space[Any]]:
        """Each species' actions in all worlds, [B, N_k, A]; large, so made when asked for."""
        spaces = self.single_action_spaces
        return {agent: batch_space(space, self.world_count) for agent, space in spaces.items()}

    def reset(
        self, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ByAgent, Infos]:
        """Start episodes with all species.

        Args:
            seed: Begin the sequences of episodes of seed, seed + 1, ..., or of the seeds in a list;
                without it the sequences go on.
            options: `{"reset_mask": mask}` resets only the worlds where the mask, bool, shape [B],
                is True; the others are left as they are, bit for bit.

        Returns:
            Observations of all worlds, and infos: losses with their parts, and who is live.

        Raises:
            NPAError: The mask or the seeds have a wrong shape.
        """
        chosen = worlds_to_reset(options, self.world_count)
        if not self._started and len(chosen) < self.world_count:
            raise NPAError("reset_mask needs worlds to leave alone: reset all of them first")
        keys = self._next_keys(seed, int(seed) if isinstance(seed, int | np.integer) else None)
        keys = None if keys is None else keys[chosen]
        with self.worlds.device_context():
            observation = self._episodes.start(chosen, keys)
            if len(chosen) < self.world_count:
                observation = self.worlds.perceived()
        self._started = True
        self._show()
        live = self._episodes.live
        return self._rows(observation), self._infos(self._episodes.account.numbers(), live)

    def step(self, actions: Mapping[str, Any]) -> BatchOutcome:
        """Apply every species' actions in all worlds, and perceive.

        Args:
            actions: For each species, shape [B, N_k, A], in [-1, 1].

        Returns:
            Observations, rewards (float32), whether a species' episode ended by itself in this
            step, whether it was cut off, and infos.

        Raises:
            NPAError: An action is missing, not wanted or of another shape, or the episode of a
                world that is not reset by itself is over; the worlds are then as they were.
            DivergedError: An action is not finite, and the worlds are as they were; or an agent is
                out of bounds, and `on_divergence` is "raise".
        """
        if not self._started:
            raise NPAError("step needs worlds: call reset first")
        worlds = self.worlds
        if not worlds.open.all():
            raise NPAError(
                f"the episodes of worlds {np.flatnonzero(~worlds.open).tolist()} are over: reset "
                "them with reset(options={'reset_mask': ...})"
            )
        shapes = [(self.world_count, *space.shape) for space in self.single_action_spaces.values()]
        with worlds.device_context():
            action = joined_actions(actions, self.possible_agents, shapes, worlds.device)
            rest = worlds.particle_count - action.shape[1]
            outcome = self._episodes.step(F.pad(action, (0, 0, 0, rest)) if rest else action)
            observation, final = outcome.observation, None
            over = np.flatnonzero(~worlds.open)
            if len(over) and self.autoreset_mode is AutoresetMode.SAME_STEP:
                final = self._rows(observation), over
                seen = self._episodes.start(over)
                observation = observation.index_copy(0, to_device_async(over, worlds.device), seen)
        self._show()
        return (
            self._rows(observation),
            self._columns(outcome.rewards.float()),
            self._columns(self._sent(outcome.endings > 0)),
            self._columns(self._sent(outcome.acted & outcome.late[:, None])),
            self._step_infos(outcome, final),
        )

    def state(self) -> Any:
        """Return what there is to know of the worlds, for central critics.

        Returns:
            For each world a row [position ; state ; 1] for each particle that an episode starts
            with, zeros for those that are gone, shape [B, N, 2 + C + 1].
        """
        return self._out(self._state())

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each world, shape [R, R, 3], in the mode "rgb_array"."""
        pictures = self._pictures()
        return None if pictures is None else tuple(pictures)

    def _infos(self, numbers: dict[str, Tensor], acted: NDArray[np.bool_]) -> Infos:
        """Return numbers of species that acted, 0 of the others, and who is live now."""
        own = to_device_async(acted, self.worlds.device)
        everyone = torch.stack(list(numbers.values())).float()
        rows = self._out(torch.where(own, everyone, 0.0).movedim(2, 0).contiguous())
        live = self._columns(self._sent(self._episodes.live.copy()))
        return {
            agent: {"species": k, "live": live[agent]} | dict(zip(numbers, rows[k], strict=True))
            for k, agent in enumerate(self.possible_agents)
        }

    def _step_infos(
        self, outcome: AgentOutcome, final: tuple[ByAgent, NDArray[np.int64]] | None
    ) -> Infos:
        infos = self._infos(outcome.numbers, outcome.acted)
        acted = self._columns(self._sent(outcome.acted))
        reasons = outcome.reasons
        for k, agent in enumerate(self.possible_agents):
            infos[agent]["acted"] = acted[agent]
            if reasons[:, k].any():
                infos[agent]["reason"] = reasons[:, k]
        if final is not None:
            which = np.zeros(self.world_count, dtype=bool)
            which[final[1]] = True
            restarted = self._out(self._sent(which))
            for agent, rows in final[0].items():
                infos[agent] |= {"final_obs": rows, "_final_obs": restarted}
        return infos

    def _rows(self, observation: Tensor) -> ByAgent:
        """Return what particles perceive, [B, N, P], agent by agent."""
        rows, spans = self._out(observation), self._episodes.spans
        return {agent: rows[:, spans[k]] for k, agent in enumerate(self.possible_agents)}

    def _columns(self, values: Tensor) -> ByAgent:
        """Return values of shape [B, K] agent by agent, shape [B] each."""
        columns = self._out(values.T.contiguous())
        return {agent: columns[k] for k, agent in enumerate(self.possible_agents)}

    def _sent(self, values: NDArray[Any]) -> Tensor:
        """Return an array where results are wanted: on the device, or not."""
        return (
            to_device_async(values, self.worlds.device)
            if self.config.output == "torch"
            else torch.from_numpy(values)
        )
