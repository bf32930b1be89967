"""Learners of Stable-Baselines3: PPO over whole worlds; PPO and SAC in gardens.

PPO over worlds has one likelihood for each world: its log-probability is the mean over particles.
It checks `ppo.py`: all is Stable-Baselines3's but the policy, whose actor is a set of rules.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from gymnasium.spaces import Dict, Space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.agents.learning.actor_critic import (
    CommonOptions,
    Critic,
    CriticInput,
    GaussianRules,
    Schedule,
)
from npa_envs.agents.learning.problem import world_seeds
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.agents.learning.untrained_methods import check_no_start
from npa_envs.checks import check_fraction, check_positive
from npa_envs.errors import NPAError, importing, shown
from npa_envs.wrappers.sb3 import WorldVecEnv, on_host

with importing("Stable-Baselines3", "this method", "pip install 'npa-envs[sb3]'"):
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.policies import ActorCriticPolicy

LearnedT = TypeVar("LearnedT")

KL_FACTOR = 1.5
"""Stable-Baselines3 ends a round when its divergence exceeds this times `target_kl`."""


@dataclass(frozen=True, kw_only=True)
class WorldOptions(CommonOptions):
    """Options of PPO whose sample is a world's joint action: one likelihood ratio per world."""

    clip: float = 0.02
    """Likelihood ratios, of means over many particles, are clipped to 1 ± this (dimensionless)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, float, "clip")


def train(progress: Progress, options: WorldOptions = WorldOptions()) -> RuleSet:
    """Return the rules that Stable-Baselines3's PPO learns within the budget.

    It seeds the global random states of torch and NumPy. Observations are copied to the CPU.
    """
    problem, seed, device = progress.problem, progress.seed, progress.device
    schedule = options.schedule(progress.initial)
    world_steps = options.steps * problem.num_envs
    batch_size = -(-world_steps // options.minibatches)
    if batch_size < 2:
        raise NPAError(
            f"minibatches must have at least 2 of a round's {world_steps} steps of worlds each, "
            f"got {options.minibatches}: give fewer, more steps, or more worlds"
        )
    env = WorldVecEnv(problem.make_envs(device=device))
    callback = RoundCallback(progress, options, schedule)
    model = PPO(
        WorldRulePolicy,
        env,
        learning_rate=lambda _: schedule.learning_rate * callback.remaining_budget,
        n_steps=options.steps,
        batch_size=batch_size,
        n_epochs=options.epochs,
        gamma=options.gamma,
        gae_lambda=options.gae_lambda,
        clip_range=options.clip,
        ent_coef=options.entropy_weight,
        max_grad_norm=options.max_gradient_norm,
        target_kl=world_kl(schedule.target_kl),
        policy_kwargs={
            "rules": progress.first_rules(zero_output=True),
            "initial_std": schedule.initial_std,
            "critic": options.critic,
        },
        seed=seed,
        device=device,
    )
    policy: Any = model.policy
    rules: RuleSet = policy.actor.rules
    return callback.learn(model, rules)


def world_kl(particle_kl: float) -> float:
    """Return Stable-Baselines3's `target_kl` for a `target_kl` of particles' actions [nats].

    The mean log-ratio of many particles is close to minus their divergence k, so that
    Stable-Baselines3's estimate for the ratio r, r - 1 - log r, is k² / 2.
    """
    return 0.5 * particle_kl**2 / KL_FACTOR


class ProgressCallback(BaseCallback):
    """Calls `Progress` after each step of all worlds, and stops learning at the budget's end."""

    def __init__(self, progress: Progress) -> None:
        super().__init__()
        self.progress = progress
        self.world_steps = progress.problem.num_envs * progress.problem.particle_count
        """Particle-steps of a step of all worlds."""

    def learn(self, model: Any, learned: LearnedT) -> LearnedT:
        """Let a model learn until the budget is spent; return its rules or policy, `learned`."""
        self.learned: Any = learned
        # Stable-Baselines3 would use the seeds seed, seed + 1, and so on.
        model.env.seed(world_seeds(self.progress.seed, self.progress.problem.num_envs)[0])
        model.learn(sys.maxsize, self)
        return learned

    def _on_training_start(self) -> None:
        self.progress.start(self.learned)

    def _on_step(self) -> bool:
        self.progress.advance(self.world_steps)
        self.progress.look(self.learned)
        return not self.progress.over

    def _on_training_end(self) -> None:
        self.progress.look(self.learned, force=True)


class RoundCallback(ProgressCallback):
    """Calls `Progress` once a round; sets the rules' noise; at first lets only the critic learn."""

    def __init__(self, progress: Progress, options: WorldOptions, schedule: Schedule) -> None:
        super().__init__(progress)
        self.options, self.schedule = options, schedule
        self.rounds = 0
        self.remaining_budget = 1.0
        """Remaining fraction of the budget at the start of the round."""

    def _on_rollout_start(self) -> None:
        self.progress.look(self.learned)
        self.remaining_budget = max(0.0, 1.0 - self.progress.spent_fraction)
        policy: Any = self.model.policy
        actor: GaussianRules = policy.actor
        last_noise = self.schedule.last_noise
        actor.set_noise(self.options.noise_factor(self.remaining_budget, last_noise))
        if self.rounds == 0:
            self._trained = [p for p in actor.parameters() if p.requires_grad]
        for parameter in self._trained:
            parameter.requires_grad_(self.rounds >= self.schedule.critic_rounds)
        self.rounds += 1

    def _on_step(self) -> bool:
        # A round that begins with no budget left ends at once.
        return self.remaining_budget > 0.0

    def _on_rollout_end(self) -> None:
        self.progress.advance(self.options.steps * self.world_steps)


class WorldRulePolicy(ActorCriticPolicy):
    """A policy for Stable-Baselines3 and `WorldVecEnv`: particles act by their species' rule.

    Log-probability and value of a world are means over its particles. Rules are copied.
    """

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Space[Any],
        lr_schedule: Any,
        *,
        rules: RuleSet,
        initial_std: float = 0.2,
        critic: CriticInput = "particle",
        **keywords: Any,
    ) -> None:
        super().__init__(observation_space, action_space, lr_schedule, net_arch=[], **keywords)
        self.actor = GaussianRules(rules, initial_std)
        """Rules with exploration noise; `actor.rules` acts without."""
        self.log_std = self.actor.log_std
        self.critic = Critic(rules.interface.perception_dim, rules.counts, critic)
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions [B, N, A], values [B, 1], log-probabilities [B] for worlds [B, N, P]."""
        self.critic.observe(obs)
        if deterministic:
            action = self.actor.rules.mean(obs)
            log_prob = self.actor.log_prob(obs, action)
        else:
            action, log_prob = self.actor.sample(obs)
        return action, self.predict_values(obs), log_prob.mean(dim=1)

    def evaluate_actions(self, obs: Any, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values [B, 1], log-probabilities [B] and entropies [B] of worlds' actions."""
        log_prob = self.actor.log_prob(obs, actions.view(*obs.shape[:2], -1))
        return self.predict_values(obs), log_prob.mean(dim=1), self.actor.entropy().expand(len(obs))

    def predict_values(self, obs: Any) -> Tensor:
        """Return the values of worlds, shape [B, 1]."""
        values: Tensor = self.critic(obs)
        return values.mean(dim=1, keepdim=True)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        if deterministic:
            return self.actor.rules.mean(observation)
        return self.actor.sample(observation)[0]

    def _build(self, lr_schedule: Any) -> None:
        """Do nothing: `__init__` makes the networks and the optimiser."""


# Gardens: unchanged SAC and PPO, one row for each world.

ALGORITHMS: dict[str, type[SAC] | type[PPO]] = {"sac": SAC, "ppo": PPO}
"""Algorithms by the file names of `GardenPolicy.save`, without ".zip"."""


@dataclass(frozen=True, kw_only=True)
class GardenOptions:
    """Options of both SAC and PPO in gardens; all else is Stable-Baselines3's default."""

    gamma: float = 0.9
    """Discount of a reward one step later (dimensionless)."""
    learning_rate: float = 3e-4
    """Adam's learning rate."""

    def __post_init__(self) -> None:
        check_fraction(self, "gamma")
        check_positive(self, float, "learning_rate")
        check_positive(self, int, *(f.name for f in fields(self) if isinstance(f.default, int)))


@dataclass(frozen=True, kw_only=True)
class SACOptions(GardenOptions):
    """Options of SAC in gardens."""

    learning_starts: int = 1000
    """Number of steps of single worlds before the first gradient step."""


@dataclass(frozen=True, kw_only=True)
class GardenPPOOptions(GardenOptions):
    """Options of PPO in gardens."""

    steps: int = 32
    """Steps of each world in a round."""
    batch_size: int = 64
    """Number of steps of single worlds in a minibatch, at least 2."""


def train_garden_sac(progress: Progress, options: SACOptions = SACOptions()) -> GardenPolicy:
    """Return the policy that SAC (Haarnoja et al., arXiv 1801.01290) learns within the budget."""
    # A gradient step for about eight steps of worlds.
    steps, starts = max(1, progress.problem.num_envs // 8), options.learning_starts
    return _garden_policy(SAC, progress, options, learning_starts=starts, gradient_steps=steps)


def train_garden_ppo(
    progress: Progress, options: GardenPPOOptions = GardenPPOOptions()
) -> GardenPolicy:
    """Return the policy that PPO (Schulman et al., arXiv 1707.06347) learns within the budget."""
    size = options.batch_size
    if min(options.steps * progress.problem.num_envs, size) < 2:
        raise NPAError(
            "a round and a minibatch must have at least 2 steps of worlds, got "
            f"steps={options.steps} and batch_size={size}: give steps=32 and batch_size=64"
        )
    return _garden_policy(PPO, progress, options, n_steps=options.steps, batch_size=size)


def _garden_policy(
    algorithm: Any, progress: Progress, options: GardenOptions, **settings: int
) -> GardenPolicy:
    check_no_start(progress)
    env = WorldVecEnv(progress.problem.make_envs(device=progress.device))
    model = algorithm(
        "MultiInputPolicy" if isinstance(env.observation_space, Dict) else "MlpPolicy",
        env,
        gamma=options.gamma,
        learning_rate=options.learning_rate,
        seed=progress.seed,
        device=progress.device,
        **settings,
    )
    callback = ProgressCallback(progress)
    callback.world_steps *= getattr(progress.problem.config, "rule_steps", 1)
    policy = callback.learn(model, GardenPolicy(model))
    env.close()
    return policy


class GardenPolicy:
    """A model of Stable-Baselines3, not copied, as the policy of a garden, without noise."""

    def __init__(self, model: Any) -> None:
        self.model = model
        space = model.observation_space
        self._shapes = _shapes(space.spaces if isinstance(space, Dict) else space)

    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """Return actions for observations [B, ...], in the shape that the model was trained with.

        Gardens take the rows of brushes as [B, J W] and as [B, J, W].
        """
        shapes = {name: shape[1:] for name, shape in _shapes(observation).items()}
        if shapes != self._shapes:
            raise NPAError(
                f"observation must have the shapes {self._shapes} of the garden that the policy "
                f"was trained in, got {shapes}: take a policy that was trained in this garden"
            )
        if isinstance(observation, dict):
            arrays: Any = dict(zip(observation, on_host(*observation.values()), strict=True))
        else:
            (arrays,) = on_host(observation)
        action, _ = self.model.predict(arrays, deterministic=True)
        return np.asarray(action)

    def save(self, folder: str | Path) -> list[Path]:
        """Write the model as Stable-Baselines3 does, `sac.zip` or `ppo.zip`; return the path."""
        path = Path(folder) / f"{type(self.model).__name__.lower()}.zip"
        self.model.save(path)
        return [path]

    @classmethod
    def load(cls, path: str | Path) -> GardenPolicy:
        """Return the policy in a file that `save` wrote; it is unpickled, so trust who made it."""
        name = Path(path).stem
        if name not in ALGORITHMS or not Path(path).is_file():
            raise NPAError(
                f"path must be of a file sac.zip or ppo.zip that exists, got {shown(str(path))}: "
                "name one that `save` or `npa-envs learn` wrote, by its algorithm's name"
            )
        try:
            return cls(ALGORITHMS[name].load(path, device="cpu"))
        except Exception as error:
            # Unpickling may raise anything.
            raise NPAError(
                f"path must be of a file that {name}'s `save` wrote, got {shown(str(path))} "
                f"({shown(error)}): save the policy again, or name another file"
            ) from error


def _shapes(values: Any) -> dict[str, tuple[int, ...]]:
    """Return the shapes in a dict of arrays or spaces, by name; of one array as "observation"."""
    named = values if isinstance(values, dict) else {"observation": values}
    return {name: tuple(value.shape) for name, value in named.items()}
