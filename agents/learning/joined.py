"""Several species in one array of particles, with what learners know of vector environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from npa_envs.envs.core.vector import worlds_to_reset
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.world.actions import Physics

TIME_LIMIT, LEFT = "time limit", "left the world"
"""Why species are cut off, and why they end where they diverge."""


class JoinedWorlds(NamedTuple):
    """What policies and their evaluation ask of worlds."""

    physics: Physics
    """The worlds' constants."""

    perception_dim: int
    """Length P of an observation of a particle."""

    episode_steps: int
    """Steps after which an episode is cut off."""


class JoinedSpeciesEnv:
    """Worlds of several species whose particles stand one after the other: [B, N, P], [B, N, A].

    It has the interface of `NPAVectorEnv` as far as learners need it. A world is paid the mean of
    what its species are paid, and its loss is the mean of theirs; a species that ended keeps the
    loss that it had then. A world terminates where all of its species have ended by themselves. The
    reason is that of the first species that ended by itself, unless one left the world: then it is
    that.

    Every step's infos have, besides `final_obs` and `final_info` as elsewhere:

    | Key | Value |
    |---|---|
    | `loss` | before a restart, shape [B] |
    | `particle_reward` | what the species of each particle is paid, shape [B, N] |
    | `acted` | whether that species was alive: rows to leave out where not, bool, shape [B, N] |
    | `particle_terminated` | whether that species ended by itself now, bool, shape [B, N] |

    Args:
        task: A name from `npa_envs.envs.multi.TASKS`.
        num_envs: Worlds B.
        episode_steps: Steps after which an episode is cut off.
        device: Where the worlds live.
        keywords: Fields of the task's configuration.

    Raises:
        NPAError: As for `multispecies_v0.batched`.
    """

    def __init__(
        self,
        task: str,
        num_envs: int,
        episode_steps: int,
        device: str,
        keywords: Mapping[str, Any],
    ) -> None:
        self.species_env = MultiSpeciesVectorEnv(
            task,
            world_count=num_envs,
            max_cycles=episode_steps,
            device=device,
            output="torch",
            **keywords,
        )
        """The environment with an array for each species."""
        env = self.species_env
        self.num_envs = env.world_count
        """Worlds B."""
        self.config = env.config
        """Its configuration."""
        self.render_mode = env.render_mode
        """What `species_env.render()` returns."""
        self.task = env.worlds.task
        """Starts and losses."""
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.worlds = JoinedWorlds(env.worlds.physics, env.worlds.perception_dim, episode_steps)
        """The worlds' constants."""
        ends = accumulate(env.config.counts)
        spans = [slice(end - n, end) for end, n in zip(ends, env.config.counts, strict=True)]
        self.spans = dict(zip(env.agents, spans, strict=True))
        """Where each species' particles stand."""
        self.single_observation_space = _joined_space(env.single_observation_spaces)
        """Space of one world's observations, shape [N, P]."""
        self.single_action_space = _joined_space(env.single_action_spaces)
        """Space of one world's actions, shape [N, A]."""
        self._loss = torch.zeros(self.num_envs, len(spans), device=device)
        self._reasons = np.full(self.num_envs, None, dtype=object)

    @property
    def unwrapped(self) -> JoinedSpeciesEnv:
        """The environment itself."""
        return self

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start episodes; arguments and errors of `MultiSpeciesVectorEnv.reset`.

        Args:
            seed: Of the worlds' sequences of episodes.
            options: `{"reset_mask": mask}` resets only some worlds.

        Returns:
            Observations, shape [B, N, P], and infos with `loss`.
        """
        rows, infos = self.species_env.reset(seed, options)
        self._reasons[worlds_to_reset(options, self.num_envs)] = None
        self._loss = self._stacked(infos, "loss")
        return self._joined(rows), {"loss": self._loss.mean(dim=1)}

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply an action to each particle, and perceive.

        Args:
            actions: Shape [B, N, A], in [-1, 1].

        Returns:
            Observations [B, N, P], rewards [B], terminations [B], truncations [B], and infos.

        Raises:
            NPAError: The actions have another shape; the worlds are then as they were.
            DivergedError: An action is not finite; the worlds are then as they were.
        """
        by_species = {agent: actions[:, span] for agent, span in self.spans.items()}
        rows, rewards, terminations, truncations, infos = self.species_env.step(by_species)
        acted = self._stacked(infos, "acted")
        self._loss = torch.where(acted, self._stacked(infos, "loss"), self._loss)
        paid = torch.stack(list(rewards.values()), dim=1)
        told: dict[str, Any] = {
            "loss": self._loss.mean(dim=1),
            "particle_reward": self._by_particle(paid),
            "acted": self._by_particle(acted),
            "particle_terminated": self._by_particle(torch.stack(list(terminations.values()), 1)),
        }
        late = torch.stack(list(truncations.values()), dim=1).any(dim=1)
        self._remember_reasons(infos)
        first = infos[self.species_env.agents[0]]
        over = first.get("_final_obs", torch.zeros_like(late))
        if "final_obs" in first:
            last = {agent: infos[agent]["final_obs"] for agent in self.spans}
            told |= {"final_obs": self._joined(last), "_final_obs": over}
            which = over.cpu().numpy()
            reasons = self._reasons.copy()
            reasons[~which] = None
            self._reasons[which] = None
            told["final_info"] = {"loss": told["loss"], "_loss": over, "reason": reasons}
            told["_final_info"] = over
        return self._joined(rows), paid.mean(dim=1), over & ~late, over & late, told

    def close(self) -> None:
        """Close the window, if there is one."""
        self.species_env.close()

    def _joined(self, rows: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([rows[agent] for agent in self.spans], dim=1)

    def _stacked(self, infos: Mapping[str, Mapping[str, Any]], name: str) -> Tensor:
        """Return what infos say of each species, shape [B, K]."""
        return torch.stack([infos[agent][name] for agent in self.spans], dim=1)

    def _by_particle(self, values: Tensor) -> Tensor:
        """Return what holds for species, [B, K], for each of their particles, shape [B, N]."""
        parts = [
            values[:, k : k + 1].expand(-1, span.stop - span.start)
            for k, span in enumerate(self.spans.values())
        ]
        return torch.cat(parts, dim=1)

    def _remember_reasons(self, infos: Mapping[str, Mapping[str, Any]]) -> None:
        """Keep why the first species of each world ended; that one left is told before all else."""
        for agent in self.spans:
            own = infos[agent].get("reason")
            if own is not None:
                told = own != None  # noqa: E711
                held = (self._reasons != None) & (self._reasons != TIME_LIMIT)  # noqa: E711
                self._reasons = np.where((told & ~held) | (own == LEFT), own, self._reasons)


def _joined_space(spaces: Mapping[str, Any]) -> Box:
    """Return the space of all species' particles, one after the other."""
    low, high = (
        np.concatenate([getattr(space, bound) for space in spaces.values()])
        for bound in ("low", "high")
    )
    return Box(low, high, dtype=np.float32)
