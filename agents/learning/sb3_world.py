"""Stable-Baselines3's PPO over whole worlds: a likelihood a world, the mean over its particles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.agents.learning.actor_critic import Critic, CriticKind, gaussian_log_prob
from npa_envs.agents.learning.ppo_settings import takes_fields_of
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.agents.learning.sb3 import EXCESS, RuleActorCritic, SB3Settings, learn
from npa_envs.wrappers.sb3 import WorldVecEnv


@dataclass(frozen=True, kw_only=True)
class WorldSettings(SB3Settings):
    """Options of `train`: those of the other form, with defaults for means over many particles."""

    clip: float = 0.02
    """Ratios of likelihoods count up to 1 plus or minus this (dimensionless)."""


class WorldRulePolicy(RuleActorCritic):
    """A policy for rows of `WorldVecEnv`: all particles of a world act by their species' rule.

    Log-probability, entropy and value of a world are means over its particles. Arguments are those
    of `RuleActorCritic`.
    """

    @classmethod
    def row_kl(cls, particle_kl: float) -> float:
        """Return the `target_kl` at which a round ends when particles' likelihoods are so far.

        The mean log-ratio of many particles is close to minus their divergence k, of which
        r - 1 - log r makes k² / 2.

        Args:
            particle_kl: Divergence of a particle's actions [nats].
        """
        return 0.5 * particle_kl**2 / EXCESS

    def predict_values(self, obs: Any) -> Tensor:
        """Return the values of worlds, shape [M, 1].

        Args:
            obs: Shape [M, N, P].
        """
        values: Tensor = self.critic(obs)
        return values.mean(dim=1, keepdim=True)

    def _new_critic(self, rules: RuleSet, kind: CriticKind) -> Critic:
        counts = [span.stop - span.start for span in rules.spans]
        return Critic(rules.interface.perception_dim, counts, kind)

    def _gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        return self.actor.rules.mean(obs), self.actor.row_log_std()

    def _row_log_prob(self, mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
        return gaussian_log_prob(mean, log_std, action).mean(dim=1)


@takes_fields_of(WorldSettings)
def train(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    start: RuleSet | None = None,
    settings: WorldSettings,
) -> RuleSet:
    """Return the rules that Stable-Baselines3's PPO finds, with a likelihood for each world.

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
    env = WorldVecEnv(problem.make_envs(device=device))
    return learn(
        env, WorldRulePolicy, progress, seed, device=device, start=start, settings=settings
    )
