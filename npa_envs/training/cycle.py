"""The training cycle: worlds from the pool, rollout, gradients, worlds back, optimiser step.

No method waits for the device. An iteration is launched kernel by kernel or replayed as CUDA
graphs; its statistics stay on the device until a line of the log needs them.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor, nn

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
from npa_envs.world.rollout import rollout_particles

LARGEST_VALUE = 10.0
"""A world with a larger |x| [length units] or |s| has diverged; a start world replaces it."""


class WorldPool:
    """Worlds that are stored on the device between batches, so that a rule learns to be stable.

    Args:
        worlds: The W worlds of this process.
        max_age_range: Lifetimes of the first and the last world [steps]; lifetimes between them are
            spaced geometrically. None: worlds have no lifetime.
        indices: Indices of these worlds among those of all processes, int64, shape [W].
        total: Number of worlds of all processes; None: W.
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
        """Steps since the start world, or the last damage that ended a lifetime, int64, [W]."""
        self.lifetime: Tensor | None = None
        """Age at which each world is replaced or damaged [steps], int64, shape [W]."""
        self.wounds: Tensor | None = None
        """Pixels that each world's last damage changed, uint8, [W, R, R]; None: not needed."""
        x = worlds.x
        if max_age_range is not None:
            self.age = torch.zeros_like(x[:, 0, 0], dtype=torch.int64)
            lo, hi = map(math.log, max_age_range)
            logarithms = torch.linspace(lo, hi, total or len(x), dtype=torch.float64)
            self.lifetime = logarithms[indices].exp().round().to(x.device, torch.int64)

    def tensors(self) -> dict[str, Tensor]:
        """Return the worlds' tensors and their ages by name, for a checkpoint."""
        tensors = self.worlds._asdict() | {"age": self.age, "wounds": self.wounds}
        return {name: value for name, value in tensors.items() if value is not None}

    def sample(self, world_count: int, generator: torch.Generator) -> Tensor:
        """Return indices of B different worlds, drawn from the whole pool, int64, shape [B]."""
        # The largest of random numbers: unlike randperm, one short kernel and no host copy.
        return self._keys(generator).topk(world_count).indices

    def sample_sections(self, world_count: int, random: Randomness) -> Tensor:
        """Return indices of B worlds, one drawn from each of B equal sections, int64, shape [B]."""
        size = len(self.worlds.x) // world_count
        first = torch.arange(0, size * world_count, size, device=self.worlds.x.device)
        if isinstance(random, WorldRandom):
            return first + random.integers(size, 1)[:, 0]
        return first + self._keys(random).view(world_count, size).argmax(dim=1)

    def _keys(self, generator: torch.Generator) -> Tensor:
        return torch.rand(len(self.worlds.x), generator=generator, device=self.worlds.x.device)

    def ages_of(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return ages [steps] of worlds by index, and which have reached their lifetimes, [B]."""
        assert self.age is not None
        assert self.lifetime is not None
        age = self.age.index_select(0, index)
        return age, age >= self.lifetime.index_select(0, index)

    def write(
        self,
        index: Tensor,
        worlds: Particles,
        replacements: Particles,
        age: Tensor | None = None,
        wounds: Tensor | None = None,
    ) -> Tensor:
        """Store B worlds with ages and wounds at `index`, replacements where one has diverged.

        Returns which worlds were replaced, bool, shape [B].
        """
        largest_x, largest_s = (
            torch.linalg.vector_norm(values.flatten(1), math.inf, dim=1)
            for values in (worlds.x, worlds.s)
        )
        # A comparison with NaN is false, so worlds that are not finite are replaced too.
        diverged = ~(torch.maximum(largest_x, largest_s) <= LARGEST_VALUE)
        self.worlds.put_(index, replacements.where(diverged, worlds))
        if self.age is not None and age is not None:
            self.age.index_copy_(0, index, age.masked_fill(diverged, 0))
        if self.wounds is not None and wounds is not None:
            wounds = wounds.masked_fill(diverged[:, None, None], 0)
            self.wounds.index_copy_(0, index, wounds)
        return diverged


class TrainingCycle:
    """The iterations of a training run, and all of their state except the rule.

    `run_generator` draws numbers of steps. With `per_world_streams`, see `RunRandomness`, each
    world of the batch comes from its own section of the pool.
    """

    def __init__(
        self,
        task: Task,
        rule: nn.Module,
        config: TrainConfig[Any],
        device: torch.device,
        run_generator: torch.Generator,
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
            config, device, run_generator, processes, per_world_streams=per_world_streams
        )
        indices = processes.indices(config.pool_size, self._section)
        worlds = self._make_start_worlds(len(indices), self.random.pool)
        self._pool_indices = indices.to(worlds.x.device)
        ages = config.max_age_range if config.ages else None
        self.pool = WorldPool(worlds, max_age_range=ages, indices=indices, total=config.pool_size)
        self._batch_indices = processes.indices(config.world_count).to(device)
        first_worlds = self.pool.worlds.map(lambda value: value[: len(self._batch_indices)])
        graphed = device.type == "cuda" and config.cuda_graph
        cls = GraphedIteration if graphed else EagerIteration
        self.batch: EagerIteration = cls(
            self.task,
            rule,
            config,
            first_worlds,
            self.random.masks,
            rollout_particles if rollout is None else rollout,
            take_means=None if processes.count == 1 else processes.reduce,
        )
        if self.batch.wounds is not None:
            shape = len(self.pool.worlds.x), *self.batch.wounds.shape[1:]
            self.pool.wounds = self.batch.wounds.new_zeros(shape)
        self.optimiser = RuleOptimiser(self.batch.parameters, config, rule)
        self.statistics = LossStatistics(self.batch)
        # What graphs share: `_draw_worlds` writes the batch's indices in the pool, ages and start
        # worlds; `_store_worlds` reads these and `_steps`, and adds to `_replaced`.
        self._index, self._age = (torch.zeros_like(self._batch_indices) for _ in range(2))
        self._steps, self._replaced = (torch.zeros_like(self._index[0]) for _ in range(2))
        self._start_worlds = first_worlds.map(torch.empty_like)
        graph = functools.partial(GraphedCallable, device=device, captured=graphed)
        draws_from = generator_to_register(self.random.worlds)
        self._graphed_draw = graph(self._draw_worlds, generator=draws_from)
        self._graphed_store = graph(self._store_worlds)
        self._graphed_record = graph(self._record_iteration)

    def run(self, number: int, least_progress: float = 0.0) -> int:
        """Train for iteration `number`, from 0 on, and return the number of its rollout's steps.

        `least_progress` is the least progress of the learning rate's schedule, in [0, 1].
        """
        lo, hi = self._config.steps
        steps = int(torch.randint(lo, hi, (), generator=self.random.run))
        self.task.begin(number)
        self._graphed_draw()
        restarted = self._restarted_worlds(number)
        if restarted is not None:
            self.batch.start.copy_(self._start_worlds.where(restarted, self.batch.start))
        self.batch.run(steps)
        self.statistics.begin(number + 1, steps)
        self._steps.fill_(steps)
        self._graphed_store()
        # Not inside a graph: torch watches NCCL only there for processes that do not answer.
        self._processes.reduce([*self.batch.gradients, self.batch.terms], self._replaced)
        self._graphed_record()
        self.optimiser.step(number, least_progress)
        return steps

    def _restarted_worlds(self, number: int) -> Tensor | None:
        """Return which worlds of the batch a start world replaces, bool, shape [B]; None: none.

        Every `seed_interval` iterations there are `fresh_count` of them: the first of the batch.
        With per-world streams, where each world stays in its own section of the pool, they are the
        next `fresh_count` worlds each time, so that start worlds come into all sections.
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
        """Return the state without the rule for a checkpoint; on rank 0 with the whole pool."""
        local = self.pool.tensors().items()
        pool = {name: self._processes.gathered(each, self._section) for name, each in local}
        return {
            "optimiser": self.optimiser.state_dict(),
            "pool": pool,
            "statistics": self.statistics.state_dict(),
            "random_states": self.random.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Restore the result of `state_dict` after `iteration` iterations; call it before `run`."""
        self.optimiser.load_state_dict(state["optimiser"])
        for name, local in self.pool.tensors().items():
            local.copy_(self._processes.local(state["pool"][name], self._section))
        self.statistics.load_state_dict(state["statistics"])
        self.random.load_state_dict(state["random_states"], iteration)

    @torch.no_grad()
    def _draw_worlds(self) -> None:
        """Copy worlds from the pool to the batch, some damaged or replaced by start worlds."""
        config, random = self._config, self.random.worlds
        begin_episodes(random, self.random.masks)
        by_section = config.ages or self._per_world_streams
        sample: Any = self.pool.sample_sections if by_section else self.pool.sample
        self._index.copy_(sample(len(self._index), random))
        before = worlds = self.pool.worlds.take(self._index)
        damaged, expired = self._damaged_and_expired(worlds)
        if config.damages:
            after = self.task.damage(worlds, random)
            worlds = after if config.damage_share == 1.0 else after.where(damaged, worlds)
        # Drawn in every iteration: the CPU does not know which worlds will diverge.
        start_worlds = self._make_start_worlds(len(self._index), random)
        self._start_worlds.copy_(start_worlds)
        if expired is not None:
            worlds = start_worlds.where(expired, worlds)
        self.batch.start.copy_(worlds)
        if self.batch.wounds is not None and self.pool.wounds is not None:
            wounds = self.task.wounds_between(before, worlds)
            assert wounds is not None, "wounds of a picture"
            assert expired is not None, "a weight of wounds needs max_age_range"
            old = self.pool.wounds.index_select(0, self._index)
            hurt = wounds.amax((1, 2), keepdim=True) > 0
            wounds = torch.where(hurt, wounds, old)
            self.batch.wounds.copy_(wounds.masked_fill(expired[:, None, None], 0))

    def _damaged_and_expired(self, worlds: Particles) -> tuple[Tensor, Tensor | None]:
        """Return which worlds of the batch to damage, and which to replace; set all ages."""
        config = self._config
        number = self._pool_indices[self._index]
        damaged = number < config.damage_share * config.pool_size
        if not config.ages:
            return damaged, None
        age, expired = self.pool.ages_of(self._index)
        self._age.copy_(age.masked_fill(expired, 0))
        if config.wound_chance > 0.0:
            chance = uniform_draws(self.random.worlds, (len(expired), 1), worlds.x)[:, 0]
            # The other half of the pool grows old unharmed, or rules would forget to last.
            hit = (chance < config.wound_chance) & (number % 2 == 1)
            damaged |= hit & (self._age >= config.wound_min_age)
        self.batch.past_min_age.copy_((self._age >= config.stillness_min_age) & ~damaged)
        if config.damage_and_keep_share > 0.0:
            chance = uniform_draws(self.random.worlds, (len(expired), 1), worlds.x)[:, 0]
            kept = expired & (chance < config.damage_and_keep_share)
            expired, damaged = expired & ~kept, damaged | kept
        return damaged, expired

    @torch.no_grad()
    def _store_worlds(self) -> None:
        age = self._age + self._steps if self._config.ages else None
        written = self._index, self.batch.end, self._start_worlds, age, self.batch.wounds
        replaced = self.pool.write(*written)
        self._replaced += replaced.sum()

    @torch.no_grad()
    def _record_iteration(self) -> None:
        """Add the iteration's losses to the statistics, and normalise the gradients."""
        self.statistics.add(self._replaced)
        self._replaced.zero_()
        normalise_gradients(self.batch.gradients)

    def _make_start_worlds(self, world_count: int, random: Randomness) -> Particles:
        dtype = self._config.torch_dtype
        worlds = self.task.seed(world_count, generator=random, device=random.device)
        lo, hi = map(math.log, self._config.vary_eps)
        if (lo, hi) != (0.0, 0.0):
            # Dividing positions by a factor is equivalent to multiplying ε by it.
            fraction = uniform_draws(random, (world_count, 1), worlds.x)[:, :, None]
            worlds = worlds._replace(x=worlds.x * torch.exp(-lo - (hi - lo) * fraction))
        return worlds._replace(x=worlds.x.to(dtype), s=worlds.s.to(dtype))


def _check_varied_eps(task: Task, rule: nn.Module, config: TrainConfig[Any]) -> None:
    if config.vary_eps == (1.0, 1.0):
        return
    if not isinstance(rule, NPARule):
        raise NPAError("vary_eps is for runs of one rule, got several: leave it out")
    reasons = {
        "a periodic box": task.box is not None,
        "particles that stay": rule.static,
        "a rule that divides, whose start worlds are single particles": rule.divides,
    }
    for reason, applies in reasons.items():
        if applies:
            raise NPAError(
                f"vary_eps needs particles that move in open space, got {reason}: leave it out"
            )
