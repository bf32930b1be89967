"""One iteration after another: worlds from the pool, rollout, worlds back, optimiser's step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import GoalTask, ScheduledTask, Task, seed_worlds, task_for_rule
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.graphs import EagerIteration, GraphedIteration, Rollout
from npa_envs.training.meter import LossMeter
from npa_envs.training.optimiser import RuleOptimiser
from npa_envs.training.pool import WorldPool
from npa_envs.world.cuda_graph import Replayed


class TrainingCycle:
    """All that changes while a rule is trained; nothing in it waits for the device.

    Args:
        task: What to learn.
        rule: The rule, on the device, in the run's dtype.
        config: How.
        device: Where the worlds are.
        schedule: Randomness of the numbers of steps, on the CPU.
        rollout: The rollout to train through; None is the engine's.
    """

    def __init__(
        self,
        task: Task,
        rule: NPARule,
        config: TrainConfig[Any],
        device: torch.device,
        schedule: torch.Generator,
        rollout: Rollout | None = None,
    ) -> None:
        self.task = task_for_rule(task, rule)
        """The task, as it is for worlds of this rule."""
        self._config = config
        worlds = torch.Generator(device).manual_seed(config.seed + 1)
        masks = torch.Generator(device).manual_seed(config.seed + 2)
        self.generators = {"schedule": schedule, "worlds": worlds, "masks": masks}
        """Randomness of the steps' numbers, of the worlds, and of the update masks."""
        x, s, goal = self._seeds(config.pool_size)
        self.pool = WorldPool(x, s, goal, runaway_limit=config.runaway_limit)
        """Worlds that live on between batches."""
        batch = x[: config.world_count], s[: config.world_count]
        goals = None if goal is None else goal[: config.world_count]
        graphed = device.type == "cuda" and config.cuda_graph
        iteration = GraphedIteration if graphed else EagerIteration
        self.batch = iteration(self.task, rule, config, *batch, masks, rollout, goal=goals)
        """Worlds before and after the last rollout, the loss and its gradients."""
        self.optimiser = RuleOptimiser(self.batch.parameters, config)
        """Changes the rule."""
        self.meter = LossMeter(self.batch)
        """What happened since the last line of the log."""
        self._index = torch.zeros(config.world_count, dtype=torch.int64, device=device)
        self._fresh_x, self._fresh_s = (torch.empty_like(t) for t in batch)
        self._fresh_goal = None if goals is None else torch.empty_like(goals)
        self._draw = Replayed(self._draw_worlds, device, worlds) if graphed else self._draw_worlds
        self._keep = Replayed(self._keep_worlds, device) if graphed else self._keep_worlds

    def run(self, iteration: int) -> int:
        """Train for one iteration, and return the steps of its rollout, T.

        Args:
            iteration: Iterations done so far in the run.
        """
        config, batch = self._config, self.batch
        lo, hi = config.steps
        steps = int(torch.randint(lo, hi, (), generator=self.generators["schedule"]))
        if isinstance(self.task, ScheduledTask):
            self.task.begin(iteration)
        self._draw()
        if iteration % config.seed_interval == 0:
            self._begin_anew(config.fresh_count)
        batch.run(steps)
        self.meter.begin(iteration + 1, steps)
        self._keep()
        self.optimiser.step(iteration)
        return steps

    def state_dict(self) -> dict[str, Any]:
        """Return all that changes but the rule, for a checkpoint."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "pool": {name: tensor for name, tensor in self._pooled() if tensor is not None},
            "meter": self.meter.state_dict(),
            "random_states": {name: g.get_state() for name, g in self.generators.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` returned; before the first iteration."""
        self.optimiser.load_state_dict(state["optimiser"])
        for name, tensor in self._pooled():
            if tensor is not None:
                tensor.copy_(state["pool"][name])
        self.meter.load_state_dict(state["meter"])
        for name, generator in self.generators.items():
            generator.set_state(state["random_states"][name])

    @torch.no_grad()
    def _draw_worlds(self) -> None:
        """Fill the batch from the pool, and have seeds at hand."""
        config, worlds = self._config, self.generators["worlds"]
        self._index.copy_(self.pool.sample(config.world_count, worlds))
        x0, s0 = self.pool.read(self._index)
        if isinstance(self.task, GoalTask):
            goal = self.pool.read_goals(self._index)
            if config.damage:
                x0, s0, goal = self.task.damage_with_goals(x0, s0, goal, worlds)
            self.batch.aim(goal)
        elif config.damage:
            x0, s0 = self.task.damage(x0, s0, worlds)
        self.batch.x0.copy_(x0)
        self.batch.s0.copy_(s0)
        # Drawn in every iteration, needed or not: nobody on the host knows which worlds run away.
        fresh_x, fresh_s, fresh_goal = self._seeds(config.world_count)
        self._fresh_x.copy_(fresh_x)
        self._fresh_s.copy_(fresh_s)
        if self._fresh_goal is not None and fresh_goal is not None:
            self._fresh_goal.copy_(fresh_goal)

    def _begin_anew(self, count: int) -> None:
        """Let the first worlds of the batch be fresh seeds."""
        batch = self.batch
        batch.x0[:count], batch.s0[:count] = self._fresh_x[:count], self._fresh_s[:count]
        if batch.goal is not None and self._fresh_goal is not None:
            batch.goal[:count] = self._fresh_goal[:count]

    @torch.no_grad()
    def _keep_worlds(self) -> None:
        """Put the batch back into the pool, and take note of what it came to."""
        batch = self.batch
        fresh = self._fresh_x, self._fresh_s
        replaced = self.pool.write(self._index, batch.x, batch.s, *fresh)
        if batch.goal is not None and self._fresh_goal is not None:
            self.pool.write_goals(self._index, batch.goal, self._fresh_goal, replaced)
        self.meter.observe(replaced)
        self.optimiser.prepare_gradients()

    def _seeds(self, world_count: int) -> tuple[Tensor, Tensor, Tensor | None]:
        worlds, dtype = self.generators["worlds"], self._config.torch_dtype
        x, s, goal = seed_worlds(self.task, world_count, generator=worlds, device=worlds.device)
        return x.to(dtype), s.to(dtype), goal

    def _pooled(self) -> list[tuple[str, Tensor | None]]:
        return [("x", self.pool.x), ("s", self.pool.s), ("goal", self.pool.goal)]
