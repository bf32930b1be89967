"""What both forms of Stable-Baselines3's PPO share: options, the budget, and the run."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from npa_envs.agents.learning.ppo_settings import CommonSettings, beginning, filled, noise_left
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.agents.learning.sb3_imports import PPO, BaseCallback, VecEnv, VecEnvWrapper
from npa_envs.agents.learning.sb3_policy import RuleActorCritic
from npa_envs.agents.learning.seeds import world_seeds
from npa_envs.tasks.checks import check_positive


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
