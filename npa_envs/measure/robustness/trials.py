"""Test worlds of a rule from seeds unseen in training, conditions, damage, and recovery.

A damaged world is compared with its undamaged copy: the same world without the damage, run with the
same masks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.accuracy.trained_rule_checks import MIN_VIEWS, task_name
from npa_envs.measure.quality import RuleRunner
from npa_envs.ops import world_mean
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.damage import DAMAGE_SIZES, random_particle
from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.training.task_of_rule import task_of_rule, tasks_of_codes
from npa_envs.world.brushes import clump, cut, nearest_image, offsets_from, wipe_state
from npa_envs.world.divergence import divergence
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import StreamId, WorldRandom

# Seeds of other shapes; ring, square and two blobs have the trained density.

SIZE_FACTOR = 1.5
"""Factor on the radius of the larger disk; its inverse is that of the smaller one."""

BLOB_DISTANCE = 1.25
"""Distance of each blob's centre from the origin, in radii of a blob (dimensionless)."""

Shape = Callable[[int, int, float, WorldRandom], Tensor]
"""Makes positions [B, N, D] from N, D, the disk's radius and a random source."""


def disk(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return positions in a disk, in 3D a ball, [B, N, D]."""
    sizes = (random.world_count, particle_count, space_dim, radius)
    return uniform_ball(*sizes, generator=random, device=random.device)


def ring(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return positions in a ring around a disk, of its area; in 3D in a spherical shell."""
    x = disk(particle_count, space_dim, radius, random)
    distance: Tensor = torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp_min(1e-12)
    # Moves each particle so that the ring inside of it has the area that the disk had.
    outer = (distance**space_dim + radius**space_dim) ** (1.0 / space_dim)
    return x * (outer / distance)


def square(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return positions in a square of a disk's area, in 3D in a cube of a ball's volume."""
    side = radius * (math.sqrt(math.pi) if space_dim == 2 else (4.0 * math.pi / 3.0) ** (1.0 / 3.0))
    sizes = (random.world_count, particle_count, (side,) * space_dim)
    return uniform_box(*sizes, generator=random, device=random.device)


def two_blobs(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return positions in two disks side by side, in 3D balls, of one disk's total area."""
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
"""Shapes by name, without the trained one."""

# Conditions and plans

CONDITIONS = {
    "eps": "perception radius ε over the trained one",
    "particles": "particles N over the trained number",
    "update_prob": "probability p of an update, for as many updates in all",
    "dt": "time step, for as much time in all",
    "noise": "noise of every position in each step, over the perception radius",
    "shape": "shape of the seed",
}
"""Conditions, varied one at a time, with their summaries."""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """Steps, worlds and values of conditions with which a task's rules are measured."""

    grow_steps: int
    """Steps from the seed to the damage, or to the loss under a condition."""
    heal_steps: tuple[int, ...]
    """Steps after the damage at which losses are measured, from 0 on."""
    chunk: int
    """Steps of growth are a multiple of this, also where they are scaled by dt or update_prob."""
    worlds_per_seed: int = 1
    values: Mapping[str, tuple[float | str, ...]]
    """Increasing values of each condition, with the trained one."""


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
        # Many, as few clouds are wrong, but then nearly all of their particles.
        worlds_per_seed=128,
        # The shape of a cloud is its class.
        values={name: values for name, values in _VALUES.items() if name != "shape"},
    ),
}
"""Plans by task."""


def quick_plan(task_name: str) -> TrialPlan:
    """Return a plan for a task of `PLANS` that takes seconds: few steps, few values."""
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

LOSS_PARTICLES = 1 << 17
"""Most particles of a batch of worlds for a loss, as views of Gaussians take much memory."""


class RuleTrial:
    """A rule with its task and worlds from seeds unseen in training.

    With a rule of many pictures, world k grows picture k modulo their number.
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
        self.plan, self.seeds, self.device = plan, seeds, device
        fields: dict[str, Any] = {"particle_count": particle_count}
        if self.rule.space_dim == 3:
            # Losses are of held-out views, so few training views are enough.
            fields["training_views"] = MIN_VIEWS["training_views"]
        trained = task_of_rule(name, self.rule, device, **fields)
        if trained.why_not_measurable is not None:
            raise NPAError(
                f"cannot measure {name!r}: {trained.why_not_measurable}: choose another rule"
            )
        self.task: Any = trained.task
        self.metric_name = trained.task.trial_name
        self.particle_count = int(self.task.config.particle_count)
        """Trained number of particles in a world."""
        each = plan.worlds_per_seed
        self._world_seeds = [seed * each + k for seed in seeds for k in range(each)]
        self.world_count = len(self._world_seeds)
        """Worlds B of all seeds."""
        self._tasks: dict[int, list[Any]] = {self.particle_count: [self.task]}
        if self.rule.codes is not None:
            tasks = tasks_of_codes(name, self.rule, device, **fields)
            self._tasks[self.particle_count] = [*tasks]
        picture_count = len(self._tasks[self.particle_count])
        self._pictures = torch.tensor(self._world_seeds, device=device) % picture_count
        """Index of each world's task, [B]."""

    def random(self, purpose: int) -> WorldRandom:
        """Return new random streams of all worlds, for a purpose, a `StreamId`."""
        return WorldRandom(self._world_seeds, device=self.device).substream(purpose)

    def particles(self, fraction: float) -> int:
        """Return a fraction of the trained number of particles."""
        return max(2, round(fraction * self.particle_count))

    def tasks_of(self, particle_count: int) -> list[Any]:
        """Return tasks with `particle_count` particles: one, or one for each picture."""
        if particle_count not in self._tasks:
            self._tasks[particle_count] = [
                task.resized(particle_count).for_rule(self.rule)
                for task in self._tasks[self.particle_count]
            ]
        return self._tasks[particle_count]

    def _by_task(self, x: Tensor) -> Iterator[tuple[Any, Tensor]]:
        """Yield each picture's task and its worlds' indices in x, which may be several copies."""
        pictures = self._pictures.repeat(len(x) // self.world_count)
        tasks = self.tasks_of(x.shape[1])
        for k in sorted(set(pictures.tolist())):
            yield tasks[k], (pictures == k).nonzero()[:, 0]

    def with_codes_restored(self, x: Tensor, s: Tensor) -> Tensor:
        """Return states with their picture's code in the first channels, if the rule has codes."""
        s = s.clone()
        for task, index in self._by_task(x):
            s[index] = task.with_target_code(s[index])
        return s

    def initial_worlds(self, fraction: float = 1.0, shape: str = "trained") -> Particles:
        """Return fresh worlds with a fraction of the trained particles, in a shape of `SHAPES`."""
        count = self.particles(fraction)
        random = self.random(StreamId.GROWTH)
        x, s, *_, goal = self.tasks_of(count)[0].seed(
            self.world_count, generator=random, device=self.device
        )
        if shape != "trained":
            box = self.task.box
            # Trained worlds fill their box, so there is no trained radius.
            radius = self.task.config.seed_radius if box is None else 0.25 * min(box)
            x = SHAPES[shape](count, self.rule.space_dim, float(radius), random)
        return Particles(x.float(), self.with_codes_restored(x, s.float()), goal=goal)

    @torch.no_grad()
    def run(
        self, initial: Particles, random: WorldRandom, steps: Sequence[int], **changed: Any
    ) -> tuple[Particles, Tensor]:
        """Return worlds after the last of `steps`, and losses at each of them, [len(steps), B].

        `changed` overrides options of `rollout`. A world that is not finite has the loss NaN from
        then on; it does not affect the others.
        """
        task = self.tasks_of(initial.x.shape[1])[0]
        runner = RuleRunner(self.rule, task, random, **changed)
        worlds, losses = initial, []
        diverged = torch.zeros(len(initial.x), dtype=torch.bool, device=initial.x.device)
        for step, before in zip(steps, (0, *steps), strict=False):
            worlds = runner.run(worlds, step - before)
            diverged = diverged | divergence(worlds.x, worlds.s).non_finite
            worlds = initial.where(diverged, worlds)
            values = self.losses(worlds, changed.get("eps", task.eps))
            losses.append(torch.where(diverged, torch.nan, values))
        return worlds, torch.stack(losses)

    def losses(self, worlds: Particles, eps: float) -> Tensor:
        """Return the task's metric [B] of worlds that were run with perception radius `eps`.

        In open space the dynamics do not change if positions and ε are scaled by one factor, so
        positions are measured at the scale of training. Those in boxes and of static particles are
        not scaled.
        """
        task = self.task
        if task.box is None and not self.rule.static and eps != task.eps:
            worlds = worlds._replace(x=worlds.x * (task.eps / eps))
        size = max(1, LOSS_PARTICLES // worlds.x.shape[1])
        losses = worlds.x.new_empty(len(worlds.x))
        for task, index in self._by_task(worlds.x):
            for some in torch.split(index, size):
                chosen = worlds.take(some)
                losses[some] = task.with_goal(chosen.goal).trial_metric(chosen)
        return losses

    def by_seed(self, losses: Tensor) -> Tensor:
        """Return the mean loss of each seed's worlds, [..., seeds], from [..., B]."""
        return losses.double().reshape(*losses.shape[:-1], len(self.seeds), -1).mean(-1)


# Damage

STATE_NOISE = 0.3
"""Standard deviation of the noise of states (dimensionless)."""

Box = tuple[float, ...] | None
Change = Callable[[Tensor, Tensor, WorldRandom, Box], tuple[Tensor, Tensor]]
"""Makes damaged worlds from positions, states, a random source and sides of the box."""


class Damage(NamedTuple):
    """A kind of damage, and the rules that it suits."""

    apply: Change
    static: bool
    """It also applies to particles that cannot move."""
    halves: bool = False
    """It removes half of the particles."""


def wipe(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Set all states in a disk around a random particle to zero, in 3D a ball."""
    centre = random_particle(x, random)
    return x, wipe_state(x, s, centre=centre, radius=DAMAGE_SIZES["wipe"], box=box)


def slit(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Cut a slit at a random angle through the centroid, or in a periodic box a random particle."""
    centre = world_mean(x) if box is None else random_particle(x, random)
    normal = random.normal(x.shape[2], dtype=x.dtype)
    change = partial(cut, normal=normal, gap=DAMAGE_SIZES["cut"])
    return _around(x, s, centre, box, change)


def pull_together(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Move all particles in a disk around a random particle to its position."""
    change = partial(clump, radius=DAMAGE_SIZES["clump"], factor=1.0)
    return _around(x, s, random_particle(x, random), box, change)


def _around(
    x: Tensor, s: Tensor, centre: Tensor, box: Box, change: Callable[..., tuple[Tensor, Tensor]]
) -> tuple[Tensor, Tensor]:
    """Return x and s after `change` of offsets from each world's centre, to nearest images."""
    away, s = change(offsets_from(x, centre, box), s, centre=torch.zeros_like(centre))
    return nearest_image(away + centre[:, None], box), s


def add_state_noise(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Return the positions as they are, and states plus normal noise of `STATE_NOISE`."""
    return x, s + STATE_NOISE * random.normal(*s.shape[1:], dtype=s.dtype)


def remove_half(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Keep N // 2 particles, chosen at random."""
    return _lowest_half(x, s, random.uniform(x.shape[1]))


def remove_side(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Keep the N // 2 particles on one side of a line at a random angle, in 3D of a plane."""
    normal = random.normal(x.shape[2], dtype=x.dtype)
    return _lowest_half(x, s, (x * normal[:, None]).sum(-1))


def _lowest_half(x: Tensor, s: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Keep the N // 2 particles with the lowest keys [B, N], in their order."""
    indices = key.argsort(dim=1)[:, : x.shape[1] // 2].sort(dim=1).values[..., None]
    return x.take_along_dim(indices, dim=1), s.take_along_dim(indices, dim=1)


DAMAGES = {
    "wipe": Damage(wipe, static=True),
    "cut": Damage(slit, static=False),
    "clump": Damage(pull_together, static=False),
    "noise": Damage(add_state_noise, static=True),
    "half": Damage(remove_half, static=True, halves=True),
    "side": Damage(remove_side, static=True, halves=True),
}
"""Kinds of damage by name."""


# Recovery

RECOVERED = 1.1
"""A world has recovered once its loss is at most this many times its undamaged copy's at that step.
"""

CONTROL = "nothing"
"""Name of the control: undamaged worlds with other masks than the undamaged copies."""

MASKS_AFTER_DAMAGE, MASKS_OF_CONTROL = 1001, 1002
"""Random streams of the update masks after the damage, and of the control's."""


@dataclass(frozen=True)
class LossCurve:
    """Losses of all seeds at `steps` after a damage, and of `undamaged` copies; NaN: not finite."""

    damage: str
    steps: tuple[int, ...]
    losses: tuple[tuple[float, ...], ...]
    undamaged: tuple[tuple[float, ...], ...]

    def recovery_steps(self) -> list[int | None]:
        """Return for each seed the first of `steps` at which it has recovered, or None."""
        first: list[int | None] = []
        for losses, undamaged in zip(self.losses, self.undamaged, strict=True):
            # Comparisons with NaN are false.
            rows = zip(self.steps, losses, undamaged, strict=True)
            first.append(next((step for step, a, b in rows if a <= RECOVERED * b), None))
        return first

    def ratios(self, index: int) -> list[float]:
        """Return each seed's loss divided by its undamaged copy's, at `steps[index]`."""
        pairs = zip(self.losses, self.undamaged, strict=True)
        return [ratio(losses[index], undamaged[index]) for losses, undamaged in pairs]


def ratio(loss: float, reference: float) -> float:
    """Return a loss divided by a reference; 0 / 0 is 1, any other number / 0 infinite."""
    if reference == 0.0:
        return 1.0 if loss == 0.0 else math.nan if math.isnan(loss) else math.inf
    return loss / reference


@torch.no_grad()
def healing(trial: RuleTrial, grown: Particles) -> list[LossCurve]:
    """Damage grown worlds in every way; return a curve for the control and for each damage.

    Where a damage removes half of the particles, the undamaged copies are worlds that were grown
    from half as many.
    """
    growth = trial.random(StreamId.GROWTH)
    smaller, _ = trial.run(trial.initial_worlds(0.5), growth, [trial.plan.grow_steps])
    curves = []
    for halves, undamaged in ((False, grown), (True, smaller)):
        damages = {
            name: damage
            for name, damage in DAMAGES.items()
            if damage.halves == halves and (damage.static or not trial.rule.static)
        }
        curves += _loss_curves(trial, grown, undamaged, damages, control=not halves)
    return curves


def _loss_curves(
    trial: RuleTrial,
    grown: Particles,
    undamaged: Particles,
    damages: Mapping[str, Damage],
    *,
    control: bool,
) -> list[LossCurve]:
    """Run undamaged copies and damaged worlds as one batch; return the loss curve of each damage.

    `control`: the first curve is that of undamaged worlds with other masks.
    """
    steps = trial.plan.heal_steps
    masks, other_masks = (
        trial.random(stream).keys for stream in (MASKS_AFTER_DAMAGE, MASKS_OF_CONTROL)
    )
    batch = {"undamaged": (undamaged, masks)}
    if control:
        batch[CONTROL] = undamaged, other_masks
    for name, damage in damages.items():
        random = trial.random(StreamId.DAMAGE)
        x, s = damage.apply(grown.x, grown.s, random, trial.task.box)
        batch[name] = undamaged._replace(x=x, s=trial.with_codes_restored(x, s)), masks
    worlds, keys = zip(*batch.values(), strict=True)
    random = WorldRandom.from_keys(torch.cat(keys))
    _, losses = trial.run(combined(torch.cat, worlds), random, steps)
    # One row for each world of the batch's parts and each seed.
    rows = trial.by_seed(losses.view(len(steps), len(batch), -1)).permute(1, 2, 0).tolist()
    reference, *others = (tuple(map(tuple, row)) for row in rows)
    names = list(batch)[1:]
    return [LossCurve(name, steps, row, reference) for name, row in zip(names, others, strict=True)]
