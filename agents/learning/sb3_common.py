"""What both forms of Stable-Baselines3's PPO share: options, the budget, and the run."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from npa_envs.agents.learning.critics import CriticKind
from npa_envs.agents.learning.ppo_settings import (
    beginning,
    check_words,
    filled,
    noise_left,
)
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.agents.learning.sb3_imports import PPO, BaseCallback, VecEnv, VecEnvWrapper
from npa_envs.agents.learning.sb3_policy import RuleActorCritic
from npa_envs.agents.learning.seeds import world_seeds
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive


@dataclass(frozen=True, kw_only=True)
class SB3Settings:
    """Options of both forms; the defaults are those of the device's own PPO."""

    steps: int = 16
    """Steps of all worlds in a round, T."""

    epochs: int = 4
    """Passes over a round."""

    minibatches: int = 4
    """Parts that the rows of a round are shuffled into."""

    learning_rate: float | None = None
    """Adam's step at the start, from which it falls to zero over the budget; None: 0.001, or 0.0001
    with a `start`."""

    gamma: float = 0.5
    """Discount of a reward one step later (dimensionless)."""

    gae_lambda: float = 0.9
    """Discount of what the critic did not foresee, besides `gamma` (dimensionless)."""

    clip: float = 0.2
    """Ratios of likelihoods count up to 1 plus or minus this (dimensionless)."""

    entropy_weight: float = 0.0
    """Weight of the entropy in what is maximised."""

    max_gradient_norm: float = 0.5
    """Gradients of rules and critic, taken together, are shortened to this norm; the device's own
    PPO shortens each by itself."""

    target_kl: float | None = None
    """No more updates in a round once particles' actions are about so far from those that were
    played [nats]; None: 0.2, or 0.05 with a `start`."""

    initial_std: float | None = None
    """Standard deviation of every action column at first; None: 0.2, or 0.05 with a `start`."""

    last_noise: float | None = None
    """What is left of the standard deviations at the end of the budget (dimensionless); None: 0.25,
    or 1 with a `start`."""

    noise_decay_share: float = 0.5
    """Share of the budget, its last, in which standard deviations fall to that; 1: from the
    start."""

    critic_rounds: int | None = None
    """Rounds in which the critic learns alone; None: 0, or 4 with a `start`."""

    critic: CriticKind = "particle"
    """A value follows from a particle's own perception, or from its whole world ("central")."""

    tensorboard_log: str | None = None
    """Folder for Stable-Baselines3's own log; None: nowhere."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: One lies outside its range.
        """
        check_positive(self, int, "steps", "epochs", "minibatches")
        check_positive(self, float, "clip", "max_gradient_norm")
        check_non_negative(self, "entropy_weight")
        check_fraction(self, "gamma", "gae_lambda", "noise_decay_share")
        for name in ("learning_rate", "target_kl", "initial_std"):
            if getattr(self, name) is not None:
                check_positive(self, float, name)
        if self.last_noise is not None:
            check_fraction(self, "last_noise")
        if self.critic_rounds is not None:
            check_positive(self, int, "critic_rounds", at_least=0)
        check_words(self, "critic")


class ProgressCallback(BaseCallback):
    """Keeps a learner's account while Stable-Baselines3 learns, and stops it in time.

    Args:
        progress: The account.
        round_size: Particle-steps of a round, T B N.
        critic_rounds: Rounds in which the critic learns alone.
        last_noise: What is left of the noise in the end.
        noise_decay_share: Share of the budget, its last, in which it falls.
    """

    def __init__(
        self,
        progress: Progress,
        round_size: int,
        critic_rounds: int = 0,
        last_noise: float = 1.0,
        noise_decay_share: float = 1.0,
    ) -> None:
        super().__init__()
        self.critic_rounds = critic_rounds
        self.last_noise = last_noise
        self.noise_decay_share = noise_decay_share
        self.progress = progress
        self.round_size = round_size
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
        policy: Any = self.model.policy
        policy.actor.leave_noise(
            noise_left(self.share_left, self.last_noise, self.noise_decay_share)
        )
        for parameter in self._learned:
            parameter.requires_grad_(self.critic_rounds <= 0)
        self.critic_rounds -= 1

    def _on_step(self) -> bool:
        """Return whether to go on; asked in every step, so a round that is none ends at once."""
        return self.share_left > 0.0

    def _on_rollout_end(self) -> None:
        self.progress.advance(self.round_size)

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
    rate, alone, far = chosen.learning_rate, chosen.critic_rounds, chosen.target_kl
    rows = settings.steps * env.num_envs
    problem = progress.problem
    callback = ProgressCallback(
        progress,
        settings.steps * problem.num_envs * problem.particle_count,
        alone,
        chosen.last_noise,
        settings.noise_decay_share,
    )
    model = PPO(
        policy_type,
        env,
        learning_rate=lambda _: rate * callback.share_left,
        n_steps=settings.steps,
        batch_size=-(-rows // settings.minibatches),
        n_epochs=settings.epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip,
        ent_coef=settings.entropy_weight,
        max_grad_norm=settings.max_gradient_norm,
        target_kl=policy_type.row_kl(far),
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
