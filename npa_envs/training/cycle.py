"""The training cycle: worlds from the pool, rollout, gradients, worlds back, optimiser step.

No method waits for the device. An iteration runs eagerly or as CUDA graphs; its statistics
stay on the device until a line of the log needs them.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor, nn

import npa_envs.world.rollout
from npa_envs.errors import NPAError
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.iteration import EagerIteration, GraphedIteration, Rollout
from npa_envs.training.loss_statistics import LossStatistics
from npa_envs.training.optimiser import RuleOptimiser, normalise_gradients
from npa_envs.training.process_group import (
    ALONE,
    ProcessGroup,
    RunRandomness,
    begin_episodes,
    generator_to_register,
)
from npa_envs.world.cuda_graph import GraphedCallable
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom, uniform_draws

LARGEST_VALUE = 10.0
"""A world with a larger |x| or |s| has diverged and is replaced by a seed."""


class WorldPool:
    """Worlds that are stored on the device between batches, so that a rule learns to be stable.

    Args:
        worlds: The W worlds of this process.
        max_age_range: Lifetimes of the first and the last world [steps]; those between are spaced
            geometrically. None: worlds have no lifetime.
        indices: Indices of these worlds among the `total` of all processes, int64, shape [W].
    """

    def __init__(
        self,
        worlds: Particles,
        *,
        max_age_range: tuple[int, int] | None = None,
        indices: Tensor | slice = slice(None),
        total: int | None = None,
    ) -> None:
        self.worlds = worlds
        self.age: Tensor | None = None
        """Steps since the seed, or since the damage before another lifetime, int64, [W], or
        None."""
        self.lifetime: Tensor | None = None
        """Age at which each world is replaced or damaged [steps], int64, shape [W], or None."""
        x = worlds.x
        if max_age_range is not None:
            self.age = torch.zeros_like(x[:, 0, 0], dtype=torch.int64)
            lo, hi = map(math.log, max_age_range)
            logarithms = torch.linspace(lo, hi, total or len(x), dtype=torch.float64)
            self.lifetime = logarithms[indices].exp().round().to(x.device, torch.int64)

    def tensors(self) -> dict[str, Tensor]:
        """Return the worlds' tensors and their ages by name, for a checkpoint."""
        tensors = self.worlds._asdict() | {"age": self.age}
        return {name: value for name, value in tensors.items() if value is not None}

    def sample(self, world_count: int, generator: torch.Generator) -> Tensor:
        """Return indices of B different worlds, drawn from the whole pool, shape [B]."""
        # The largest of random numbers: unlike randperm, one short kernel and no host copy.
        return self._keys(generator).topk(world_count).indices

    def sample_sections(self, world_count: int, random: Randomness) -> Tensor:
        """Return indices of B worlds, one drawn from each of B equal sections, shape [B]."""
        size = len(self.worlds.x) // world_count
        first = torch.arange(0, size * world_count, size, device=self.worlds.x.device)
        if isinstance(random, WorldRandom):
            return first + random.integers(size, 1)[:, 0]
        return first + self._keys(random).view(world_count, size).argmax(dim=1)

    def _keys(self, generator: torch.Generator) -> Tensor:
        return torch.rand(len(self.worlds.x), generator=generator, device=self.worlds.x.device)

    def ages_of(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return ages [steps] of worlds, and whether their lifetimes are over, shape [B] each."""
        assert self.age is not None
        assert self.lifetime is not None
        age = self.age.index_select(0, index)
        return age, age >= self.lifetime.index_select(0, index)

    def write(
        self, index: Tensor, worlds: Particles, fresh: Particles, age: Tensor | None = None
    ) -> Tensor:
        """Store worlds and their ages, or `fresh` worlds in place of those that have diverged.

        Returns which worlds were replaced, bool, shape [B].
        """
        largest_x, largest_s = (
            torch.linalg.vector_norm(values.flatten(1), math.inf, dim=1)
            for values in (worlds.x, worlds.s)
        )
        # A comparison with NaN is false, so worlds that are not finite are replaced too.
        diverged = ~(torch.maximum(largest_x, largest_s) <= LARGEST_VALUE)
        self.worlds.put_(index, fresh.where(diverged, worlds))
        if self.age is not None and age is not None:
            self.age.index_copy_(0, index, age.masked_fill(diverged, 0))
        return diverged


class TrainingCycle:
    """One iteration of training, and all of its state but the rule.

    `per_world_streams`: see `RunRandomness`. Each world of the batch then comes from its own
    section of the pool.
    """

    def __init__(
        self,
        task: Task,
        rule: nn.Module,
        config: TrainConfig[Any],
        device: torch.device,
        schedule: torch.Generator,
        rollout: Rollout | None = None,
        *,
        processes: ProcessGroup = ALONE,
        per_world_streams: bool = False,
    ) -> None:
        self.task = task.for_rule(rule) if isinstance(rule, NPARule) else task
        _check_varied_eps(self.task, rule, config)
        self._config = config
        self._processes = processes
        self._per_world_streams = per_world_streams
        self._section = config.pool_size
        """Worlds in a section of the pool; without per-world streams there is one section."""
        if per_world_streams:
            processes.check(config)
            self._section = config.pool_size // config.world_count
        self.random = RunRandomness(
            config, device, schedule, processes, per_world_streams=per_world_streams
        )
        pool_indices = processes.indices(config.pool_size, self._section)
        batch_indices = processes.indices(config.world_count)
        self._pool_indices = pool_indices.to(device)
        self._batch_indices = batch_indices.to(device)
        seeds = self._seeds(len(pool_indices), self.random.pool)
        self.pool = WorldPool(
            seeds,
            max_age_range=config.max_age_range if config.ages else None,
            indices=pool_indices,
            total=config.pool_size,
        )
        count = len(batch_indices)
        batch = seeds.map(lambda value: value[:count])
        graphed = device.type == "cuda" and config.cuda_graph
        cls = GraphedIteration if graphed else EagerIteration
        self.iteration: EagerIteration = cls(
            self.task,
            rule,
            config,
            batch,
            self.random.masks,
            npa_envs.world.rollout.rollout_particles if rollout is None else rollout,
            take_means=None if processes.count == 1 else processes.reduce,
        )
        self.optimiser = RuleOptimiser(self.iteration.parameters, config, rule)
        self.statistics = LossStatistics(self.iteration)
        self._index = torch.zeros(count, dtype=torch.int64, device=device)
        self._age = torch.zeros_like(self._index)
        self._steps = torch.zeros_like(self._index[0])
        self._replaced = torch.zeros_like(self._index[0])
        self._fresh_worlds = batch.map(torch.empty_like)
        graph = functools.partial(GraphedCallable, device=device, captured=graphed)
        self._draw = graph(self._draw_worlds, generator=generator_to_register(self.random.worlds))
        self._store = graph(self._store_worlds)
        self._record = graph(self._record_iteration)

    def run(self, number: int, least_progress: float = 0.0) -> int:
        """Train for one iteration, after `number` others; return the steps of its rollout.

        least_progress: Lower bound on the progress of the learning rate's schedule, in [0, 1].
        """
        iteration = self.iteration
        lo, hi = self._config.steps
        steps = int(torch.randint(lo, hi, (), generator=self.random.schedule))
        self.task.begin(number)
        self._draw()
        is_fresh = self._seeded_worlds(number)
        if is_fresh is not None:
            iteration.start.copy_(self._fresh_worlds.where(is_fresh, iteration.start))
        iteration.run(steps)
        self.statistics.begin(number + 1, steps)
        self._steps.fill_(steps)
        self._store()
        # Not inside a graph: torch watches NCCL only there for processes that do not answer.
        self._processes.reduce([*iteration.gradients, iteration.terms], self._replaced)
        self._record()
        self.optimiser.step(number, least_progress)
        return steps

    def _seeded_worlds(self, number: int) -> Tensor | None:
        """Return which worlds of the batch start as fresh seeds, bool, shape [B]; None: none.

        Every `seed_interval` iterations there are `fresh_count` of them: the first of the batch.
        With per-world streams each world of the batch stays in its own section of the pool. Then
        the seeds are the first `fresh_count` worlds, the next time the next `fresh_count`, and so
        on, so that seeds come into all sections.
        """
        config = self._config
        if config.ages or number % config.seed_interval != 0:
            return None
        first = 0
        if self._per_world_streams:
            groups = math.ceil(config.world_count / config.fresh_count)
            first = number // config.seed_interval % groups * config.fresh_count
        return (self._batch_indices - first) % config.world_count < config.fresh_count

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint without the rule, on rank 0 of all processes."""
        pool = {
            name: self._processes.gathered(local, self._section)
            for name, local in self.pool.tensors().items()
        }
        return {
            "optimiser": self.optimiser.state_dict(),
            "pool": pool,
            "statistics": self.statistics.state_dict(),
            "random_states": self.random.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Restore what `state_dict` returned after `iteration` iterations; call before `run`."""
        self.optimiser.load_state_dict(state["optimiser"])
        for name, local in self.pool.tensors().items():
            local.copy_(self._processes.local(state["pool"][name], self._section))
        self.statistics.load_state_dict(state["statistics"])
        self.random.load_state_dict(state["random_states"], iteration)

    @torch.no_grad()
    def _draw_worlds(self) -> None:
        """Copy worlds from the pool to the batch, some damaged or replaced by fresh seeds."""
        config, worlds = self._config, self.random.worlds
        begin_episodes(worlds, self.random.masks)
        by_section = config.ages or isinstance(worlds, WorldRandom)
        sample: Any = self.pool.sample_sections if by_section else self.pool.sample
        self._index.copy_(sample(len(self._index), worlds))
        start = self.pool.worlds.take(self._index)
        damaged = self._pool_indices[self._index] < config.damage_share * config.pool_size
        expired = None
        if config.ages:
            age, expired = self.pool.ages_of(self._index)
            self._age.copy_(age.masked_fill(expired, 0))
            self.iteration.past_min_age.copy_((self._age >= config.stillness_min_age) & ~damaged)
            if config.damage_and_keep_share > 0.0:
                chance = uniform_draws(worlds, (len(expired), 1), start.x)[:, 0]
                renewed = expired & (chance < config.damage_and_keep_share)
                expired, damaged = expired & ~renewed, damaged | renewed
        if config.damages:
            after = self.task.damage(start, worlds)
            start = after if config.damage_share == 1.0 else after.where(damaged, start)
        # Drawn in every iteration: the CPU does not know which worlds will diverge.
        fresh = self._seeds(len(self._index), worlds)
        self._fresh_worlds.copy_(fresh)
        if expired is not None:
            start = fresh.where(expired, start)
        self.iteration.start.copy_(start)

    @torch.no_grad()
    def _store_worlds(self) -> None:
        age = self._age + self._steps if self._config.ages else None
        replaced = self.pool.write(self._index, self.iteration.end, self._fresh_worlds, age)
        self._replaced += replaced.sum()

    @torch.no_grad()
    def _record_iteration(self) -> None:
        """Add the iteration's losses to the statistics, and normalise the gradients."""
        self.statistics.add(self._replaced)
        self._replaced.zero_()
        normalise_gradients(self.iteration.gradients)

    def _seeds(self, world_count: int, random: Randomness) -> Particles:
        dtype = self._config.torch_dtype
        seeds = self.task.seed(world_count, generator=random, device=random.device)
        lo, hi = map(math.log, self._config.vary_eps)
        if (lo, hi) != (0.0, 0.0):
            # Dividing positions by a factor is equivalent to multiplying ε by it.
            fraction = uniform_draws(random, (world_count, 1), seeds.x)[:, :, None]
            seeds = seeds._replace(x=seeds.x * torch.exp(-lo - (hi - lo) * fraction))
        return seeds._replace(x=seeds.x.to(dtype), s=seeds.s.to(dtype))


def _check_varied_eps(task: Task, rule: nn.Module, config: TrainConfig[Any]) -> None:
    if config.vary_eps == (1.0, 1.0):
        return
    if not isinstance(rule, NPARule):
        raise NPAError("vary_eps is for runs of one rule, got several: leave it out")
    reasons = {
        "a periodic box": task.box is not None,
        "particles that stay": rule.static,
        "a rule that divides, whose seeds are single particles": rule.divides,
    }
    for reason, applies in reasons.items():
        if applies:
            raise NPAError(
                f"vary_eps needs particles that move in open space, got {reason}: leave it out"
            )
