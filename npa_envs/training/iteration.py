"""Iterations of training: worlds from a pool, rollout, gradients, worlds back, optimiser's step.

Nothing here waits for the device. An iteration runs eagerly, or as a CUDA graph for each number of
steps; what happened is kept on the device until a line of the log asks for it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypedDict, Unpack

import torch
from torch import Tensor, nn

import npa_envs.world.rollout
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import (
    GoalTask,
    ScheduledTask,
    Task,
    seed_worlds,
    task_for_rule,
    task_toward,
)
from npa_envs.tasks.train_config import AGEING_BLOCK, TrainConfig
from npa_envs.training.randomness import RunRandomness, registered, restart
from npa_envs.training.ranks import Ranks
from npa_envs.world.cuda_graph import Replayed, capture
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.rollout import Memory


class TrainingCycle:
    """All that changes while a rule is trained.

    Args:
        task: What to learn.
        rule: The rule, on the device, in the run's dtype.
        config: How.
        device: Where the worlds are.
        schedule: Randomness of the numbers of steps, on the CPU.
        rollout: The rollout to train through; None is the engine's.
        ranks: The processes that share the run; None: this one alone.
        by_world: Each world draws by itself, as several processes need it.
        beside: A cycle of other worlds that train the same rule: optimiser, averaged weights and
            gradients are shared with it.
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
        beside: TrainingCycle | None = None,
    ) -> None:
        self.task = task_for_rule(task, rule)
        """The task, as it is for worlds of this rule."""
        self._rule = rule
        self._config = config
        self._rollout: Rollout = npa_envs.world.rollout.rollout if rollout is None else rollout
        self._ranks = ranks = Ranks() if ranks is None else ranks
        self._section = config.pool_size // config.world_count if by_world else config.pool_size
        if by_world:
            ranks.check(config)
        places = ranks.places(config.pool_size, self._section)
        old = places >= config.pool_size // 2
        self.random = (
            RunRandomness.by_world(config, device, schedule, ranks, places[old])
            if by_world
            else RunRandomness.of_batch(config, device, schedule)
        )
        """What the run draws from."""
        self._places = places.to(device)
        self._old = old.nonzero()[:, 0].to(device)
        x, s, goal = self._seeds(len(places), self.random.pool)
        lifetimes = config.lifetimes if config.ages else None
        self.pool = WorldPool(
            x,
            s,
            goal,
            runaway_limit=config.runaway_limit,
            lifetimes=lifetimes,
            places=places,
            total=config.pool_size,
        )
        """Worlds of this process that live on between batches."""
        numbers = ranks.places(config.world_count, 1)
        self._fresh_count = int((numbers < config.fresh_count).sum())
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
            gradients=None if beside is None else beside.batch.gradients,
        )
        """Worlds before and after the last rollout, the loss and its gradients."""
        parameters = self.batch.parameters
        self.optimiser: RuleOptimiser = (
            RuleOptimiser(parameters, config) if beside is None else beside.optimiser
        )
        """Changes the rule."""
        self.average: WeightAverage = (
            WeightAverage(parameters, config.average) if beside is None else beside.average
        )
        """The running mean of the weights, where the configuration asks for one."""
        self.meter = LossMeter(self.batch)
        """What happened since the last line of the log."""
        self._index = torch.zeros(count, dtype=torch.int64, device=device)
        self._age = torch.zeros_like(self._index)
        self._steps = torch.zeros_like(self._index[0])
        self._lost = torch.zeros_like(self._index[0])
        self._fresh_x, self._fresh_s = (torch.empty_like(t) for t in batch)
        self._fresh_goal = None if goals is None else torch.empty_like(goals)
        worlds, ageing = registered(self.random.worlds), registered(self.random.ageing)
        self._grow_old = Replayed(self._age_worlds, device, ageing) if graphed else self._age_worlds
        self._draw = Replayed(self._draw_worlds, device, worlds) if graphed else self._draw_worlds
        self._keep = Replayed(self._keep_worlds, device) if graphed else self._keep_worlds
        self._note = Replayed(self._note_iteration, device) if graphed else self._note_iteration

    def run(self, iteration: int) -> int:
        """Train for one iteration, and return the steps of its rollout, T."""
        config, batch = self._config, self.batch
        lo, hi = config.steps
        steps = int(torch.randint(lo, hi, (), generator=self.random.schedule))
        if isinstance(self.task, ScheduledTask):
            self.task.begin(iteration)
        for _ in range(config.ageing_at(iteration) // AGEING_BLOCK):
            if len(self._old) > 0:
                self._grow_old()
        self._draw()
        if not config.ages and iteration % config.seed_interval == 0:
            self._begin_anew(self._fresh_count)
        batch.run(steps)
        self.meter.begin(iteration + 1, steps)
        self._steps.fill_(steps)
        self._keep()
        # Between two graphs: what NCCL does is then watched for processes that do not answer.
        self._ranks.reduce([*batch.gradients, batch.terms], self._lost)
        self._note()
        self.optimiser.step(iteration)
        self.average.update(iteration)
        return steps

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
            **self.average.state_dict(),
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
            **self.average.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Go on after so many iterations from what `state_dict` returned; before the first one."""
        self.optimiser.load_state_dict(state["optimiser"])
        for name, tensor in self._pooled():
            if tensor is not None:
                tensor.copy_(self._ranks.own(state["pool"][name], self._section))
        self.meter.load_state_dict(state["meter"])
        self.average.load_state_dict(state)
        self.random.load_state_dict(state["random_states"], iteration, self._config)

    @torch.no_grad()
    def _age_worlds(self) -> None:
        """Run the worlds of the longer-lived half of the pool for some steps, without gradients."""
        pool, old, random = self.pool, self._old, self.random.ageing
        assert pool.age is not None, "made with lifetimes"
        restart(random)
        x, s, goal = pool.read(old)
        x, s, _ = self._rollout(
            self._rule,
            x,
            s,
            AGEING_BLOCK,
            eps=self.task.eps,
            box=self.task.box,
            update_prob=self.task.update_prob,
            memory=self._config.memory,
            generator=random,
            return_path_length=True,
        )
        fresh_x, fresh_s, fresh_goal = self._seeds(len(old), random)
        goals = None if goal is None or fresh_goal is None else (goal, fresh_goal)
        age = pool.age.index_select(0, old) + AGEING_BLOCK
        self._lost += pool.write(old, x, s, fresh_x, fresh_s, goals, age).sum()

    @torch.no_grad()
    def _draw_worlds(self) -> None:
        """Fill the batch from the pool, and have seeds at hand."""
        config, worlds = self._config, self.random.worlds
        restart(worlds, self.random.masks)
        self._index.copy_(self.pool.sample(len(self._index), worlds))
        x0, s0, goal = self.pool.read(self._index)
        if config.damage:
            x0, s0, goal = self._damaged(x0, s0, goal)
        # Drawn in every iteration, needed or not: nobody on the host knows which worlds run away.
        fresh_x, fresh_s, fresh_goal = self._seeds(len(self._index), worlds)
        self._fresh_x.copy_(fresh_x)
        self._fresh_s.copy_(fresh_s)
        if self._fresh_goal is not None and fresh_goal is not None:
            self._fresh_goal.copy_(fresh_goal)
        if config.ages:
            age, over = self.pool.ages_of(self._index)
            x0, s0 = (
                torch.where(over[:, None, None], fresh, old)
                for fresh, old in ((fresh_x, x0), (fresh_s, s0))
            )
            if goal is not None and fresh_goal is not None:
                goal = torch.where(over, fresh_goal, goal)
            self._age.copy_(age.masked_fill(over, 0))
            grown = (self._age >= config.rest_age) & ~self._places_hurt()
            self.batch.grown.copy_(grown)
        self.batch.x0.copy_(x0)
        self.batch.s0.copy_(s0)
        if goal is not None:
            self.batch.aim(goal)

    def _damaged(
        self, x: Tensor, s: Tensor, goal: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return worlds of the pool damaged, where they are in places of damaged ones."""
        worlds, whole = self.random.worlds, (x, s, goal)
        if isinstance(self.task, GoalTask) and goal is not None:
            x, s, goal = self.task.damage_with_goals(x, s, goal, worlds)
        else:
            x, s = self.task.damage(x, s, worlds)
        if self._config.damage_share < 1.0:
            hit = self._places_hurt()
            x, s = (
                torch.where(hit[:, None, None], hurt, old)
                for hurt, old in ((x, whole[0]), (s, whole[1]))
            )
            if goal is not None and whole[2] is not None:
                goal = torch.where(hit, goal, whole[2])
        return x, s, goal

    def _places_hurt(self) -> Tensor:
        """Return whether the batch's worlds come from places where all are damaged, shape [B]."""
        share = self._config.damage_share if self._config.damage else 0.0
        return self._places[self._index] < share * self._config.pool_size

    def _begin_anew(self, count: int) -> None:
        """Let the first worlds of the batch be fresh seeds."""
        batch = self.batch
        batch.x0[:count], batch.s0[:count] = self._fresh_x[:count], self._fresh_s[:count]
        if batch.goal is not None and self._fresh_goal is not None:
            batch.goal[:count] = self._fresh_goal[:count]

    @torch.no_grad()
    def _keep_worlds(self) -> None:
        """Put the batch back into the pool."""
        batch = self.batch
        goals = None
        if batch.goal is not None and self._fresh_goal is not None:
            goals = batch.goal, self._fresh_goal
        fresh = self._fresh_x, self._fresh_s
        age = self._age + self._steps if self._config.ages else None
        self._lost += self.pool.write(self._index, batch.x, batch.s, *fresh, goals, age).sum()

    @torch.no_grad()
    def _note_iteration(self) -> None:
        """Take note of what the batch of all processes came to, and prepare its gradients."""
        self.meter.observe(self._lost)
        self._lost.zero_()
        self.optimiser.prepare_gradients()

    def _seeds(self, world_count: int, random: Randomness) -> tuple[Tensor, Tensor, Tensor | None]:
        dtype = self._config.torch_dtype
        x, s, goal = seed_worlds(self.task, world_count, generator=random, device=random.device)
        lo, hi = map(math.log, self._config.vary_eps)
        if lo < hi:
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


class WorldPool:
    """Worlds that live on between batches, on the device, so that a rule learns to be stable.

    Args:
        x: Positions of every world [length units], shape [W, N, D], W the pool's size.
        s: States, shape [W, N, C].
        goal: The goal of every world, shape [W], where the task has such.
        runaway_limit: A world with a larger |x| or |s|, or one that is not finite, is not kept.
        lifetimes: Steps that the world in the first place lives, and that in the last, all others
            between; None: for ever.
        places: Places of these worlds among those of all processes, int64, shape [W]; None: they
            are all.
        total: Worlds of all processes; None: W.
    """

    def __init__(
        self,
        x: Tensor,
        s: Tensor,
        goal: Tensor | None = None,
        *,
        runaway_limit: float,
        lifetimes: tuple[int, int] | None = None,
        places: Tensor | None = None,
        total: int | None = None,
    ) -> None:
        self.x = x
        """Positions [length units], shape [W, N, D]."""
        self.s = s
        """States (dimensionless), shape [W, N, C]."""
        self.goal = goal
        """Goals, int64, shape [W], or None."""
        self.age = None if lifetimes is None else torch.zeros_like(x[:, 0, 0], dtype=torch.int64)
        """Steps since the seed, int64, shape [W], or None."""
        self.lifetime: Tensor | None = None
        """Age at which the world of each place has lived, int64, shape [W], or None."""
        if lifetimes is not None:
            lo, hi = map(math.log, lifetimes)
            logarithms = torch.linspace(lo, hi, total or len(x), dtype=torch.float64)
            own = logarithms if places is None else logarithms[places]
            self.lifetime = own.exp().round().to(x.device, torch.int64)
        self._runaway_limit = runaway_limit

    def sample(self, world_count: int, generator: Randomness) -> Tensor:
        """Draw different worlds: one of each of B equal sections.

        From a generator and where they have no lifetimes, B of all worlds instead.

        Returns:
            Their indices, shape [B].
        """
        size = len(self.x) // world_count
        first = torch.arange(0, size * world_count, size, device=self.x.device)
        if isinstance(generator, WorldRandom):
            return first + generator.integers(size, 1)[:, 0]
        # The largest of random numbers: unlike randperm, one short kernel and no host copy.
        keys = torch.rand(len(self.x), generator=generator, device=self.x.device)
        if self.age is None:
            return keys.topk(world_count).indices
        return first + keys.view(world_count, size).argmax(dim=1)

    def ages_of(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return the ages of worlds that have lifetimes, and which have lived, shape [B] each."""
        assert self.age is not None, "made with lifetimes"
        assert self.lifetime is not None, "made with lifetimes"
        age = self.age.index_select(0, index)
        return age, age >= self.lifetime.index_select(0, index)

    def read(self, index: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return copies of the worlds at `index` [B]: x [B, N, D], s [B, N, C] and goals [B]."""
        goal = None if self.goal is None else self.goal.index_select(0, index)
        return self.x.index_select(0, index), self.s.index_select(0, index), goal

    def write(
        self,
        index: Tensor,
        x: Tensor,
        s: Tensor,
        fresh_x: Tensor,
        fresh_s: Tensor,
        goals: tuple[Tensor, Tensor] | None = None,
        age: Tensor | None = None,
    ) -> Tensor:
        """Put worlds back; those that are not finite or run away are replaced by fresh ones.

        Args:
            index: Where to, shape [B].
            x: Positions after the rollout [length units], shape [B, N, D].
            s: States after the rollout, shape [B, N, C].
            fresh_x: Positions of seeds, shape [B, N, D].
            fresh_s: States of seeds, shape [B, N, C].
            goals: Goals of the worlds and of the seeds, shape [B], where the pool has such.
            age: Steps of the worlds since their seeds, int64, shape [B], where they have lifetimes.

        Returns:
            Which worlds were replaced, shape [B], bool.
        """
        farthest = torch.maximum(_largest(x), _largest(s))
        # A comparison with NaN is false, so what is not finite is not kept either.
        keep = farthest <= self._runaway_limit
        mask = keep[:, None, None]
        self.x.index_copy_(0, index, torch.where(mask, x, fresh_x))
        self.s.index_copy_(0, index, torch.where(mask, s, fresh_s))
        if self.goal is not None and goals is not None:
            self.goal.index_copy_(0, index, torch.where(keep, *goals))
        if self.age is not None and age is not None:
            self.age.index_copy_(0, index, age.masked_fill(~keep, 0))
        return ~keep


def _largest(worlds: Tensor) -> Tensor:
    """Return each world's largest absolute value, NaN where there is one; shape [B]."""
    largest: Tensor = torch.linalg.vector_norm(worlds.flatten(1), math.inf, dim=1)
    return largest


WARM_UP_STEPS = 2
"""Steps of the eager rollout that loads every kernel before the first capture."""


class RolloutOptions(TypedDict):
    """What the trainer tells a rollout by name."""

    eps: float
    box: tuple[float, ...] | None
    update_prob: float
    memory: Memory
    generator: Randomness
    return_path_length: Literal[True]


class Rollout(Protocol):
    """`npa_envs.rollout` as the trainer calls it."""

    def __call__(
        self, rule: NPARule, x: Tensor, s: Tensor, steps: int, /, **options: Unpack[RolloutOptions]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions, states and path lengths after `steps` steps."""


class EagerIteration:
    """One iteration up to the gradients, launched kernel by kernel.

    Reads `x0`, `s0`; writes `x`, `s`, `terms` and the `.grad` of every parameter. All of these
    are the same tensors in every iteration: fill them with `copy_`.

    Args:
        task: Gives the loss and the world's constants.
        rule: The rule to differentiate.
        config: Gives the batch size and the rollout's memory mode.
        x: Positions of any batch [length units], shape [B, N, D]: shape, dtype and device count.
        s: States of any batch, shape [B, N, C], likewise.
        generator: Randomness of the update masks, on the worlds' device.
        rollout: The rollout to run; another one only in tests.
        goal: The worlds' goals, int64, shape [B], where the task has such.
        gradients: Where the gradients are written, one tensor a parameter; None: to new ones.
    """

    def __init__(
        self,
        task: Task,
        rule: NPARule,
        config: TrainConfig[Any],
        x: Tensor,
        s: Tensor,
        generator: Randomness,
        rollout: Rollout | None = None,
        *,
        goal: Tensor | None = None,
        gradients: list[Tensor] | None = None,
    ) -> None:
        self.goal = None if goal is None else goal.clone()
        """Goals of the worlds, int64, shape [B], or None; filled like `x0`."""
        task = task_toward(task, self.goal)
        self.x0, self.s0 = x.clone(), s.clone()
        """Worlds before the rollout."""
        self.x, self.s = torch.empty_like(x), torch.empty_like(s)
        """Worlds after the rollout."""
        self.grown = torch.zeros_like(x[:, 0, 0], dtype=torch.bool)
        """Which worlds are grown and whole, and are to rest, shape [B]."""
        self._rest_weight = config.rest_weight
        self._task = task
        with torch.no_grad():
            total, parts = self._loss(x, s, torch.zeros_like(x[..., 0]))
        self.term_names: tuple[str, ...] = ("loss", *parts)
        """Names of `terms`."""
        self.terms = total.new_zeros(len(self.term_names))
        """The loss and then its named parts, shape [K]."""
        self.parameters = [p for p in rule.parameters() if p.requires_grad]
        """What the gradients are for."""
        self.gradients = gradients or [torch.zeros_like(p) for p in self.parameters]
        """Their `.grad`."""
        for parameter, buffer in zip(self.parameters, self.gradients, strict=True):
            parameter.grad = buffer
        self._rule = rule
        self._memory = config.memory
        self._generator = generator
        self._rollout: Rollout = npa_envs.world.rollout.rollout if rollout is None else rollout

    def aim(self, goal: Tensor) -> None:
        """Give the worlds their goals, int64, shape [B]."""
        assert self.goal is not None, "made with goals"
        self.goal.copy_(goal)

    def run(self, steps: int) -> None:
        """Run the rollout, the loss and the backward pass."""
        self._forward_backward(steps)

    def _forward_backward(self, steps: int) -> None:
        x, s, path_length = self._rollout(
            self._rule,
            self.x0,
            self.s0,
            steps,
            eps=self._task.eps,
            box=self._task.box,
            update_prob=self._task.update_prob,
            memory=self._memory,
            generator=self._generator,
            return_path_length=True,
        )
        total, parts = self._loss(x, s, path_length)
        # Not backward(): its accumulation nodes remember the stream they were first used on,
        # which a capture on another stream must not touch.
        gradients = torch.autograd.grad(
            total, self.parameters, allow_unused=True, materialize_grads=True
        )
        for buffer, gradient in zip(self.gradients, gradients, strict=True):
            buffer.copy_(gradient)
        self.terms.copy_(torch.stack([total, *parts.values()]).detach())
        self.x.copy_(x.detach())
        self.s.copy_(s.detach())

    def _loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the task's loss and its parts, and how far grown worlds are from rest."""
        total, parts = self._task.loss(x, s, path_length)
        if self._rest_weight > 0.0:
            unrest = path_length.mean(dim=1) / self._task.eps + (s - self.s0).abs().mean(dim=(1, 2))
            parts["rest"] = (self.grown.to(x.dtype) * unrest).mean()
            total = total + self._rest_weight * parts["rest"]
        return total, parts


class GraphedIteration(EagerIteration):
    """The same on CUDA, captured once for every number of steps and replayed from then on.

    Launches of thousands of short kernels would otherwise take longer than the kernels do. All
    graphs share one memory pool: they never run at the same time, and everything that outlives a
    replay lies in buffers outside that pool.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._graphs: dict[int, torch.cuda.CUDAGraph] = {}
        self._memory_pool = torch.cuda.graph_pool_handle()

    def run(self, steps: int) -> None:
        """Replay the graph for this number of steps, capturing it when it is first asked for."""
        with torch.cuda.device(self.x0.device):
            if steps not in self._graphs:
                self._graphs[steps] = capture(
                    lambda: self._forward_backward(steps),
                    self.x0.device,
                    pool=self._memory_pool,
                    generator=registered(self._generator),
                    warm_up=None if self._graphs else self._warm_up,
                )
            self._graphs[steps].replay()

    def _warm_up(self) -> None:
        """Run eagerly once: load kernels and allocate workspaces, which no capture may do."""
        # A resumed run warms up again: the masks that follow must not depend on that.
        generator = self._generator
        if isinstance(generator, WorldRandom):
            streams = generator.take(slice(None))
            self._forward_backward(WARM_UP_STEPS)
            generator.put(slice(None), streams)
            return
        state = generator.get_state()
        self._forward_backward(WARM_UP_STEPS)
        generator.set_state(state)


NORM_FLOOR = 1e-8
"""Added to a gradient's norm before it is divided by it: a zero gradient stays zero."""


def normalise_gradients(gradients: Sequence[Tensor]) -> None:
    """Divide each gradient by its own norm, in place; one that is not finite becomes 0."""
    norms = torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients])
    # A norm is not finite where an entry is not.
    bad = ~(norms < math.inf)
    norms += NORM_FLOOR
    for gradient, norm, is_bad in zip(gradients, norms.unbind(), bad.unbind(), strict=True):
        gradient.div_(norm).masked_fill_(is_bad, 0.0)


def clear_non_finite(gradient: Tensor) -> None:
    """Set a gradient to 0 in place where any of its entries is not finite."""
    largest = torch.linalg.vector_norm(gradient, math.inf)
    gradient.masked_fill_(~(largest < math.inf), 0.0)


class RuleOptimiser:
    """AdamW on prepared gradients, with a learning rate that is a function of the iteration.

    Args:
        parameters: The rule's parameters; their `.grad` is set before `prepare_gradients`.
        config: Learning rates, weight decay, gradient normalisation.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], config: TrainConfig[Any]) -> None:
        self._parameters = list(parameters)
        self._config = config
        self._adamw = self._fresh()

    def prepare_gradients(self) -> None:
        """Normalise the gradients, where that is asked for; what is not finite becomes 0."""
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        if self._config.normalise_gradients:
            normalise_gradients(gradients)
            return
        for gradient in gradients:
            clear_non_finite(gradient)

    def step(self, iteration: int) -> None:
        """Take a step along the prepared gradients; at a repeat's start, with fresh moments."""
        if iteration > 0 and iteration % self._config.iterations == 0:
            self._adamw = self._fresh()
        for group in self._adamw.param_groups:
            group["lr"] = self._config.learning_rate_at(iteration)
        self._adamw.step()

    def state_dict(self) -> dict[str, Any]:
        """Return AdamW's moments and step counts, for a checkpoint."""
        return self._adamw.state_dict()

    def moments_like(self) -> dict[int, dict[str, Tensor]]:
        """Return moments and step counts as a first step makes them, by parameter; all are 0."""
        twins = [nn.Parameter(torch.zeros_like(p)) for p in self._parameters]
        for twin in twins:
            twin.grad = torch.zeros_like(twin)
        adamw = torch.optim.AdamW(twins)
        adamw.step()
        moments: dict[int, dict[str, Tensor]] = adamw.state_dict()["state"]
        return moments

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the `state` of what `state_dict` returned; all else is the configuration's."""
        groups = self._adamw.state_dict()["param_groups"]
        self._adamw.load_state_dict({"state": state["state"], "param_groups": groups})

    def _fresh(self) -> torch.optim.AdamW:
        return torch.optim.AdamW(
            self._parameters,
            lr=self._config.learning_rate,
            weight_decay=self._config.weight_decay,
            # One kernel for all parameters; the CPU's own loop is as fast there.
            fused=self._parameters[0].is_cuda,
        )


class WeightAverage:
    """A running mean of parameters: recent ones weigh more, exponentially.

    Args:
        parameters: What is averaged.
        decay: Share of itself that the mean keeps in an iteration, in [0, 1); 0: there is none.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], decay: float) -> None:
        self._parameters: list[Tensor] = list(parameters)
        self._decay = decay
        self._means = [p.detach().clone() for p in parameters] if decay > 0.0 else []

    @torch.no_grad()
    def update(self, iteration: int) -> None:
        """Take the parameters after an iteration, counted from 0, into the mean."""
        if self._means:
            # What untrained weights have to say is soon forgotten.
            keep = min(self._decay, (1 + iteration) / (10 + iteration))
            torch._foreach_lerp_(self._means, self._parameters, 1.0 - keep)

    @torch.no_grad()
    def rule(self, rule: NPARule) -> NPARule:
        """Return a copy of the rule that has the parameters with their means; itself without."""
        if not self._means:
            return rule
        averaged = copy.deepcopy(rule)
        trained = [parameter for parameter in averaged.parameters() if parameter.requires_grad]
        for parameter, mean in zip(trained, self._means, strict=True):
            parameter.copy_(mean)
        return averaged

    def state_dict(self) -> dict[str, Any]:
        """Return the means as the entry `average` of a checkpoint, or nothing."""
        means = {str(number): mean for number, mean in enumerate(self._means)}
        return {"average": means} if means else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint with the entries of `state_dict`."""
        for number, mean in enumerate(self._means):
            mean.copy_(state["average"][str(number)])


NONE_YET = -1
"""Marks that no loss was infinite or NaN so far."""


@dataclass(frozen=True)
class Interval:
    """What happened between two log lines."""

    means: dict[str, float]
    """The mean terms by name, the mean `steps`, and how many `replaced_worlds` there were."""

    bad_iteration: int | None
    """The first iteration of the run whose loss was not finite, or None."""


class LossMeter:
    """Sums of the loss terms, and a snapshot of the first iteration whose loss is not finite.

    `begin`, `observe` and `send` launch kernels and wait for nothing. `observe` can be captured
    in a CUDA graph: the same tensors are read and written in each iteration.

    Args:
        iteration: The iteration's buffers.
    """

    def __init__(self, iteration: EagerIteration) -> None:
        self._iteration = iteration
        device = iteration.terms.device
        # In one tensor, so that one copy brings all to the host. In float64, because a float32 sum
        # over a long interval would lose digits of the mean; whole numbers are exact in it.
        numbers = torch.zeros(len(iteration.terms) + 3, dtype=torch.float64, device=device)
        self._numbers = numbers
        self._sums, self._replaced, self._bad = numbers[:-3], numbers[-3], numbers[-2:]
        self._bad[0] = NONE_YET
        self._now = torch.zeros_like(self._bad)
        self._snapshot = {name: value.clone() for name, value in self._observed().items()}
        self._count = 0
        self._step_sum = 0
        on_cuda = device.type == "cuda"
        self._sent = torch.zeros(numbers.shape, dtype=numbers.dtype, pin_memory=on_cuda)
        self._sent_counts = (0, 0)
        self._arrival = torch.cuda.Event() if on_cuda else None  # type: ignore[no-untyped-call]

    def begin(self, number: int, steps: int) -> None:
        """Say which iteration is observed next."""
        self._now[0].fill_(number)
        self._now[1].fill_(steps)
        self._count += 1
        self._step_sum += steps

    def observe(self, replaced: Tensor) -> None:
        """Take note of an iteration, before the optimiser changes the parameters.

        Args:
            replaced: Which of its worlds left the pool, shape [B], bool, or how many, shape [].
        """
        terms = self._iteration.terms
        self._sums += terms
        self._replaced += replaced.sum()
        # A comparison with NaN is false: one reduction finds both NaN and infinity.
        finite = torch.linalg.vector_norm(terms, math.inf) < math.inf
        first = ~finite & (self._bad[0] == NONE_YET)
        torch.where(first, self._now, self._bad, out=self._bad)
        for name, value in self._observed().items():
            torch.where(first, value, self._snapshot[name], out=self._snapshot[name])

    def send(self) -> None:
        """Let the interval's numbers go to the host, and start the next interval."""
        self._sent.copy_(self._numbers, non_blocking=True)
        if self._arrival is not None:
            self._arrival.record(torch.cuda.current_stream(self._numbers.device))
        self._sent_counts = self._count, self._step_sum
        self._numbers[:-2].zero_()
        self._count = 0
        self._step_sum = 0

    @property
    def sent_count(self) -> int:
        """Iterations of the interval that `send` sent last."""
        return self._sent_counts[0]

    def receive(self) -> Interval:
        """Return what `send` sent last; waits for that, and not for what was launched since."""
        if self._arrival is not None:
            self._arrival.synchronize()
        count, step_sum = self._sent_counts
        count = max(count, 1)
        means = (self._sent[:-3] / count).tolist()
        replaced, bad_iteration, _ = map(int, self._sent[-3:].tolist())
        result = dict(zip(self._iteration.term_names, means, strict=True))
        result |= {"steps": step_sum / count, "replaced_worlds": replaced}
        return Interval(result, None if bad_iteration == NONE_YET else bad_iteration)

    def bad_iteration(self) -> int | None:
        """Return the first iteration whose loss was not finite, or None; waits for the device."""
        number = int(self._bad[0].item())
        return None if number == NONE_YET else number

    def snapshot(self) -> dict[str, Any]:
        """Return what the first iteration with a bad loss saw, on the CPU.

        Returns:
            `iteration`, `steps`, `terms` (by name), `x0`, `s0` (before the rollout), `x`, `s`
            (after it), `parameters` (one flat vector), and `goal` where the task has goals.
        """
        kept = {name: value.cpu() for name, value in self._snapshot.items()}
        terms = kept.pop("terms").tolist()
        iteration, steps = map(int, self._bad.tolist())
        return {
            "iteration": iteration,
            "steps": steps,
            "terms": dict(zip(self._iteration.term_names, terms, strict=True)),
            **kept,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the open interval, for a checkpoint."""
        return {
            "sums": self._sums,
            "replaced": self._replaced,
            "count": self._count,
            "step_sum": self._step_sum,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on with the interval that `state_dict` returned."""
        self._sums.copy_(state["sums"])
        self._replaced.copy_(state["replaced"])
        self._count = state["count"]
        self._step_sum = state["step_sum"]

    def _observed(self) -> dict[str, Tensor]:
        iteration = self._iteration
        goals = {} if iteration.goal is None else {"goal": iteration.goal}
        return goals | {
            "terms": iteration.terms,
            "x0": iteration.x0,
            "s0": iteration.s0,
            "x": iteration.x,
            "s": iteration.s,
            "parameters": torch.nn.utils.parameters_to_vector(iteration.parameters).detach(),
        }
