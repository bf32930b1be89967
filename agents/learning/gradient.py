"""Learning by the gradient of the environment's loss, through the environment's own physics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import torch

from npa_envs.agents.learning.episode_task import episode_task
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Progress, annealed
from npa_envs.agents.learning.rules import RuleSet, starting_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.iteration import TrainingCycle
from npa_envs.world.rollout import Memory

LONGEST = 96
"""Rollouts are no longer than this unless asked for: longer episodes go on in a pool."""

POOL_SIZE = 64
"""Worlds in a pool, unless asked for."""


@dataclass(frozen=True, kw_only=True)
class _Schedule(TrainConfig[Any]):
    """A trainer's configuration whose learning rate follows the budget."""

    progress: Progress
    """The run's account."""

    last_rate: float
    """Learning rate at the end, as a share of the first (dimensionless)."""

    def learning_rate_at(self, iteration: int) -> float:
        """Return the learning rate now: half a cosine over the budget.

        Args:
            iteration: Iterations done so far; the budget counts, and not they.
        """
        return annealed(self.learning_rate, self.last_rate, self.progress.share)


def train(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
    steps: tuple[int, int] | None = None,
    world_count: int = 8,
    pool_size: int | None = None,
    fresh_share: float = 0.25,
    learning_rate: float = 4e-3,
    last_rate: float = 0.05,
    normalise_gradients: bool = True,
    memory: Memory = "store",
) -> RuleSet:
    """Descend the loss at the end of rollouts, differentiated through all of their steps.

    Rollouts begin where episodes do, or go on from where earlier ones ended, in a pool as in the
    paper (arXiv 2601.16096). State steps are held within the action space, as environments hold
    them; that environments clip observations is not seen.

    Args:
        problem: What is to be learned.
        progress: The budget and the learning curve.
        seed: Of all draws, and of new rules.
        device: Where worlds and rules are.
        start: Rules to begin with; copied.
        steps: Range [lo, hi) that the number of steps of each rollout is drawn from; None: whole
            episodes of up to 96 steps, or 32 to 96 steps of longer ones.
        world_count: Worlds in a batch.
        pool_size: Worlds that live on between rollouts; 0: none, all rollouts begin where episodes
            do. None: 64 where rollouts are shorter than episodes, else 0.
        fresh_share: Share of each batch from the pool that begins where episodes do, at least one
            world (dimensionless).
        learning_rate: AdamW's, at the beginning.
        last_rate: Learning rate at the end, as a share of the first.
        normalise_gradients: Divide each parameter's gradient by its own norm.
        memory: What the backward pass reads: "store", "recompute" or "minimal", as in `rollout`.

    Returns:
        The rules.

    Raises:
        NPAError: An option is out of its range, or the environment's loss has no gradient.
        DivergedError: The rules' weights are not finite.
    """
    task = episode_task(problem, device)
    rules = starting_rules(problem, seed, device, start)
    length = problem.episode_steps
    if steps is None:
        steps = (length, length + 1) if length <= LONGEST else (LONGEST // 3, LONGEST + 1)
    if pool_size is None:
        pool_size = 0 if steps[0] >= length else max(POOL_SIZE, world_count)
    config = _Schedule(
        task=problem.config,
        progress=progress,
        iterations=2**40,
        repeats=1,
        world_count=world_count,
        pool_size=pool_size or world_count,
        steps=steps,
        learning_rate=learning_rate,
        last_rate=last_rate,
        milestones=(),
        normalise_gradients=normalise_gradients,
        seed_interval=1,
        fresh_share=fresh_share if pool_size else 1.0,
        damage=False,
        seed=seed,
        device=str(device),
        memory=memory,
        cuda_graph=task.can_be_recorded,
    )
    schedule = torch.Generator().manual_seed(seed)
    # The cycle asks of the rule what any module has, and of the task what it needs of one.
    cycle = TrainingCycle(
        cast(Task, task), cast(NPARule, rules), config, device, schedule, task.rollout
    )
    # On CUDA every number of steps is a recording of its own.
    for length in range(*steps) if device.type == "cuda" else (steps[0],):
        cycle.batch.run(length)
    progress.start(rules)
    iteration = 0
    while not progress.over:
        ran = cycle.run(iteration)
        iteration += 1
        progress.advance(ran * world_count * problem.particle_count)
        progress.look(rules)
    progress.look(rules, force=True)
    return rules
