"""The cycle of training: worlds from a pool, rollout, gradients, worlds back, optimiser's step.

No method waits for the device. An iteration runs eagerly, or as CUDA graphs; what happened is
kept on the device until a line of the log asks for it.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

import npa_envs.world.rollout
from npa_envs.errors import NPAError
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task, Worlds
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.iteration import EagerIteration, GraphedIteration, Rollout
from npa_envs.training.meter import LossMeter
from npa_envs.training.optimiser import RuleOptimiser
from npa_envs.training.pool import RUNAWAY_LIMIT, WorldPool
from npa_envs.training.randomness import RunRandomness, registered, restart
from npa_envs.training.ranks import Ranks
from npa_envs.world.cuda_graph import GraphedCallable
from npa_envs.world.randomness import Randomness, WorldRandom, uniform_draws


class TrainingCycle:
    """All that changes while a rule is trained.

    Args:
        by_world: Each world draws by itself, as several processes need it.

    Raises:
        NPAError: ε is to vary where it cannot.
    """

    def __init__(
        self,
        task: Task,
        rule: NPARule,
        config: TrainConfig[Any],
        device: torch.device,
        schedule: torch.Generator,
        rollout: Rollout | None = None,
        *,
        ranks: Ranks | None = None,
        by_world: bool = False,
    ) -> None:
        self.task = task.for_rule(rule)
        """The task, as it is for worlds of this rule."""
        _check_varied_eps(self.task, rule, config)
        self._config = config
        self._rollout: Rollout = npa_envs.world.rollout.rollout if rollout is None else rollout
        self._ranks = ranks = Ranks() if ranks is None else ranks
        self._section = config.pool_size // config.world_count if by_world else config.pool_size
        if by_world:
            ranks.check(config)
        places = ranks.places(config.pool_size, self._section)
        self.random = (
            RunRandomness.by_world(config, device, schedule, ranks)
            if by_world
            else RunRandomness.of_batch(config, device, schedule)
        )
        """What the run draws from."""
        self._places = places.to(device)
        x, s, goal = self._seeds(len(places), self.random.pool)
        max_age_range = config.max_age_range if config.ages else None
        self.pool = WorldPool(
            x,
            s,
            goal,
            runaway_limit=RUNAWAY_LIMIT,
            max_age_range=max_age_range,
            places=places,
            total=config.pool_size,
        )
        """Worlds of this process that live on between batches."""
        numbers = ranks.places(config.world_count)
        # Where each world of a batch has a part of the pool to itself, they take turns.
        whole, fresh = config.world_count, config.fresh_count
        self._fresh = [
            ((numbers - first) % whole < fresh).nonzero()[:, 0].to(device)
            for first in range(0, whole if by_world else 1, fresh)
        ]
        """Which worlds of a batch begin anew, by turns."""
        count = len(numbers)
        batch = x[:count], s[:count]
        goals = None if goal is None else goal[:count]
        graphed = device.type == "cuda" and config.cuda_graph
        iteration = GraphedIteration if graphed else EagerIteration
        self.batch: EagerIteration = iteration(
            self.task,
            rule,
            config,
            batch[0],
            batch[1],
            self.random.masks,
            self._rollout,
            goal=goals,
            mean_over_processes=None if ranks.count == 1 else ranks.mean,
        )
        """Worlds before and after the last rollout, the loss and its gradients."""
        self.optimiser = RuleOptimiser(self.batch.parameters, config, rule)
        """Changes the rule."""
        self.meter = LossMeter(self.batch)
        """What happened since the last line of the log."""
        self._index = torch.zeros(count, dtype=torch.int64, device=device)
        self._age = torch.zeros_like(self._index)
        self._steps = torch.zeros_like(self._index[0])
        self._lost = torch.zeros_like(self._index[0])
        fresh_goal = None if goals is None else torch.empty_like(goals)
        self._fresh_worlds: Worlds = (
            torch.empty_like(batch[0]),
            torch.empty_like(batch[1]),
            fresh_goal,
        )
        worlds = registered(self.random.worlds)
        self._draw = (
            GraphedCallable(self._draw_worlds, device, worlds) if graphed else self._draw_worlds
        )
        self._keep = GraphedCallable(self._keep_worlds, device) if graphed else self._keep_worlds
        self._note = (
            GraphedCallable(self._note_iteration, device) if graphed else self._note_iteration
        )

    def run(self, iteration: int, share: float = 0.0) -> int:
        """Train for one iteration, and return the steps of its rollout, T.

        Args:
            share: As for `TrainConfig.learning_rate_at`.
        """
        config, batch = self._config, self.batch
        lo, hi = config.steps
        steps = int(torch.randint(lo, hi, (), generator=self.random.schedule))
        self.task.begin(iteration)
        self._draw()
        if not config.ages and iteration % config.seed_interval == 0:
            self._begin_anew(self._fresh[iteration // config.seed_interval % len(self._fresh)])
        batch.run(steps)
        self.meter.begin(iteration + 1, steps)
        self._steps.fill_(steps)
        self._keep()
        # Between two graphs: what NCCL does is then watched for processes that do not answer.
        self._ranks.reduce([*batch.gradients, batch.terms], self._lost)
        self._note()
        self.optimiser.step(iteration, share)
        return steps

    @property
    def pool_bytes(self) -> int:
        """Bytes of the pool's worlds, of this process."""
        return self.pool.x.nbytes + self.pool.s.nbytes

    def state_dict(self) -> dict[str, Any]:
        """Return all that changes but the rule, for a checkpoint; of all processes on the first."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "pool": {
                name: self._ranks.collected(tensor, self._section)
                for name, tensor in self._pooled()
                if tensor is not None
            },
            "meter": self.meter.state_dict(),
            "random_states": self.random.state_dict(),
        }

    def state_like(self, iteration: int) -> dict[str, Any]:
        """Return what `state_dict` has after so many iterations, with other numbers in it."""
        optimiser = {"state": self.optimiser.moments_like()} if iteration > 0 else {"state": {}}
        whole = self._config.pool_size
        pool = {
            name: tensor[:1].expand(whole, *tensor.shape[1:])
            for name, tensor in self._pooled()
            if tensor is not None
        }
        return {
            "optimiser": optimiser,
            "pool": pool,
            "meter": self.meter.state_dict(),
            "random_states": self.random.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Go on after so many iterations from what `state_dict` returned; before the first one."""
        self.optimiser.load_state_dict(state["optimiser"])
        for name, tensor in self._pooled():
            if tensor is not None:
                tensor.copy_(self._ranks.own(state["pool"][name], self._section))
        self.meter.load_state_dict(state["meter"])
        self.random.load_state_dict(state["random_states"], iteration)

    @torch.no_grad()
    def _draw_worlds(self) -> None:
        """Fill the batch from the pool, and have seeds at hand."""
        config, worlds = self._config, self.random.worlds
        restart(worlds, self.random.masks)
        self._index.copy_(self.pool.sample(len(self._index), worlds))
        x0, s0, goal = self.pool.read(self._index)
        hit = self._places_hurt()
        if config.ages:
            age, over = self.pool.ages_of(self._index)
            self._age.copy_(age.masked_fill(over, 0))
            self.batch.grown.copy_((self._age >= config.stillness_min_age) & ~hit)
        if config.damage_and_keep_share > 0.0:
            again = over & (
                uniform_draws(worlds, (len(over), 1), x0)[:, 0] < config.damage_and_keep_share
            )
            over, hit = over & ~again, hit | again
        if config.damages:
            x0, s0, goal = self._damaged(x0, s0, goal, hit)
        # Drawn in every iteration, needed or not: nobody on the host knows which worlds run away.
        fresh = self._seeds(len(self._index), worlds)
        for kept, made in zip(self._fresh_worlds, fresh, strict=True):
            if kept is not None and made is not None:
                kept.copy_(made)
        if config.ages:
            x0, s0, goal = chosen(over, fresh, (x0, s0, goal))
        self.batch.x0.copy_(x0)
        self.batch.s0.copy_(s0)
        if goal is not None:
            self.batch.aim(goal)

    def _damaged(self, x: Tensor, s: Tensor, goal: Tensor | None, hit: Tensor) -> Worlds:
        """Return worlds of the pool damaged, those that are hit, bool, shape [B]."""
        damaged = self.task.damage(x, s, goal, self.random.worlds)
        return damaged if self._config.damage_share == 1.0 else chosen(hit, damaged, (x, s, goal))

    def _places_hurt(self) -> Tensor:
        """Return whether the batch's worlds come from places damaged each time, shape [B]."""
        return self._places[self._index] < self._config.damage_share * self._config.pool_size

    def _begin_anew(self, index: Tensor) -> None:
        """Let some worlds of the batch, int64, shape [M], be fresh seeds."""
        begun = self.batch.x0, self.batch.s0, self.batch.goal
        for own, fresh in zip(begun, self._fresh_worlds, strict=True):
            if own is not None and fresh is not None:
                own.index_copy_(0, index, fresh.index_select(0, index))

    @torch.no_grad()
    def _keep_worlds(self) -> None:
        """Put the batch back into the pool."""
        worlds = self.batch.x, self.batch.s, self.batch.goal
        age = self._age + self._steps if self._config.ages else None
        self._lost += self.pool.write(self._index, worlds, self._fresh_worlds, age).sum()

    @torch.no_grad()
    def _note_iteration(self) -> None:
        """Take note of what the batch of all processes came to, and prepare its gradients."""
        self.meter.observe(self._lost)
        self._lost.zero_()
        self.optimiser.prepare_gradients()

    def _seeds(self, world_count: int, random: Randomness) -> Worlds:
        dtype = self._config.torch_dtype
        x, s, goal = self.task.seed(world_count, generator=random, device=random.device)
        lo, hi = map(math.log, self._config.vary_eps)
        if (lo, hi) != (0.0, 0.0):
            # Scaling positions and ε alike is a symmetry: a larger ε is a smaller disk.
            share = (
                random.uniform(1)[:, 0]
                if isinstance(random, WorldRandom)
                else torch.rand(world_count, generator=random, device=random.device)
            )
            x = x * torch.exp(-lo - (hi - lo) * share)[:, None, None]
        return x.to(dtype), s.to(dtype), goal

    def _pooled(self) -> list[tuple[str, Tensor | None]]:
        pool = self.pool
        return [("x", pool.x), ("s", pool.s), ("goal", pool.goal), ("age", pool.age)]


def chosen(which: Tensor, worlds: Worlds, others: Worlds) -> Worlds:
    """Return `worlds` where `which`, bool, shape [B], and the others elsewhere."""
    (x, s, goal), (other_x, other_s, other_goal) = worlds, others
    mask = which[:, None, None]
    if goal is not None and other_goal is not None:
        goal = torch.where(which, goal, other_goal)
    return torch.where(mask, x, other_x), torch.where(mask, s, other_s), goal


def _check_varied_eps(task: Task, rule: NPARule, config: TrainConfig[Any]) -> None:
    if config.vary_eps == (1.0, 1.0):
        return
    if not isinstance(rule, NPARule):
        raise NPAError("vary_eps is for runs of one rule, got several: leave it out")
    if task.box is not None or rule.static:
        raise NPAError(
            "vary_eps needs particles that move in open space, got a task in a box or whose "
            "particles stay: leave it out"
        )
    if rule.divides:
        raise NPAError(
            "vary_eps needs seeds of more than one particle, whose size it varies, got a rule that "
            "divides: leave it out"
        )
