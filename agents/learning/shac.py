"""Short-horizon actor-critic: gradients through a few steps, a critic for the rest.

Source: Xu et al., arXiv 2204.07137. An episode is cut into windows of a few steps, and each window
continues the worlds of the last one. Rules ascend the rewards of a window, differentiated through
its steps, plus the critic's value of the worlds at its end. Read `SHACLearner.learn` first.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import NamedTuple, get_args

import torch
from torch import Tensor

from npa_envs.agents.learning.actor_critic import (
    CRITIC_RATE,
    Critic,
    CriticInput,
    Minibatches,
    gradients_of,
    seeded_critic,
    set_gradients,
    worlds_of_process,
)
from npa_envs.agents.learning.problem import DifferentiableTask
from npa_envs.agents.learning.progress import Progress, annealed
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.checks import check_fraction, check_non_negative, check_positive, check_word
from npa_envs.training.optimiser import normalise_gradients
from npa_envs.training.process_group import begin_episodes
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom


@dataclass(frozen=True, kw_only=True)
class SHACOptions:
    """Options of the short-horizon actor-critic."""

    steps: int = 16
    """Maximum number of steps of a window; the windows of an episode have equal lengths h."""
    num_envs: int = 8
    """Worlds B of all processes."""
    gamma: float = 0.97
    """Discount of a reward one step later (dimensionless)."""
    value_weight: float = 0.25
    """Weight of the critic's value in the rules' objective (dimensionless); the source has 1."""
    td_lambda: float = 0.95
    """λ of the critic's TD(λ) targets (dimensionless)."""
    learning_rate: float = 4e-3
    """AdamW's learning rate of the rules at first; each parameter's gradient has the norm 1."""
    last_rate: float = 0.05
    """Learning rate at the end of the budget, as a fraction of the first (dimensionless)."""
    critic_epochs: int = 4
    """Passes of the critic over a window."""
    minibatches: int = 4
    """Minibatches of a pass, which is shuffled."""
    critic: CriticInput = "central"
    """Input of the critic, as of PPO. A world's value is the mean over its particles."""
    target_rate: float = 0.2
    """Fraction of its distance from the critic that the target critic moves after each window."""

    def __post_init__(self) -> None:
        check_positive(self, int, "steps", "num_envs", "critic_epochs", "minibatches")
        check_word(self, "critic", get_args(CriticInput))
        check_positive(self, float, "learning_rate")
        check_fraction(self, "gamma", "td_lambda", "last_rate", "target_rate")
        check_non_negative(self, "value_weight")


def train(progress: Progress, options: SHACOptions = SHACOptions()) -> RuleSet:
    """Return the rules that a short-horizon actor-critic learns within the budget.

    Rewards are decreases of the environment's loss, as with `reward="dense"`. The critic's values
    ignore that episodes end. State steps are clamped as by `ClampedRule`.
    """
    learner = SHACLearner(progress, options)

    def iteration() -> int:
        learner.learn(annealed(options.learning_rate, options.last_rate, progress.spent_fraction))
        return options.num_envs * learner.window_steps * progress.problem.particle_count

    return progress.run(learner.rules, iteration, learner)


class StepWindow(NamedTuple):
    """Features and losses of B worlds before and after each of h steps, differentiable."""

    features: Tensor
    """Inputs of the critic, [h + 1, B, N, F]: centred positions, states and the world's loss."""
    losses: Tensor
    """Losses of the worlds, shape [h + 1, B]."""

    @property
    def rewards(self) -> Tensor:
        """Decrease of the loss in each step, shape [h, B]."""
        return self.losses[:-1] - self.losses[1:]


class SHACLearner:
    """Rules, critic and worlds; each call of `learn` runs a window and trains on it.

    Each of several processes has some worlds; they average gradients and running moments.
    """

    def __init__(self, progress: Progress, options: SHACOptions) -> None:
        problem, device = progress.problem, progress.device
        self.options, self.device, self.processes = options, device, progress.processes
        self._indices, self.random = worlds_of_process(progress, options.num_envs)
        self.rules = progress.first_rules(zero_output=True)
        count = -(-problem.episode_steps // options.steps)
        self.window_steps = -(-problem.episode_steps // count)
        """Steps of a window, h."""
        self.task = DifferentiableTask(problem, device)
        width = problem.physics.space_dim + problem.physics.state_dim + 1
        self.critic = seeded_critic(progress, width, options.critic)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.modules = {"rules": self.rules, "critic": self.critic, "target": self.target}
        weights = [p for p in self.rules.parameters() if p.requires_grad]
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            "rules": torch.optim.AdamW(weights, fused=True),
            "critic": torch.optim.Adam(self.critic.parameters(), lr=CRITIC_RATE, fused=True),
        }
        self.window_count = count
        self._minibatches = Minibatches(
            self.window_steps, len(self._indices), (1,), options.minibatches, self.random
        )
        self.resume(0, 0)

    def resume(self, iteration: int, resumption: int) -> None:
        """Begin new worlds, drawn by `random`; the arguments are not used."""
        begin_episodes(self.random)
        self.worlds = self._new_worlds(list(range(len(self._indices))))
        self.windows_left = [1 + k % self.window_count for k in self._indices]
        """Windows left of each world's episode; at first they differ, so that batches are mixed."""

    def learn(self, rate: float) -> None:
        """Run a window; train the rules on it, at the learning rate `rate`, and the critic."""
        window, optimiser = self.play(), self.optimisers["rules"]
        set_gradients(optimiser, -self.objective(window))
        means = gradients_of(optimiser)
        self.processes.reduce(means)
        normalise_gradients(means)
        optimiser.param_groups[0]["lr"] = rate
        optimiser.step()
        self.learn_values(StepWindow(*(values.detach() for values in window)))

    def play(self) -> StepWindow:
        """Run the worlds for a window and return it; restart worlds whose episode is over."""
        task, steps, begin = self.task, self.window_steps, self.worlds
        begin_episodes(self.random)
        later = task.rollout(
            self.rules,
            begin,
            steps,
            eps=task.eps,
            update_prob=task.update_prob,
            generator=self.random,
            keep_every=1,
            cuda_graph=True,
        )
        x, s = torch.cat((begin.x[None], later.x)), torch.cat((begin.s[None], later.s))
        every = Particles(x, s).map(lambda values: values.flatten(0, 1))
        if begin.goal is not None:
            every = every._replace(goal=begin.goal.repeat(steps + 1))
        losses = task.world_losses(every).view(steps + 1, -1)
        level = losses[..., None, None].expand(*s.shape[:-1], 1)
        features = torch.cat((x - x.mean(dim=-2, keepdim=True), s, level), dim=-1)
        self._continue_from(x[-1].detach(), s[-1].detach())
        return StepWindow(features, losses)

    def _continue_from(self, x: Tensor, s: Tensor) -> None:
        """Take these worlds into the next window; begin new ones where an episode is over."""
        limits = self.task.physics.limits
        # Worlds that diverge are clamped to the environment's limits until their restart.
        x, s = (
            torch.nan_to_num(values).clamp(-limit, limit)
            for values, limit in ((x, limits.position), (s, limits.state))
        )
        self.worlds = self.worlds._replace(x=x, s=s)
        begin_episodes(self.random)
        self.windows_left = [left - 1 for left in self.windows_left]
        over = [world for world, left in enumerate(self.windows_left) if left == 0]
        if over:
            self.worlds.put_(torch.tensor(over, device=self.device), self._new_worlds(over))
        for world in over:
            self.windows_left[world] = self.window_count

    def _new_worlds(self, worlds: list[int]) -> Particles:
        random = self.random
        if isinstance(random, WorldRandom):
            random = random.take(torch.tensor(worlds, device=self.device))
        return self.task.seed(len(worlds), generator=random, device=self.device)

    def objective(self, window: StepWindow) -> Tensor:
        """Return what the rules ascend, shape []: discounted rewards plus the value at the end."""
        gamma, steps = self.options.gamma, self.window_steps
        discounts = gamma ** torch.arange(steps, device=self.device, dtype=torch.float32)
        returns = (discounts[:, None] * window.rewards).sum(dim=0)
        value = world_values(self.target, window.features[-1])
        return (returns + self.options.value_weight * gamma**steps * value).mean()

    def learn_values(self, window: StepWindow) -> None:
        """Train the critic on TD(λ) targets of a window; move the target critic towards it."""
        options = self.options
        features = window.features[:-1].flatten(0, 1)
        with torch.no_grad():
            for critic in (self.critic, self.target):
                critic.observe(features, self.processes)
            later = world_values(self.target, window.features[1:].flatten(0, 1))
            targets = td_lambda_targets(
                window.rewards,
                later.view_as(window.rewards),
                gamma=options.gamma,
                td_lambda=options.td_lambda,
            ).flatten()
            for critic in (self.critic, self.target):
                critic.rescale(targets, self.processes)
        for _ in range(options.critic_epochs):
            self._minibatches.shuffle()
            for index in self._minibatches.indices[0]:
                values = world_values(self.critic, features[index])
                error = (values - targets[index]) / self.critic.scale
                set_gradients(self.optimisers["critic"], 0.5 * error.square().mean())
                self.processes.reduce(gradients_of(self.optimisers["critic"]))
                self.optimisers["critic"].step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.critic.parameters(), strict=True)
            for target, parameter in pairs:
                target.lerp_(parameter, options.target_rate)


def world_values(critic: Critic, features: Tensor) -> Tensor:
    """Return the values [B] of worlds with features [B, N, F]: means over particles."""
    each: Tensor = critic(features)
    return each.mean(dim=-1)


def td_lambda_targets(
    rewards: Tensor, next_values: Tensor, *, gamma: float, td_lambda: float
) -> Tensor:
    """Return TD(λ) targets of a window's values, [h, ...] (arXiv 2204.07137, equation 7).

    `rewards` are those of the steps, `next_values` the critic's values after each step. The target
    of step t is r_t + γ ((1 - λ) v_t + λ target of step t + 1), that of the last step r + γ v.
    """
    targets = torch.empty_like(rewards)
    later = next_values[-1]
    for step in reversed(range(len(rewards))):
        later = rewards[step] + gamma * torch.lerp(next_values[step], later, td_lambda)
        targets[step] = later
    return targets
