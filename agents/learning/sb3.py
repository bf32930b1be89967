"""What is taken from Stable-Baselines3, with an error that names the cure where it is missing."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.agents.learning.actor_critic import (
    Critic,
    CriticKind,
    GaussianRules,
    gaussian_log_prob,
)
from npa_envs.agents.learning.joined import JoinedSpeciesEnv
from npa_envs.agents.learning.ppo_settings import (
    CommonSettings,
    beginning,
    check_words,
    filled,
    noise_left,
    takes_fields_of,
)
from npa_envs.agents.learning.problem import Problem, world_seeds
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.tasks.checks import check_positive
from npa_envs.wrappers.sb3 import ParticleVecEnv, RowVecEnv, SpeciesVecEnv

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
except ImportError as error:
    raise MissingDependencyError(
        "this form of PPO needs Stable-Baselines3: pip install 'npa-envs[sb3]'"
    ) from error

__all__ = ["PPO", "ActorCriticPolicy", "BaseCallback", "VecEnv", "VecEnvWrapper"]


# What both forms of Stable-Baselines3's PPO share: options, the budget, and the run.


@dataclass(frozen=True, kw_only=True)
class SB3Settings(CommonSettings):
    """Options of both forms; the defaults are those of the device's own PPO."""

    minibatches: int = 4
    """Parts that the rows of a round are shuffled into."""

    clip: float = 0.2
    """Ratios of likelihoods count up to 1 plus or minus this (dimensionless)."""

    max_gradient_norm: float = 0.5
    """Gradients of rules and critic, taken together, are shortened to this norm; the device's own
    PPO shortens each by itself."""

    target_kl: float | None = None
    """No more updates in a round once particles' actions are about so far from those that were
    played [nats]; None: 0.2, or 0.05 with a `start`."""

    tensorboard_log: str | None = None
    """Folder for Stable-Baselines3's own log; None: nowhere."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: One lies outside its range.
        """
        super().__post_init__()
        check_positive(self, int, "minibatches")
        check_positive(self, float, "clip", "max_gradient_norm")
        if self.target_kl is not None:
            check_positive(self, float, "target_kl")


class ProgressCallback(BaseCallback):
    """Keeps a learner's account while Stable-Baselines3 learns, and stops it in time.

    Args:
        progress: The account.
        settings: Of PPO, none of them None any more.
    """

    def __init__(self, progress: Progress, settings: Any) -> None:
        super().__init__()
        self.progress = progress
        self.settings = settings
        self.rounds = 0
        """Rounds begun."""
        self.share_left = 1.0
        """Share of the budget that was left when the round began."""

    @property
    def rules(self) -> RuleSet:
        """What is learned."""
        policy: Any = self.model.policy
        rules: RuleSet = policy.actor.rules
        return rules

    def _on_training_start(self) -> None:
        policy: Any = self.model.policy
        self._learned = [p for p in policy.actor.parameters() if p.requires_grad]
        self.progress.start(self.rules)

    def _on_rollout_start(self) -> None:
        self.progress.look(self.rules)
        self.share_left = max(0.0, 1.0 - self.progress.share)
        settings = self.settings
        policy: Any = self.model.policy
        policy.actor.leave_noise(
            noise_left(self.share_left, settings.last_noise, settings.noise_decay_share)
        )
        for parameter in self._learned:
            parameter.requires_grad_(self.rounds >= settings.critic_rounds)
        self.rounds += 1

    def _on_step(self) -> bool:
        """Return whether to go on; asked in every step, so a round that is none ends at once."""
        return self.share_left > 0.0

    def _on_rollout_end(self) -> None:
        problem = self.progress.problem
        self.progress.advance(self.settings.steps * problem.num_envs * problem.particle_count)

    def _on_training_end(self) -> None:
        self.progress.look(self.rules, force=True)


class BootstrappedRows(VecEnvWrapper):
    """Rows that were cut off by the step limit are paid what they would still have got.

    Stable-Baselines3 does that row by row, which takes seconds for many thousand rows; here the
    critic is asked once for all of them, and the rows' infos say so no more.

    Args:
        venv: The rows.
        gamma: Discount of a reward one step later (dimensionless).

    Attributes:
        policy: The policy whose critic is asked; None until there is one.
    """

    def __init__(self, venv: VecEnv, gamma: float) -> None:
        super().__init__(venv)
        self.gamma = gamma
        self.policy: RuleActorCritic | None = None

    def reset(self) -> Any:
        """Start episodes in all worlds, and return the rows' observations."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Step all worlds, and return observations, rewards, endings and infos of the rows."""
        shown, paid, done, infos = self.venv.step_wait()
        cut = [row for row in np.flatnonzero(done) if infos[row].get("TimeLimit.truncated")]
        if cut and self.policy is not None:
            last = np.stack([infos[row]["terminal_observation"] for row in cut])
            with torch.no_grad():
                values = self.policy.predict_values(torch.from_numpy(last).to(self.policy.device))
            paid[cut] += self.gamma * values.cpu().numpy()[:, 0]
            for row in cut:
                infos[row] = {**infos[row], "TimeLimit.truncated": False}
        return shown, paid, done, infos


def learn(
    env: VecEnv,
    policy_type: type[RuleActorCritic],
    progress: Progress,
    seed: int,
    *,
    device: torch.device | str,
    start: RuleSet | None,
    settings: SB3Settings,
) -> RuleSet:
    """Run Stable-Baselines3's PPO until the budget is spent, and return what it learned.

    Args:
        env: Rows to learn from.
        policy_type: The policy for such rows.
        progress: The budget.
        seed: Of all that is drawn; Stable-Baselines3 seeds torch and NumPy as a whole.
        device: Where networks are.
        start: Rules to begin with; None: fresh ones.
        settings: Of PPO.
    """
    rules = beginning(progress.problem, seed, start)
    chosen: Any = filled(settings, start)
    rows = settings.steps * env.num_envs
    problem = progress.problem
    callback = ProgressCallback(progress, chosen)
    model = PPO(
        policy_type,
        env,
        learning_rate=lambda _: chosen.learning_rate * callback.share_left,
        n_steps=settings.steps,
        batch_size=-(-rows // settings.minibatches),
        n_epochs=settings.epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip,
        ent_coef=settings.entropy_weight,
        max_grad_norm=settings.max_gradient_norm,
        target_kl=policy_type.row_kl(chosen.target_kl),
        tensorboard_log=settings.tensorboard_log,
        policy_kwargs={
            "rules": rules,
            "initial_std": chosen.initial_std,
            "critic": settings.critic,
        },
        seed=seed,
        device=device,
    )
    if isinstance(env, BootstrappedRows):
        policy: Any = model.policy
        env.policy = policy
    # Stable-Baselines3 would begin with worlds seed, seed + 1, and so on.
    env.seed(world_seeds(seed, problem.num_envs)[0])
    model.learn(sys.maxsize, callback)
    return callback.rules


# A policy of Stable-Baselines3 whose actor is rules, so that it is exported by taking them out.


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


# Stable-Baselines3's PPO over particles: each is a row with a likelihood of its own.


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
