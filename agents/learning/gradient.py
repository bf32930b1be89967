"""Learning by the gradient of the environment's loss, through the environment's own physics."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Progress, annealed
from npa_envs.agents.learning.rule_set import RuleSet, species_of
from npa_envs.checks import check_fraction
from npa_envs.envs.core.task import EnvTask
from npa_envs.envs.multi.species_task import Population, SpeciesConfig, SpeciesTask
from npa_envs.errors import NPAError, shown
from npa_envs.rule.folded_network import FoldedRule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import ParticleTask
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.cycle import TrainingCycle
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.rollout import Memory, rollout_particles
from npa_envs.world.species import species_particles

MAX_STEPS = 96
"""Most steps of a rollout by default: longer episodes continue in a pool."""

KEY_RANGE = -(2**63), 2**63 - 1
"""Range of the keys of worlds' random streams."""


@dataclass(frozen=True, kw_only=True)
class GradientOptions:
    """Options of gradient descent; `TrainConfig`, which most are passed to, checks them."""

    steps: tuple[int, int] | None = None
    """Range [lo, hi) of the steps of a rollout; None: whole episodes of up to 96 steps, and 32 to
    96 steps of longer ones."""
    num_envs: int = 8
    """Worlds in a batch."""
    pool_size: int | None = None
    """Worlds of a pool, from which rollouts continue; 0: all rollouts start new episodes. None: 64
    if rollouts are shorter than episodes, else 0."""
    fresh_share: float = 0.25
    """Fraction of each batch from the pool that starts new episodes, at least one world
    (dimensionless)."""
    learning_rate: float = 4e-3
    """AdamW's, at first."""
    last_rate: float = 0.05
    """Learning rate at the end, as a fraction of the first."""
    memory: Memory = "store"
    """What the backward pass reads: "store", "recompute" or "minimal", as in `rollout`."""

    def __post_init__(self) -> None:
        check_fraction(self, "last_rate")
        steps: Any = self.steps
        if steps is not None:
            if not isinstance(steps, list | tuple) or len(steps) != 2:
                raise NPAError(
                    f"steps must be a range [lo, hi) of two whole numbers, got {shown(steps)}: "
                    "steps=(32, 97), on the command line steps=[32,97]"
                )
            object.__setattr__(self, "steps", tuple(steps))


def train(progress: Progress, options: GradientOptions = GradientOptions()) -> RuleSet:
    """Return rules that descend the loss at the end of rollouts, by gradients through all steps.

    Rollouts start new episodes, or continue earlier ones from a pool as in the paper (arXiv
    2601.16096). State steps are clamped as in environments. Observations are not clipped.
    """
    problem, device, seed = progress.problem, progress.device, progress.seed
    task, rules = EnvironmentTask(problem, device), progress.first_rules()
    length, steps, pool_size = problem.episode_steps, options.steps, options.pool_size
    if steps is None:
        steps = (length, length + 1) if length <= MAX_STEPS else (MAX_STEPS // 3, MAX_STEPS + 1)
    if pool_size is None:
        pool_size = 0 if steps[0] >= length else max(64, options.num_envs)
    config = BudgetTrainConfig(
        task=problem.config,
        progress=progress,
        # A single repeat without an end: the budget ends the run.
        iterations=sys.maxsize,
        repeats=1,
        world_count=options.num_envs,
        pool_size=pool_size or options.num_envs,
        steps=steps,
        learning_rate=options.learning_rate,
        last_rate=options.last_rate,
        milestones=(),
        seed_interval=1,
        fresh_share=options.fresh_share if pool_size else 1.0,
        damage_share=0.0,
        seed=seed,
        device=str(device),
        memory=options.memory,
        # A task whose starts are long rollouts is not captured.
        cuda_graph=not isinstance(task.inner, EnvTask) or task.inner.start_is_short,
    )
    schedule = torch.Generator().manual_seed(seed)
    cycle = TrainingCycle(task, rules, config, device, schedule, task.rollout)
    # On CUDA there is one graph for each number of steps: capture all before the clock starts.
    for step_count in range(*config.steps) if device.type == "cuda" else (config.steps[0],):
        cycle.iteration.run(step_count)
    numbers = itertools.count()

    def iteration() -> int:
        return cycle.run(next(numbers)) * config.world_count * problem.particle_count

    return progress.run(rules, iteration)


@dataclass(frozen=True, kw_only=True)
class BudgetTrainConfig(TrainConfig[Any]):
    """A `TrainConfig` whose learning rate depends on the budget spent, not on the iteration."""

    progress: Progress
    last_rate: float
    """Learning rate at the end, as a fraction of the first (dimensionless)."""

    def learning_rate_at(self, iteration: int, fraction: float = 0.0) -> float:
        """Return the learning rate, half a cosine of the budget spent; arguments are not used."""
        return annealed(self.learning_rate, self.last_rate, self.progress.spent_fraction)


class EnvironmentTask(ParticleTask[Any]):
    """A problem as a task of the trainer: start worlds, loss and physics of its episodes.

    All species must share one loss, and no particle may leave a world.
    """

    def __init__(self, problem: Problem, device: torch.device) -> None:
        self.problem, self.config, self.physics = problem, problem.config, problem.physics
        task = problem.make_task(device)
        self.inner: Any = task
        self._species = species_of(problem.counts).to(device)
        self._clamped: tuple[RuleSet, list[ClampedRule]] | None = None
        if not isinstance(task, SpeciesTask):
            return
        if type(task).final_rewards is not SpeciesTask.final_rewards:
            raise NPAError(
                "a method that follows gradients must have one loss to descend, but in "
                f"{problem.env_id} species gain rewards at each other's expense: learn by 'ppo' "
                "with the reward of each particle"
            )
        if problem.keywords.get("deaths"):
            raise NPAError(
                "a method that follows gradients must keep all particles, got "
                f"deaths={shown(problem.keywords['deaths'])}: "
                "leave deaths out, or learn by 'ppo' or 'evolution'"
            )

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box, None in open space [length units]."""
        return self.physics.periodic_box

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return start worlds of episodes, [B, N, ...], with their goals, if the task has any."""
        if isinstance(generator, WorldRandom):
            keys = generator.integers(KEY_RANGE[1])
        else:
            keys = torch.randint(*KEY_RANGE, (world_count,), generator=generator, device=device)
        x, s, *rest = self.inner.start(WorldRandom.from_keys(keys))
        return Particles(x, s, goal=rest[1] if rest else None)

    def with_goal(self, goal: Tensor | None) -> Self:
        """Return a copy whose losses are for these goals of worlds, [B]; None: the task itself."""
        return self if goal is None else self._copy_with(inner=self.inner.with_goal(goal))

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss, averaged over worlds and species, and its terms by name."""
        losses = {name: loss.mean() for name, loss in self._losses(worlds).items()}
        return torch.stack(list(losses.values())).sum(), losses

    def penalties(self, *_: Any) -> dict[str, tuple[float, Tensor]]:
        """Return no penalties: environments have none."""
        return {}

    def world_losses(self, worlds: Particles) -> Tensor:
        """Return the loss of each world, averaged over its species, shape [B]."""
        losses = self.with_goal(worlds.goal)._losses(worlds)
        total = torch.stack(list(losses.values())).sum(dim=0)
        return total.flatten(1).mean(dim=1) if total.dim() > 1 else total

    def rollout(self, rules: Any, worlds: Particles, steps: int, /, **options: Any) -> Particles:
        """Run a `RuleSet` by the environment's physics; options are those of `npa_envs.rollout`."""
        physics, config = self.physics, self.config
        if self._clamped is None or self._clamped[0] is not rules:
            # Made once, as captured rollouts identify rules by `id`.
            limit = physics.limits.state_scale
            self._clamped = rules, [ClampedRule(rule, limit) for rule in rules]
        rule: Any = self._clamped[1]
        options |= {
            "dt": physics.dt,
            "position_noise": physics.position_noise,
            "box": physics.box,
            "boundary": physics.boundary,
        }
        if isinstance(config, SpeciesConfig):
            options |= {"counts": config.counts, "perception": config.perception}
            run: Any = species_particles
        else:
            run, (rule,) = rollout_particles, rule
        after: Particles = run(rule, worlds, steps, **options)
        return after

    def _losses(self, worlds: Particles) -> Mapping[str, Tensor]:
        """Return the terms of each world's loss by name, shape [B], or [B, species]."""
        x, s, *_ = worlds
        losses: Mapping[str, Tensor]
        if isinstance(self.inner, SpeciesTask):
            losses = self.inner.losses(Population(x, s, self.problem.counts, self._species))
        else:
            losses = self.inner.losses(x, s)
        needed = torch.is_grad_enabled() and (x.requires_grad or s.requires_grad)
        if needed and not any(loss.requires_grad for loss in losses.values()):
            raise NPAError(
                f"the losses of {type(self.inner).__name__} must be differentiable for "
                "a method that follows gradients, but no gradient leads from them to positions or "
                "states: compute them by torch's operations, or learn by 'ppo' or 'evolution'"
            )
        return losses


class _ClampInward(torch.autograd.Function):
    """Clamps values to ± `limit`. Beyond it, gradients pass only if descent leads back inside."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, limit: float) -> Tensor:
        ctx.save_for_backward(values)
        ctx.limit = limit
        return values.clamp(-limit, limit)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, None]:
        (values,) = ctx.saved_tensors
        # Descent moves values against their gradient.
        leads_out = torch.where(values > 0.0, bar < 0.0, bar > 0.0)
        return bar.masked_fill((values.abs() > ctx.limit) & leads_out, 0.0), None


class ClampedWeights(FoldedRule):
    """The network of a `ClampedRule` as two matrix products, whose state steps are then clamped."""

    rule: ClampedRule

    def __call__(self, rows: Tensor) -> Tensor:
        """Map K perceptions [z | 1 | 0], [K, row_width], to K updates [δ | clamped Δs | 0]."""
        return self.rule.clamped(super().__call__(rows))


class ClampedRule(NPARule):
    """A rule with another rule's parameters and state steps clamped to ± `limit` (dimensionless).

    In a rollout it acts as the other rule does in an environment with `state_scale` = `limit`.
    """

    def __init__(self, rule: NPARule, limit: float) -> None:
        self.share(rule)
        self.limit = limit
        self.rule_is_plain = rule.is_plain()

    def forward(self, perception: Tensor) -> Tensor:
        """Map perceptions [..., P] to raw updates [..., A] with clamped state steps."""
        return self.clamped(super().forward(perception))

    def clamped(self, update: Tensor) -> Tensor:
        """Return raw updates [δ | Δs], shape [..., A], with the state steps Δs clamped."""
        first = self.update_dim - self.state_dim
        state_step = _ClampInward.apply(update[..., first:], self.limit)  # type: ignore[no-untyped-call]
        return torch.cat((update[..., :first], state_step), dim=-1)

    def is_plain(self) -> bool:
        """Return whether the clamped rule is no more than its two layers, those of `folded`."""
        return self.rule_is_plain

    def has_network(self) -> bool:
        """Return False, as `NPARule.network` would not clamp the state steps."""
        return False

    def folded(self) -> FoldedRule:
        """Return the network as `ClampedWeights`."""
        clamped = ClampedWeights(*super().folded())
        clamped.rule = self
        return clamped
