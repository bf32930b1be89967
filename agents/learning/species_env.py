"""Worlds of several species as learners need them: all particles' rows in one tensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from npa_envs.agents.evaluation import TIME_LIMIT
from npa_envs.agents.policies import spans_of
from npa_envs.envs.core.vector import worlds_to_reset
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.world.cuda_graph import to_device_async

LEFT_WORLD = "left the world"
"""Reason why the episode of a species ended that diverged."""


class ConcatenatedSpeciesEnv(MultiSpeciesVectorEnv):
    """Worlds of several species as one agent, with observations [B, N, P] and actions [B, N, A].

    It has the attributes of `NPAVectorEnv` that learners need. Reward and loss of a world are means
    over its species; a species that ended keeps its last loss. A world terminates once all of its
    species have; its reason is that of the first one, or "left the world" if any diverged. Infos of
    a step have for each particle, [B, N]: `particle_reward`, the reward of its species; `acted`,
    whether its species had not ended before; `particle_terminated`, whether it terminates now.
    """

    def __init__(self, task: str, **config: Any) -> None:
        super().__init__(task, **config)
        self.num_envs, self.episode_steps = self.world_count, self.max_cycles
        self.task, physics = self.worlds.task, self.worlds.physics
        self.metadata = self.metadata | {"autoreset_mode": AutoresetMode.SAME_STEP}
        counts, interface = self.config.agent_particle_counts, self.config.interface(physics)
        self.spans = dict(zip(self.agents, spans_of(counts), strict=True))
        limit, observed = physics.limits.perception, (sum(counts), interface.perception_dim)
        self.single_observation_space = Box(-limit, limit, observed, np.float32)
        acted = sum(counts), interface.action_dim
        self.single_action_space = Box(-1.0, 1.0, acted, np.float32)
        self._counts = torch.tensor(counts, device=self.worlds.device)
        self._loss = torch.zeros(self.num_envs, len(counts), device=self.worlds.device)
        self._reasons = np.full(self.num_envs, None, dtype=object)

    @property
    def unwrapped(self) -> ConcatenatedSpeciesEnv:
        """The environment itself."""
        return self

    def reset(  # type: ignore[override]
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start episodes as `MultiSpeciesVectorEnv.reset` does; infos have `loss`, [B]."""
        observations, infos = super().reset(seed, options)
        chosen = worlds_to_reset(options, self.num_envs)
        self._reasons[chosen] = None
        # In worlds that are not reset, infos have no loss of species that ended.
        losses, index = self._stacked(infos, "loss"), to_device_async(chosen, self._loss.device)
        self._loss = self._loss.index_copy(0, index, losses[index])
        return self._concatenated(observations), {"loss": self._loss.mean(dim=1)}

    def step(  # type: ignore[override]
        self, actions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply actions in [-1, 1], [B, N, A]; return observations, rewards, flags and infos."""
        by_species = {agent: actions[:, span] for agent, span in self.spans.items()}
        observations, *results, infos = super().step(by_species)
        rewards, terminated, truncated = (
            torch.stack([result[agent] for agent in self.agents], dim=1) for result in results
        )
        acted = self._stacked(infos, "acted")
        self._loss = torch.where(acted, self._stacked(infos, "loss"), self._loss)
        info: dict[str, Any] = {
            "loss": self._loss.mean(dim=1),
            "particle_reward": self._by_particle(rewards),
            "acted": self._by_particle(acted),
            "particle_terminated": self._by_particle(terminated),
        }
        self._update_reasons(infos)
        cut, first = truncated.any(dim=1), infos[self.agents[0]]
        over = first.get("_final_obs", torch.zeros_like(cut))
        if "final_obs" in first:
            last = {agent: infos[agent]["final_obs"] for agent in self.agents}
            ended = over.cpu().numpy()
            reasons = self._reasons.copy()
            reasons[~ended] = self._reasons[ended] = None
            final = {"loss": info["loss"], "_loss": over, "reason": reasons}
            info |= {"final_obs": self._concatenated(last), "_final_obs": over}
            info |= {"final_info": final, "_final_info": over}
        observation, reward = self._concatenated(observations), rewards.mean(dim=1)
        return observation, reward, over & ~cut, over & cut, info

    def _update_reasons(self, infos: Mapping[str, Mapping[str, Any]]) -> None:
        """Store why each world ends: the first reason of a species, or "left the world" of any."""
        for agent in self.agents:
            reasons = infos[agent].get("reason")
            if reasons is not None:
                new = reasons != None  # noqa: E711
                known = (self._reasons != None) & (self._reasons != TIME_LIMIT)  # noqa: E711
                replaced = (new & ~known) | (reasons == LEFT_WORLD)
                self._reasons = np.where(replaced, reasons, self._reasons)

    def _concatenated(self, values: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([values[agent] for agent in self.agents], dim=1)

    def _stacked(self, infos: Mapping[str, Mapping[str, Any]], name: str) -> Tensor:
        return torch.stack([infos[agent][name] for agent in self.agents], dim=1)

    def _by_particle(self, values: Tensor) -> Tensor:
        """Repeat the values of species, [B, species], for each of their particles, [B, N]."""
        count = self.single_action_space.shape[0]
        return values.repeat_interleave(self._counts, dim=1, output_size=count)
