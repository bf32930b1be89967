"""The cycle of training: worlds from a pool, rollout, gradients, worlds back, optimiser's step.

No method waits for the device. An iteration runs eagerly, or as CUDA graphs; what happened is
kept on the device until a line of the log asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import npa_envs.world.rollout
from npa_envs.errors import NPAError
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.iteration import EagerIteration, GraphedIteration, LossMeter, Rollout
from npa_envs.training.optimiser import RuleOptimiser
from npa_envs.training.ranks import Ranks, RunRandomness, registered, restart
from npa_envs.world.cuda_graph import GraphedCallable
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom, uniform_draws

RUNAWAY_LIMIT = 10.0
"""A world with a larger |x| or |s| is replaced by a seed."""


class WorldPool:
    """Worlds that live on between batches, on the device, so that a rule learns to be stable.

    Args:
        runaway_limit: A world with a larger |x| or |s|, or one that is not finite, is not kept.
        max_age_range: Steps that the world in the first place lives, and that in the last, all
            others between; None: for ever.
        places: Places of these worlds among those of all processes, int64, shape [W]; None: they
            are all.
    """

    def __init__(
        self,
        worlds: Particles,
        *,
        runaway_limit: float,
        max_age_range: tuple[int, int] | None = None,
        places: Tensor | None = None,
        total: int | None = None,
    ) -> None:
        self.worlds = worlds
        self.age: Tensor | None = None
        """Steps since the seed, or since a life began by damage, int64, shape [W], or None."""
        self.lifetime: Tensor | None = None
        """Age at which the world of each place has lived, int64, shape [W], or None."""
        x = worlds.x
        if max_age_range is not None:
            self.age = torch.zeros_like(x[:, 0, 0], dtype=torch.int64)
            lo, hi = map(math.log, max_age_range)
            logarithms = torch.linspace(lo, hi, total or len(x), dtype=torch.float64)
            own = logarithms if places is None else logarithms[places]
            self.lifetime = own.exp().round().to(x.device, torch.int64)
        self._runaway_limit = runaway_limit

    def tensors(self) -> dict[str, Tensor]:
        """Return all that changes, by name."""
        held = self.worlds._asdict() | {"age": self.age}
        return {name: value for name, value in held.items() if value is not None}

    def sample(self, world_count: int, generator: Randomness) -> Tensor:
        """Draw the indices, shape [B], of different worlds: one of each of B equal sections.

        From a generator and where they have no max_age_range, B of all worlds instead.
        """
        whole, device = len(self.worlds.x), self.worlds.x.device
        size = whole // world_count
        first = torch.arange(0, size * world_count, size, device=device)
        if isinstance(generator, WorldRandom):
            return first + generator.integers(size, 1)[:, 0]
        # The largest of random numbers: unlike randperm, one short kernel and no host copy.
        keys = torch.rand(whole, generator=generator, device=device)
        if self.age is None:
            return keys.topk(world_count).indices
        return first + keys.view(world_count, size).argmax(dim=1)

    def ages_of(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return worlds' ages, and which have reached their `max_age_range`, shape [B] each."""
        assert self.age is not None, "made with max_age_range"
        assert self.lifetime is not None, "made with max_age_range"
        age = self.age.index_select(0, index)
        return age, age >= self.lifetime.index_select(0, index)

    def write(
        self, index: Tensor, worlds: Particles, fresh: Particles, age: Tensor | None = None
    ) -> Tensor:
        """Put worlds of such ages back, and fresh ones for those that are not finite or run away.

        Returns which were replaced, shape [B], bool.
        """
        farthest = torch.maximum(_largest(worlds.x), _largest(worlds.s))
        # A comparison with NaN is false, so what is not finite is not kept either.
        keep = farthest <= self._runaway_limit
        self.worlds.put_(index, worlds.where(keep, fresh))
        if self.age is not None and age is not None:
            self.age.index_copy_(0, index, age.masked_fill(~keep, 0))
        return ~keep


def _largest(worlds: Tensor) -> Tensor:
    """Return each world's largest absolute value, NaN where there is one; shape [B]."""
    largest: Tensor = torch.linalg.vector_norm(worlds.flatten(1), math.inf, dim=1)
    return largest


class TrainingCycle:
    """All that changes while a rule is trained.

    `by_world`: each world draws by itself, as several processes need it.
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
        _check_varied_eps(self.task, rule, config)
        self._config = config
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
        self._places = places.to(device)
        worlds = self._seeds(len(places), self.random.pool)
        self.pool = WorldPool(
            worlds,
            runaway_limit=RUNAWAY_LIMIT,
            max_age_range=config.max_age_range if config.ages else None,
            places=places,
            total=config.pool_size,
        )
        numbers = ranks.places(config.world_count)
        # Where each world of a batch has a part of the pool to itself, they take turns.
        whole, fresh = config.world_count, config.fresh_count
        self._fresh = [
            ((numbers - first) % whole < fresh).nonzero()[:, 0].to(device)
            for first in range(0, whole if by_world else 1, fresh)
        ]
        """Which worlds of a batch begin anew, by turns."""
        count = len(numbers)
        batch = worlds.map(lambda value: value[:count])
        graphed = device.type == "cuda" and config.cuda_graph
        iteration = GraphedIteration if graphed else EagerIteration
        self.batch: EagerIteration = iteration(
            self.task,
            rule,
            config,
            batch,
            self.random.masks,
            npa_envs.world.rollout.rollout if rollout is None else rollout,
            mean_over_processes=None if ranks.count == 1 else ranks.mean,
        )
        self.optimiser = RuleOptimiser(self.batch.parameters, config, rule)
        self.meter = LossMeter(self.batch)
        self._index = torch.zeros(count, dtype=torch.int64, device=device)
        self._age = torch.zeros_like(self._index)
        self._steps = torch.zeros_like(self._index[0])
        self._lost = torch.zeros_like(self._index[0])
        self._fresh_worlds = batch.map(torch.empty_like)
        self._draw, self._keep, self._note = (
            GraphedCallable(function, device, generator, recorded=graphed)
            for function, generator in (
                (self._draw_worlds, registered(self.random.worlds)),
                (self._keep_worlds, None),
                (self._note_iteration, None),
            )
        )

    def run(self, iteration: int, share: float = 0.0) -> int:
        """Train for one iteration, and return the steps of its rollout, T."""
        config, batch = self._config, self.batch
        lo, hi = config.steps
        steps = int(torch.randint(lo, hi, (), generator=self.random.schedule))
        self.task.begin(iteration)
        self._draw()
        if not config.ages and iteration % config.seed_interval == 0:
            index = self._fresh[iteration // config.seed_interval % len(self._fresh)]
            batch.start.put_(index, self._fresh_worlds.take(index))
        batch.run(steps)
        self.meter.begin(iteration + 1, steps)
        self._steps.fill_(steps)
        self._keep()
        # Between two graphs: what NCCL does is then watched for processes that do not answer.
        self._ranks.reduce([*batch.gradients, batch.terms], self._lost)
        self._note()
        self.optimiser.step(iteration, share)
        return steps

    def state_dict(self) -> dict[str, Any]:
        """Return all that changes but the rule, for a checkpoint; of all processes on the first."""
        collected = self._ranks.collected
        return self._state(self.optimiser.state_dict(), lambda own: collected(own, self._section))

    def state_like(self, iteration: int) -> dict[str, Any]:
        """Return what `state_dict` has after so many iterations, with other numbers in it."""
        moments = self.optimiser.moments_like() if iteration > 0 else {}
        whole = self._config.pool_size
        return self._state({"state": moments}, lambda own: own[:1].expand(whole, *own.shape[1:]))

    def _state(
        self, optimiser: dict[str, Any], pooled: Callable[[Tensor], Tensor]
    ) -> dict[str, Any]:
        return {
            "optimiser": optimiser,
            "pool": {name: pooled(own) for name, own in self.pool.tensors().items()},
            "meter": self.meter.state_dict(),
            "random_states": self.random.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Go on after so many iterations from what `state_dict` returned; before the first one."""
        self.optimiser.load_state_dict(state["optimiser"])
        for name, own in self.pool.tensors().items():
            own.copy_(self._ranks.own(state["pool"][name], self._section))
        self.meter.load_state_dict(state["meter"])
        self.random.load_state_dict(state["random_states"], iteration)

    @torch.no_grad()
    def _draw_worlds(self) -> None:
        """Fill the batch from the pool, and have seeds at hand."""
        config, worlds = self._config, self.random.worlds
        restart(worlds, self.random.masks)
        self._index.copy_(self.pool.sample(len(self._index), worlds))
        begun = self.pool.worlds.take(self._index)
        # Worlds from some places are damaged each time.
        hit = self._places[self._index] < config.damage_share * config.pool_size
        if config.ages:
            age, over = self.pool.ages_of(self._index)
            self._age.copy_(age.masked_fill(over, 0))
            self.batch.grown.copy_((self._age >= config.stillness_min_age) & ~hit)
        if config.damage_and_keep_share > 0.0:
            drawn = uniform_draws(worlds, (len(over), 1), begun.x)[:, 0]
            again = over & (drawn < config.damage_and_keep_share)
            over, hit = over & ~again, hit | again
        if config.damages:
            damaged = self.task.damage(begun, worlds)
            begun = damaged if config.damage_share == 1.0 else damaged.where(hit, begun)
        # Drawn in every iteration, needed or not: nobody on the host knows which worlds run away.
        fresh = self._seeds(len(self._index), worlds)
        self._fresh_worlds.copy_(fresh)
        if config.ages:
            begun = fresh.where(over, begun)
        self.batch.start.copy_(begun)

    @torch.no_grad()
    def _keep_worlds(self) -> None:
        age = self._age + self._steps if self._config.ages else None
        lost = self.pool.write(self._index, self.batch.end, self._fresh_worlds, age)
        self._lost += lost.sum()

    @torch.no_grad()
    def _note_iteration(self) -> None:
        """Take note of what the batch of all processes came to, and prepare its gradients."""
        self.meter.observe(self._lost)
        self._lost.zero_()
        self.optimiser.prepare_gradients()

    def _seeds(self, world_count: int, random: Randomness) -> Particles:
        dtype = self._config.torch_dtype
        seeds = self.task.seed(world_count, generator=random, device=random.device)
        lo, hi = map(math.log, self._config.vary_eps)
        if (lo, hi) != (0.0, 0.0):
            # Scaling positions and ε alike is a symmetry: a larger ε is a smaller disk.
            fraction = uniform_draws(random, (world_count, 1), seeds.x)[:, :, None]
            seeds = seeds._replace(x=seeds.x * torch.exp(-lo - (hi - lo) * fraction))
        return seeds._replace(x=seeds.x.to(dtype), s=seeds.s.to(dtype))


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
