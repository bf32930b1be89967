"""Grounds that a rule is tried on: worlds of its task, from unseen seeds, each with own streams."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.accuracy.endurance import SMALLEST_VIEWS, EnduranceCase, LongRun, task_name
from npa_envs.measure.robustness.plans import SHAPES, TrialPlan
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import ParticleTask, Worlds
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.training.trained_tasks import task_of_rule, tasks_of_codes
from npa_envs.world.randomness import Randomness, StreamId, WorldRandom

SEEN_AT_ONCE = 1 << 17
"""Particles of the worlds whose loss is taken at once: many views of many Gaussians take room."""

BOX_SHARE = 0.25
"""Radius of seeds of another shape, over the side of a box that is full when trained."""


@dataclass(frozen=True)
class TaskTrial(EnduranceCase):
    """A rule in worlds of its task, and what these worlds are to show."""

    goal: Tensor | None = None
    """Goals of the worlds, int64, shape [B], where the task has such."""

    def with_worlds(self, x: Tensor, s: Tensor) -> TaskTrial:
        """Return the same with particles x [K B, N, D], s [K B, N, C]: K copies of all worlds."""
        goal = None if self.goal is None else self.goal.repeat(len(x) // len(self.goal))
        return replace(self, x=x, s=s, goal=goal)

    def losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return how far each world is from the goal, shape [B]; lower is better.

        That is the task's metric; of clouds, the share of particles that say the wrong class.
        """
        some = max(1, SEEN_AT_ONCE // x.shape[1])
        found = []
        with torch.no_grad():
            for start in range(0, len(x), some):
                worlds = slice(start, start + some)
                found.append(self._losses(x[worlds], s[worlds], worlds))
        return torch.cat(found)

    def _losses(self, x: Tensor, s: Tensor, worlds: slice) -> Tensor:
        goal = None if self.goal is None else self.goal[worlds]
        return self.task.toward(goal).trial_metric(x, s)


class PicturesInTurn(ParticleTask[Morphogenesis2DConfig]):
    """Worlds of several pictures of one rule, each compared as in a world of its own.

    A world's goal is the place of its picture.

    Args:
        tasks: The task of each picture, for the rule.
        goal: Which of them the worlds grow, int64, shape [B].
    """

    def __init__(self, tasks: Sequence[Morphogenesis2D], goal: Tensor) -> None:
        first = tasks[0]
        self._tasks, self._goal = tuple(tasks), goal
        self.config, self.metric_name = first.config, first.metric_name

    def resized(self, particle_count: int) -> Self:
        """Return the same pictures for another number of particles."""
        return type(self)([task.resized(particle_count) for task in self._tasks], self._goal)

    def for_rule(self, rule: NPARule) -> Self:
        """Return the task for the worlds of a rule."""
        return type(self)([task.for_rule(rule) for task in self._tasks], self._goal)

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Worlds:
        """Return fresh worlds with the codes of their pictures, and which ones these are."""
        x, s, _ = self._tasks[0].seed(world_count, generator=generator, device=device)
        return x, self.coded(s), self._goal

    def damage(self, x: Tensor, s: Tensor, goal: Tensor | None, generator: Randomness) -> Worlds:
        """Return the worlds damaged as each picture's task does it."""
        return self._tasks[0].damage(x, s, goal, generator)

    def toward(self, goal: Tensor | None) -> Self:
        """Return the task for worlds of other pictures, int64, shape [B]."""
        return self if goal is None else type(self)(self._tasks, goal)

    def coded(self, s: Tensor) -> Tensor:
        """Return states with the codes of their worlds' pictures."""
        s = s.clone()
        for task, worlds in self._worlds():
            s[worlds] = task.coded(s[worlds])
        return s

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return how far each world is from its picture, shape [B]."""
        losses = x.new_empty(len(x))
        for task, worlds in self._worlds():
            losses[worlds] = task.metric(x[worlds], s[worlds])
        return losses

    def _worlds(self) -> Iterator[tuple[Morphogenesis2D, Tensor]]:
        for number in sorted(set(self._goal.tolist())):
            yield self._tasks[number], (self._goal == number).nonzero()[:, 0]


class RuleTrial:
    """A rule and the tasks that it is tried in, one for each number of particles.

    The seeds are none that a rule was trained with. Of a rule of many pictures, world k of all
    numbers grows picture k, modulo their number.
    """

    def __init__(
        self,
        name: str,
        device: torch.device,
        plan: TrialPlan,
        seeds: range,
        particle_count: int | None = None,
    ) -> None:
        self.rule: NPARule = load_rule(name, device=device).float().requires_grad_(False)
        self.task_name = task_name(name)
        self.plan, self.seeds, self._device = plan, seeds, device
        # Losses are those of held-out views.
        fields = {"training_views": SMALLEST_VIEWS["training_views"]}
        found = task_of_rule(
            name,
            self.rule,
            device,
            particle_count=particle_count,
            **(fields if self.rule.space_dim == 3 else {}),
        )
        if found.doubt is not None:
            raise NPAError(f"cannot measure {name!r}: {found.doubt}: choose another rule")
        self.task: Any = found.task
        """The task as trained."""
        self.metric_name = found.task.trial_name
        """What losses are."""
        if self.rule.codes is not None:
            pictures = tasks_of_codes(name, self.rule, device, particle_count=particle_count)
            numbers = torch.tensor(self._numbers, device=device)
            self.task = PicturesInTurn(pictures, numbers % len(pictures))
        self._tasks: dict[int, Any] = {self.particle_count: self.task}

    @property
    def particle_count(self) -> int:
        """Particles in a world as trained."""
        return int(self.task.config.particle_count)

    @property
    def world_count(self) -> int:
        """Worlds B of all seeds."""
        return len(self.seeds) * self.plan.worlds_per_seed

    def random(self, purpose: int) -> WorldRandom:
        """Return streams of all worlds for a purpose, at their beginning."""
        return WorldRandom(self._numbers, device=self._device).substream(purpose)

    @property
    def _numbers(self) -> list[int]:
        """Number of each world."""
        each = self.plan.worlds_per_seed
        return [seed * each + k for seed in self.seeds for k in range(each)]

    def particles(self, share: float) -> int:
        """Return how many particles a share of the trained number is."""
        return max(2, round(share * self.particle_count))

    def home(self, share: float = 1.0, shape: str = "trained") -> TaskTrial:
        """Return fresh worlds: a share of the trained number of particles, a shape of `SHAPES`."""
        count = self.particles(share)
        if count not in self._tasks:
            self._tasks[count] = self.task.resized(count).for_rule(self.rule)
        task = self._tasks[count]
        random = self.random(StreamId.GROWTH)
        x, s, goal = task.seed(self.world_count, generator=random, device=self._device)
        if shape != "trained":
            x = SHAPES[shape](count, self.rule.space_dim, self._seed_radius(), random)
        return TaskTrial(
            self.rule, task.toward(goal), x.float(), s.float(), self.plan.grow_steps, goal
        )

    def run(self, home: TaskTrial, random: WorldRandom, **changed: Any) -> LongRun:
        """Return what runs worlds; `changed` are options of `rollout` that are not as trained."""
        return LongRun(home, random, home.options(**changed), chunk=self.plan.chunk)

    def by_seed(self, losses: Tensor) -> Tensor:
        """Return the mean loss of each seed's worlds, shape [..., seeds], from [..., B]."""
        return losses.double().reshape(*losses.shape[:-1], len(self.seeds), -1).mean(-1)

    def _seed_radius(self) -> float:
        box = self.task.box
        return float(self.task.config.seed_radius) if box is None else BOX_SHARE * min(box)


def finite_worlds(x: Tensor, s: Tensor) -> Tensor:
    """Return in which worlds x [B, N, D], s [B, N, C] all is finite, shape [B]."""
    return x.isfinite().flatten(1).all(1) & s.isfinite().flatten(1).all(1)


def loss_curves(home: TaskTrial, run: LongRun, steps: tuple[int, ...]) -> Tensor:
    """Run worlds and return their losses after numbers of steps, shape [len(steps), B].

    A world that is not finite has the loss NaN from then on, and does not disturb the others.
    """
    lost = torch.zeros(len(home.x), dtype=torch.bool, device=home.x.device)
    found = []
    for _, x, s in run.marks(list(steps)):
        lost |= ~finite_worlds(x, s)
        for worlds, fresh in ((x, home.x), (s, home.s)):
            worlds.copy_(torch.where(lost[:, None, None], fresh, worlds))
        losses = home.losses(home.at_trained_size(x, run.eps), s)
        found.append(torch.where(lost, torch.nan, losses))
    return torch.stack(found)
