"""Test worlds of a rule, from unseen seeds, a stream each; plans of what is measured in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.accuracy.endurance import SMALLEST_VIEWS, EnduranceCase, LongRun, task_name
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import ParticleTask, Worlds
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.training.trained_tasks import task_of_rule, tasks_of_codes
from npa_envs.world.randomness import Randomness, StreamId, WorldRandom

# Seeds of other shapes than the trained one, as dense where their size allows it.

SIZE_FACTOR = 1.5
"""Ratio of a larger disk's radius, and its inverse that of a smaller one's."""

BLOB_DISTANCE = 1.25
"""From the origin to the centre of each of two blobs, in their radii (dimensionless)."""

Shape = Callable[[int, int, float, WorldRandom], Tensor]
"""Makes positions [B, N, D] of N, D, the disk's radius and randomness."""


def disk(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a disk, a ball in 3D, of radius R."""
    sizes = (random.world_count, particle_count, space_dim, radius)
    return uniform_ball(*sizes, generator=random, device=random.device)


def ring(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a ring around a disk of radius R, a hollow ball in 3D, of that disk's size."""
    x = disk(particle_count, space_dim, radius, random)
    distance: Tensor = torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp_min(1e-12)
    # What area the disk has within a particle's distance, the ring has as well.
    outer = (distance**space_dim + radius**space_dim) ** (1.0 / space_dim)
    return x * (outer / distance)


def square(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return a square of the disk's area, in 3D a cube of its volume."""
    side = radius * (math.sqrt(math.pi) if space_dim == 2 else (4.0 * math.pi / 3.0) ** (1.0 / 3.0))
    sizes = (random.world_count, particle_count, (side,) * space_dim)
    return uniform_box(*sizes, generator=random, device=random.device)


def two_blobs(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return two disks side by side with the area of one, balls in 3D."""
    small = radius * 0.5 ** (1.0 / space_dim)
    x = disk(particle_count, space_dim, small, random)
    side = torch.arange(particle_count, device=x.device) % 2 * 2 - 1
    shift = torch.zeros_like(x)
    shift[..., 0] = BLOB_DISTANCE * small * side
    return x + shift


SHAPES: dict[str, Shape] = {
    "ring": ring,
    "square": square,
    "two blobs": two_blobs,
    "larger": lambda n, d, radius, random: disk(n, d, SIZE_FACTOR * radius, random),
    "smaller": lambda n, d, radius, random: disk(n, d, radius / SIZE_FACTOR, random),
}
"""Every other shape by its name."""

# Conditions and plans

CONDITIONS = {
    "eps": "perception radius ε over the trained one",
    "particles": "particles N over the trained number",
    "update_prob": "probability p of an update, for as many updates in all",
    "dt": "time step, for as much time in all",
    "noise": "noise of every position in each step, over the perception radius",
    "shape": "shape of the seed",
}
"""Conditions, varied one at a time, with a summary."""

TRAINED: Mapping[str, float | str] = {
    "eps": 1.0,
    "particles": 1.0,
    "dt": 1.0,
    "noise": 0.0,
    "shape": "trained",
}
"""The value of each condition as trained; that of `update_prob` is the task's."""


def trained_value(condition: str, update_prob: float) -> float | str:
    """Return the value of a condition at which a rule whose task has `update_prob` was trained."""
    return update_prob if condition == "update_prob" else TRAINED[condition]


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """Measurements of one rule: all steps are whole chunks, which CUDA records as a graph.

    `grow_steps` lead from the seed to the damage, and to the loss under each condition;
    `heal_steps` after the damage, from 0 on, losses are taken; `values` of each condition increase,
    the trained one among them.
    """

    grow_steps: int
    heal_steps: tuple[int, ...]
    chunk: int
    worlds_per_seed: int = 1
    values: Mapping[str, tuple[float | str, ...]]


_HEAL_STEPS = (0, 16, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024)

_VALUES: dict[str, tuple[float | str, ...]] = {
    "eps": (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0),
    "particles": (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0, 16.0),
    "update_prob": (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0),
    "dt": (0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
    "noise": (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0),
    "shape": ("trained", *SHAPES),
}

_MOVING = TrialPlan(grow_steps=512, heal_steps=_HEAL_STEPS, chunk=16, values=_VALUES)

PLANS = {
    "morphogenesis2d": _MOVING,
    "morphogenesis3d": replace(_MOVING, grow_steps=128, heal_steps=_HEAL_STEPS[:-2]),
    "texture": replace(_MOVING, grow_steps=1024),
    "point_classification": TrialPlan(
        grow_steps=64,
        heal_steps=(0, 8, 16, 24, 32, 48, 64, 96, 128),
        chunk=8,
        # Few clouds are wrong, and nearly all of their particles are.
        worlds_per_seed=128,
        # The shape of a cloud is its class.
        values={name: values for name, values in _VALUES.items() if name != "shape"},
    ),
}
"""What is measured of the rules of each task."""


def quick_plan(task_name: str) -> TrialPlan:
    """Return a plan of a task of `PLANS` that takes seconds: few steps, few values."""
    values: dict[str, tuple[float | str, ...]] = {
        "eps": (0.7, 1.0, 1.4),
        "particles": (0.5, 1.0),
        "update_prob": (0.2, 0.5, 1.0),
        "dt": (0.5, 1.0),
        "noise": (0.0, 1e-2),
        "shape": ("trained", "ring"),
    }
    full = PLANS[task_name]
    return replace(
        full,
        grow_steps=min(full.grow_steps, 48),
        heal_steps=(0, 16, 32),
        worlds_per_seed=min(full.worlds_per_seed, 4),
        values={name: values[name] for name in full.values},
    )


# Test worlds

SEEN_AT_ONCE = 1 << 17
"""Particles of the worlds whose loss is taken at once; views of Gaussians take much memory."""

BOX_SHARE = 0.25
"""Radius of seeds of another shape, over the side of a box that is full when trained."""


@dataclass(frozen=True)
class TaskTrial(EnduranceCase):
    """A rule in worlds of its task, with their goals, where the task has such."""

    goal: Tensor | None = None

    def with_worlds(self, x: Tensor, s: Tensor) -> TaskTrial:
        """Return the same with other particles of K copies of all worlds, [K B, N, ...]."""
        goal = None if self.goal is None else self.goal.repeat(len(x) // len(self.goal))
        return replace(self, x=x, s=s, goal=goal)

    def losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the task's metric, [B]; of clouds, the share of particles that are wrong."""
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
    """Worlds of several pictures of one rule: a world's goal is the place of its task."""

    def __init__(self, tasks: Sequence[Morphogenesis2D], goal: Tensor) -> None:
        first = tasks[0]
        self._tasks, self._goal = tuple(tasks), goal
        self.config, self.metric_name = first.config, first.metric_name

    def resized(self, particle_count: int) -> Self:
        """Return the same pictures for another number of particles."""
        return type(self)([task.resized(particle_count) for task in self._tasks], self.goal)

    def for_rule(self, rule: NPARule) -> Self:
        """Return the task for the worlds of a rule."""
        return type(self)([task.for_rule(rule) for task in self._tasks], self.goal)

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Worlds:
        """Return fresh worlds with the codes of their pictures, and which ones these are."""
        x, s, _ = self._tasks[0].seed(world_count, generator=generator, device=device)
        return x, self.coded(s), self.goal

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
        for number in sorted(set(self.goal.tolist())):
            yield self._tasks[number], (self.goal == number).nonzero()[:, 0]


class RuleTrial:
    """A rule and its tasks, one for each number of particles, with seeds unseen in training.

    Of a rule of many pictures, world k grows picture k, modulo their number.
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
        self.metric_name = found.task.trial_name
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
        """Return a run of worlds; `changed` are options of `rollout` that differ from training."""
        return LongRun(home, random, home.options(**changed), chunk=self.plan.chunk)

    def by_seed(self, losses: Tensor) -> Tensor:
        """Return the mean loss of each seed's worlds, [..., seeds], from [..., B]."""
        return losses.double().reshape(*losses.shape[:-1], len(self.seeds), -1).mean(-1)

    def _seed_radius(self) -> float:
        box = self.task.box
        return float(self.task.config.seed_radius) if box is None else BOX_SHARE * min(box)


def finite_worlds(x: Tensor, s: Tensor) -> Tensor:
    """Return which worlds are finite, [B]."""
    return x.isfinite().flatten(1).all(1) & s.isfinite().flatten(1).all(1)


def loss_curves(home: TaskTrial, run: LongRun, steps: tuple[int, ...]) -> Tensor:
    """Run worlds and return their losses after numbers of steps, [len(steps), B].

    A world that is not finite has the loss NaN from then on; the others are not disturbed.
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
