"""Learning by the gradient of a problem's loss through its physics, by the trainer's cycle."""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass
from typing import Any

import torch

from npa_envs.agents.learning.problem import DifferentiableTask
from npa_envs.agents.learning.progress import Progress, annealed
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.checks import check_fraction
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.cycle import TrainingCycle
from npa_envs.world.rollout import Memory

MAX_STEPS = 96
"""Default maximum number of steps of a rollout; longer episodes continue in a pool."""


@dataclass(frozen=True, kw_only=True)
class GradientOptions:
    """Options of gradient descent; `TrainConfig`, which most are passed to, checks them."""

    steps: tuple[int, int] | None = None
    """Range [lo, hi) of a rollout's steps; None: whole episodes, or 32 to 96 steps of long ones."""
    num_envs: int = 8
    """Worlds of a batch, B."""
    pool_size: int | None = None
    """Worlds that are stored between batches, from which rollouts continue; 0: all rollouts start
    new episodes. None: 64 if rollouts are shorter than episodes (or a batch, if larger), else 0."""
    fresh_share: float = 0.25
    """Fraction of a batch from the pool that starts new episodes; at least one world does."""
    learning_rate: float = 4e-3
    """AdamW's learning rate at first."""
    last_rate: float = 0.05
    """Learning rate at the end of the budget, as a fraction of the first (dimensionless)."""
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


@dataclass(frozen=True, kw_only=True)
class BudgetTrainConfig(TrainConfig[Any]):
    """A `TrainConfig` of a run that ends with its budget, in one repeat, without damage."""

    iterations: int = sys.maxsize
    repeats: int = 1
    milestones: tuple[int, ...] = ()
    seed_interval: int = 1
    damage_share: float = 0.0
    progress: Progress
    last_rate: float
    """Learning rate at the end of the budget, as a fraction of the first (dimensionless)."""

    def learning_rate_at(self, iteration: int, fraction: float = 0.0) -> float:
        """Return the learning rate, half a cosine of the budget spent; arguments are not used."""
        return annealed(self.learning_rate, self.last_rate, self.progress.spent_fraction)


def train(progress: Progress, options: GradientOptions = GradientOptions()) -> RuleSet:
    """Return rules that descend the loss at the end of rollouts, by gradients through all steps.

    Rollouts start new episodes, or continue earlier ones from a pool as in the paper (arXiv
    2601.16096). State steps are clamped as in environments. Observations are not clipped.
    """
    problem, device, seed = progress.problem, progress.device, progress.seed
    task, rules = DifferentiableTask(problem, device), progress.first_rules()
    length, steps, pool_size = problem.episode_steps, options.steps, options.pool_size
    if steps is None:
        steps = (length, length + 1) if length <= MAX_STEPS else (MAX_STEPS // 3, MAX_STEPS + 1)
    if pool_size is None:
        pool_size = 0 if steps[0] >= length else max(64, options.num_envs)
    config = BudgetTrainConfig(
        task=problem.config,
        progress=progress,
        world_count=options.num_envs,
        pool_size=pool_size or options.num_envs,
        fresh_share=options.fresh_share if pool_size else 1.0,
        steps=steps,
        learning_rate=options.learning_rate,
        last_rate=options.last_rate,
        seed=seed,
        device=str(device),
        memory=options.memory,
        cuda_graph=task.start_is_short,
    )
    schedule = torch.Generator().manual_seed(seed)
    cycle = TrainingCycle(task, rules, config, device, schedule, task.rollout)
    # On CUDA there is one graph for each number of steps: capture all before the clock starts.
    for step_count in range(*config.steps) if device.type == "cuda" else (config.steps[0],):
        cycle.batch.run(step_count)
    numbers = itertools.count()

    def iteration() -> int:
        return cycle.run(next(numbers)) * config.world_count * problem.particle_count

    return progress.run(rules, iteration)
