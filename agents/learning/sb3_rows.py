"""Stable-Baselines3's PPO over particles: each is a row with a likelihood of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.agents.learning.critics import Critic, CriticKind
from npa_envs.agents.learning.gaussian import gaussian_log_prob
from npa_envs.agents.learning.joined import JoinedSpeciesEnv
from npa_envs.agents.learning.options import takes_fields_of
from npa_envs.agents.learning.ppo_settings import check_words
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.agents.learning.sb3_common import (
    BootstrappedRows,
    SB3Settings,
    learn,
)
from npa_envs.agents.learning.sb3_imports import VecEnvWrapper
from npa_envs.agents.learning.sb3_policy import RuleActorCritic
from npa_envs.errors import NPAError
from npa_envs.wrappers.sb3 import ParticleVecEnv, RowVecEnv, SpeciesVecEnv


@dataclass(frozen=True, kw_only=True)
class RowSettings(SB3Settings):
    """Options of `train`."""

    credit: Literal["world", "particle"] | None = None
    """Each particle is paid what its "world" is, or its own share ("particle"). Where several
    species share a world each is paid what its species is, and "world" is not on offer. None: what
    there is."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: One lies outside its range.
        """
        super().__post_init__()
        if self.credit is not None:
            check_words(self, "credit")


class WorldMeans(VecEnvWrapper):
    """Rows that see what their world perceives in the mean, behind what they see themselves.

    A central critic needs it there: Stable-Baselines3 shuffles rows, so that a minibatch does not
    hold the worlds that its rows come from. The actor does not read it.

    Args:
        venv: Rows, those of a world one after the other.
    """

    def __init__(self, venv: RowVecEnv) -> None:
        space = venv.observation_space
        assert isinstance(space, Box), "rows see boxes"
        low, high = np.tile(space.low, 2), np.tile(space.high, 2)
        super().__init__(venv, Box(low, high, dtype=np.float32))
        self._rows = venv.row_count

    def reset(self) -> NDArray[np.float32]:
        """Start episodes in all worlds and return the rows' observations, shape [B R, 2 P]."""
        seen: Any = self.venv.reset()
        return self._with_means(seen)

    def step_wait(self) -> Any:
        """Step all worlds, and return observations, rewards, endings and infos of the rows."""
        seen: Any
        seen, paid, done, infos = self.venv.step_wait()
        for world in np.flatnonzero(done.reshape(-1, self._rows).any(axis=1)).tolist():
            # Of several species, those that end together.
            first = world * self._rows
            rows = first + np.flatnonzero(done[first : first + self._rows])
            last = np.stack([infos[row]["terminal_observation"] for row in rows])
            mean = last.mean(axis=0)
            for row, own in zip(rows.tolist(), last, strict=True):
                infos[row] = infos[row] | {"terminal_observation": np.concatenate((own, mean))}
        return self._with_means(seen), paid, done, infos

    def _with_means(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        worlds = seen.reshape(-1, self._rows, seen.shape[-1])
        means = np.broadcast_to(worlds.mean(axis=1, keepdims=True), worlds.shape)
        return np.concatenate((worlds, means), axis=2).reshape(len(seen), -1)


class RowRulePolicy(RuleActorCritic):
    """A policy for particles as rows: what a row perceives, then its species' tag, then means.

    Arguments are those of `RuleActorCritic`. A row without a tag is of the only species; what comes
    behind is for the critic.
    """

    def predict_values(self, obs: Any) -> Tensor:
        """Return the values of rows, shape [M, 1].

        Args:
            obs: Shape [M, P + K], or [M, 2 (P + K)] with means.
        """
        values: Tensor = self.critic(obs[:, None])
        return values

    def _new_critic(self, rules: RuleSet, kind: CriticKind) -> Critic:
        # What a central critic is told of a world stands in the row.
        columns = (self.observation_space.shape or (0,))[0]
        return Critic(columns, (1,))

    def _gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        perceived = self.actor.rules.interface.perception_dim
        rows, species_count = obs[:, :perceived], len(self.actor.log_std)
        if species_count == 1:
            return self.actor.row_mean(0, rows), self.actor.log_std
        tags = obs[:, perceived : perceived + species_count]
        means = torch.stack([self.actor.row_mean(k, rows) for k in range(species_count)], dim=1)
        return (tags[..., None] * means).sum(dim=1), tags @ self.actor.log_std

    def _row_log_prob(self, mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
        return gaussian_log_prob(mean, log_std, action)


def make_rows(problem: Problem, settings: RowSettings, device: torch.device | str) -> Any:
    """Return the particles of a problem's worlds as rows, as the options want them.

    Args:
        problem: What is to be learned.
        settings: Which say what a row is paid and sees.
        device: Where the worlds live.

    Raises:
        NPAError: Species are to be paid what their world is.
    """
    envs = problem.make_envs(device=device, row_rewards=settings.credit == "particle")
    rows: RowVecEnv
    if isinstance(envs, JoinedSpeciesEnv):
        if settings.credit == "world":
            raise NPAError(
                "credit must be 'particle' where several species are rows, got 'world': each is "
                "paid what its species is; the methods 'ppo' and 'ppo_world' pay by worlds"
            )
        rows = SpeciesVecEnv(envs.species_env)
    else:
        rows = ParticleVecEnv(envs)
    seen = WorldMeans(rows) if settings.critic == "central" else rows
    return BootstrappedRows(seen, settings.gamma)


@takes_fields_of(RowSettings)
def train(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    start: RuleSet | None = None,
    settings: RowSettings,
) -> RuleSet:
    """Return the rules that Stable-Baselines3's PPO finds, with a likelihood for each particle.

    Args:
        problem: What is to be learned.
        progress: Keeps the budget, and looks at the rules now and then.
        seed: Of all that is drawn.
        device: Where worlds and networks are; what is seen goes through the host.
        start: Rules to begin with; None: fresh ones.
        settings: Its fields, as keyword arguments.

    Raises:
        NPAError: There is no such option, or one is wrong.
        DivergedError: The policy has diverged.
    """
    env = make_rows(problem, settings, device)
    return learn(env, RowRulePolicy, progress, seed, device=device, start=start, settings=settings)
