"""A policy of Stable-Baselines3 whose actor is rules, so that it is exported by taking them out."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.spaces import Space
from torch import Tensor

from npa_envs.agents.learning.critics import Critic, CriticKind
from npa_envs.agents.learning.gaussian import GaussianRules
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.agents.learning.sb3_imports import ActorCriticPolicy

EXCESS = 1.5
"""Stable-Baselines3 goes on until the divergence is so many times `target_kl`."""


class RuleActorCritic(ActorCriticPolicy):
    """A policy of Stable-Baselines3 whose actor is rules; subclasses say what a row is.

    Args:
        observation_space: Of a row.
        action_space: Of a row.
        lr_schedule: Learning rate by the share of the steps that is left.
        rules: The actor's means to begin with; copied.
        initial_std: Standard deviation of every action column at first.
        critic: A value follows from a particle alone, or from its world.
        keywords: For `ActorCriticPolicy`.
    """

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Space[Any],
        lr_schedule: Any,
        *,
        rules: RuleSet,
        initial_std: float = 0.2,
        critic: CriticKind = "particle",
        **keywords: Any,
    ) -> None:
        super().__init__(observation_space, action_space, lr_schedule, net_arch=[], **keywords)
        self._made_of = {"rules": rules, "initial_std": initial_std, "critic": critic}
        self.actor = GaussianRules(rules, initial_std)
        """Rules that explore: `actor.rules` acts without."""
        self.log_std = self.actor.log_std
        self.critic: Critic = self._new_critic(rules, critic)
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions, values [M, 1] and log-probabilities [M] while worlds are played.

        Args:
            obs: Of M rows.
            deterministic: Act by the mean.
        """
        self.critic.observe(obs)
        mean, log_std = self._gaussian(obs)
        action = mean if deterministic else mean + log_std.exp() * torch.randn_like(mean)
        log_prob = self._row_log_prob(mean, log_std, action)
        return action, self.predict_values(obs), log_prob

    def evaluate_actions(self, obs: Any, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values [M, 1], log-probabilities [M] and entropies [M] of what was done.

        Args:
            obs: Of M rows.
            actions: What they did.
        """
        mean, log_std = self._gaussian(obs)
        log_prob = self._row_log_prob(mean, log_std, actions.view(mean.shape))
        entropy = self.actor.entropy().expand(len(obs))
        return self.predict_values(obs), log_prob, entropy

    @classmethod
    def row_kl(cls, particle_kl: float) -> float:
        """Return the `target_kl` at which a round ends when particles' likelihoods are so far.

        Args:
            particle_kl: Divergence of a particle's actions [nats].
        """
        return particle_kl / EXCESS

    def predict_values(self, obs: Any) -> Tensor:
        """Return the values of rows, shape [M, 1].

        Args:
            obs: Of M rows.
        """
        raise NotImplementedError

    def get_distribution(self, obs: Any) -> Any:
        """Refuse: actions are drawn by `forward`, and likelihoods found by `evaluate_actions`."""
        raise NotImplementedError("rules draw their actions themselves: see forward")

    def _new_critic(self, rules: RuleSet, kind: CriticKind) -> Critic:
        """Return what predicts values."""
        raise NotImplementedError

    def _gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the means of rows' actions, and logarithms of standard deviations like them."""
        raise NotImplementedError

    def _row_log_prob(self, mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
        """Return the log-probabilities of rows' actions, shape [M]."""
        raise NotImplementedError

    def _build(self, lr_schedule: Any) -> None:
        """Make nothing: networks and optimiser are made once the rules are known."""

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        mean, log_std = self._gaussian(observation)
        return mean if deterministic else mean + log_std.exp() * torch.randn_like(mean)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        given = super()._get_constructor_parameters()
        del given["net_arch"]
        return given | self._made_of
