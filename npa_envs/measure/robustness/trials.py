"""Test worlds of a trained rule: conditions that differ from training, damage, and recovery.

A damaged world is compared with its undamaged copy: the same world without the damage, run with the
same update masks. Worlds start from random seeds that training does not use.
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
from npa_envs.measure.wounds import LocalLoss
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.damage import DAMAGE_SIZES, Wound, random_wound
from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.training.task_of_rule import task_of_rule, tasks_of_codes
from npa_envs.world.brushes import nearest_image, offsets_from
from npa_envs.world.divergence import divergence
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import StreamId, WorldRandom

# Start worlds of other shapes; ring, square and two blobs have the density of training.

SIZE_FACTOR = 1.5
"""Radius of the shape "larger" / the radius of training; the inverse for "smaller"."""

BLOB_DISTANCE = 1.25
"""Distance of each blob's centre from the origin / radius of a blob (dimensionless)."""

Shape = Callable[[int, int, float, WorldRandom], Tensor]
"""Returns positions [B, N, D] for N, D, the radius of training and B worlds' random streams."""


def disk(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return uniform positions in a disk around the origin, in 3D in a ball, [B, N, D]."""
    sizes = (random.world_count, particle_count, space_dim, radius)
    return uniform_ball(*sizes, generator=random, device=random.device)


def ring(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return positions in a ring of inner radius `radius` and a disk's area, in 3D in a shell."""
    x = disk(particle_count, space_dim, radius, random)
    distance: Tensor = torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp_min(1e-12)
    # Move each particle so that the ring inside of it has the area that the disk had.
    outer = (distance**space_dim + radius**space_dim) ** (1.0 / space_dim)
    return x * (outer / distance)


def square(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return positions in a square of the disk's area, in 3D in a cube of the ball's volume."""
    side = radius * (math.sqrt(math.pi) if space_dim == 2 else (4.0 * math.pi / 3.0) ** (1.0 / 3.0))
    sizes = (random.world_count, particle_count, (side,) * space_dim)
    return uniform_box(*sizes, generator=random, device=random.device)


def two_blobs(particle_count: int, space_dim: int, radius: float, random: WorldRandom) -> Tensor:
    """Return positions in two disks with the disk's area together, in 3D in two balls."""
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
"""Shapes of start worlds by name, without that of training."""

# Conditions and plans

CONDITIONS = {
    "eps": "perception radius ε over the trained one",
    "particles": "particles N over the trained number",
    "update_prob": "probability p of an update, for as many updates in all",
    "dt": "time step, for as much time in all",
    "noise": "noise of every position in each step, over the perception radius",
    "shape": "shape of the seed",
}
"""Names of the conditions, which are varied one at a time, and what their values are."""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """Steps, worlds and values of conditions with which the rules of a task are measured."""

    grow_steps: int
    """Steps from the start to the damage, or to the loss under a condition."""
    heal_steps: tuple[int, ...]
    """Steps after the damage at which losses are measured, the first of them 0."""
    chunk: int
    """Steps of growth are a multiple of this, also where they are scaled by dt or update_prob."""
    worlds_per_seed: int = 1
    """Worlds whose mean loss is the loss of a seed."""
    values: Mapping[str, tuple[float | str, ...]]
    """Values by condition, in increasing order, with that of training among them."""


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
"""Plans by the name of the task."""


def quick_plan(task_name: str) -> TrialPlan:
    """Return a plan of few steps and few values for a task of `PLANS`, which takes seconds."""
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
"""Maximum number of particles in a batch of a loss, as views of Gaussians take much memory."""


class RuleTrial:
    """A trained rule, its task, and B worlds, `plan.worlds_per_seed` from each of `seeds`.

    `name` is a shipped rule or a file; `particle_count` None: that of training. If the rule grows
    many pictures, a world's random seed modulo their number selects the picture.
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
        """Number of particles in a world under the conditions of training."""
        each = plan.worlds_per_seed
        self._world_seeds = [seed * each + k for seed in seeds for k in range(each)]
        self.world_count = len(self._world_seeds)
        """Number B of all worlds."""
        self._tasks: dict[int, list[Any]] = {self.particle_count: [self.task]}
        if self.rule.codes is not None:
            tasks = tasks_of_codes(name, self.rule, device, **fields)
            self._tasks[self.particle_count] = [*tasks]
        picture_count = len(self._tasks[self.particle_count])
        self._pictures = torch.tensor(self._world_seeds, device=device) % picture_count
        """Index of the picture that each world grows, [B]."""

    def random(self, purpose: int) -> WorldRandom:
        """Return random streams of all worlds, always the same for a `purpose` (a `StreamId`)."""
        return WorldRandom(self._world_seeds, device=self.device).substream(purpose)

    def particles(self, fraction: float) -> int:
        """Return the number of particles that is this fraction of that of training, 2 or more."""
        return max(2, round(fraction * self.particle_count))

    def tasks_of(self, particle_count: int) -> list[Any]:
        """Return a task for each picture that the rule grows, with `particle_count` particles."""
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
        """Return a copy of the states, with the picture's code in its channels if it has one."""
        s = s.clone()
        for task, index in self._by_task(x):
            s[index] = task.with_target_code(s[index])
        return s

    def initial_worlds(self, fraction: float = 1.0, shape: str = "trained") -> Particles:
        """Return start worlds with a fraction of the trained particles, in a shape of this name."""
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
        self,
        initial: Particles,
        random: WorldRandom,
        steps: Sequence[int],
        watch: Callable[[Particles], None] = lambda worlds: None,
        **changed: Any,
    ) -> tuple[Particles, Tensor]:
        """Return worlds after the last of `steps`, and losses at each of them, [len(steps), B].

        `watch` is called with the worlds at each of them. `changed` are options of `rollout` that
        replace the task's. A world that is not finite has the loss NaN from then on, and does not
        affect the others.
        """
        task = self.tasks_of(initial.x.shape[1])[0]
        runner = RuleRunner(self.rule, task, random, **changed)
        worlds, losses = initial, []
        diverged = torch.zeros(len(initial.x), dtype=torch.bool, device=initial.x.device)
        for step, before in zip(steps, (0, *steps), strict=False):
            worlds = runner.run(worlds, step - before)
            diverged = diverged | divergence(worlds.x, worlds.s).non_finite
            worlds = initial.where(diverged, worlds)
            watch(worlds)
            values = self.losses(worlds, changed.get("eps", task.eps))
            losses.append(torch.where(diverged, torch.nan, values))
        return worlds, torch.stack(losses)

    def losses(self, worlds: Particles, eps: float) -> Tensor:
        """Return the task's metric [B] of worlds that were run with perception radius `eps`.

        In open space, dynamics do not change if positions and ε are multiplied by one factor, so
        the metric is that of the positions at the ε of training. In a box, and if particles are
        static, it is that of the positions as they are.
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

    def wound(self, damage: str, x: Tensor) -> Wound | None:
        """Return what a kind of `DAMAGES` does to worlds at `x`, if it has a place; else None.

        Rules of one picture or object have wounds; of the others whole worlds are compared.
        """
        several = len(self._tasks[self.particle_count]) > 1
        if several or not self.task.grows_picture or damage not in ("wipe", "cut", "clump"):
            return None
        return random_wound(damage, DAMAGE_SIZES[damage], x, self.random(StreamId.DAMAGE))

    def by_seed(self, losses: Tensor) -> Tensor:
        """Return the mean loss of each seed's worlds, [..., seeds], of losses [..., B]."""
        return losses.double().reshape(*losses.shape[:-1], len(self.seeds), -1).mean(-1)


# Damage

STATE_NOISE = 0.3
"""Standard deviation of the noise that the damage "noise" adds to states (dimensionless)."""

Box = tuple[float, ...] | None
Change = Callable[[Tensor, Tensor, WorldRandom, Box], tuple[Tensor, Tensor]]
"""Returns damaged x and s for x, s, random streams and sides of the box; None: open space."""


class Damage(NamedTuple):
    """A kind of damage, and the rules whose worlds it is done to."""

    apply: Change
    static: bool
    """Whether it is also done to particles that cannot move."""
    halves: bool = False
    """Whether it removes half of the particles."""


def inflict(
    kind: str, x: Tensor, s: Tensor, random: WorldRandom, box: Box
) -> tuple[Tensor, Tensor]:
    """Return x and s with a wound; a clump's particles all move to its centre.

    In a periodic box cuts run through a random particle.
    """
    wound = random_wound(kind, DAMAGE_SIZES[kind], x, random, anywhere=box is not None)
    if kind == "wipe":
        return wound.inflict(x, s, box)
    # In coordinates whose origin is the wound.
    centre, origin = wound.centre, torch.zeros_like(wound.centre)
    away = offsets_from(x, centre, box)
    away, s = wound._replace(centre=origin).inflict(away, s, factor=1.0)
    return nearest_image(away + centre[:, None], box), s


def add_state_noise(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Return x, and s plus normal noise of standard deviation `STATE_NOISE`."""
    return x, s + STATE_NOISE * random.normal(*s.shape[1:], dtype=s.dtype)


def remove_half(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Return x and s of N // 2 particles, chosen at random."""
    return _lowest_half(x, s, random.uniform(x.shape[1]))


def remove_side(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Return x and s of the N // 2 particles on one side of a line at a random angle."""
    normal = random.normal(x.shape[2], dtype=x.dtype)
    return _lowest_half(x, s, (x * normal[:, None]).sum(-1))


def _lowest_half(x: Tensor, s: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and s of the N // 2 particles with the lowest keys [B, N], in their order."""
    indices = key.argsort(dim=1)[:, : x.shape[1] // 2].sort(dim=1).values[..., None]
    return x.take_along_dim(indices, dim=1), s.take_along_dim(indices, dim=1)


DAMAGES = {
    "wipe": Damage(partial(inflict, "wipe"), static=True),
    "cut": Damage(partial(inflict, "cut"), static=False),
    "clump": Damage(partial(inflict, "clump"), static=False),
    "noise": Damage(add_state_noise, static=True),
    "half": Damage(remove_half, static=True, halves=True),
    "side": Damage(remove_side, static=True, halves=True),
}
"""Kinds of damage by name."""


# Recovery

RECOVERED = 1.1
"""A world has recovered once its loss / that of its undamaged copy at that step is at most this."""

CONTROL = "nothing"
"""Name of the control's loss curve: undamaged worlds, with other masks than undamaged copies."""

MASKS_AFTER_DAMAGE, MASKS_OF_CONTROL = 1001, 1002
"""Numbers of the random streams of update masks, after damage and of the control."""


@dataclass(frozen=True)
class LossCurve:
    """Losses of each seed at `steps` after a damage, and of its undamaged copy; NaN: not finite."""

    damage: str
    steps: tuple[int, ...]
    losses: tuple[tuple[float, ...], ...]
    undamaged: tuple[tuple[float, ...], ...]
    near: tuple[tuple[float, ...], ...] = ()
    """Loss near each seed's wound over its bound (`LocalLoss`); (): the damage has no place."""

    def changed(self) -> list[bool]:
        """Return for each seed whether the damage counts: it raised the loss near it enough."""
        return [not row[0] <= 1.0 for row in self.near] or [True] * len(self.losses)

    def recovery_steps(self) -> list[int | None]:
        """Return for each seed the first of `steps` at which it has recovered; None: never.

        With `near`, it is the first one from which on the loss near the wound is within its bound.
        """
        first: list[int | None] = []
        for row in self.near:
            late = [step for step, value in zip(self.steps, row, strict=True) if not value <= 1.0]
            first.append(next((s for s in self.steps if not late or s > late[-1]), None))
        if self.near:
            return first
        for losses, undamaged in zip(self.losses, self.undamaged, strict=True):
            # Comparisons with NaN are false.
            rows = zip(self.steps, losses, undamaged, strict=True)
            first.append(next((step for step, a, b in rows if a <= RECOVERED * b), None))
        return first

    def ratios(self, index: int) -> list[float]:
        """Return each seed's loss / that of its undamaged copy at `steps[index]`."""
        pairs = zip(self.losses, self.undamaged, strict=True)
        return [ratio(losses[index], undamaged[index]) for losses, undamaged in pairs]


def ratio(loss: float, reference: float) -> float:
    """Return `loss` / `reference`; 0 / 0 is 1, another number / 0 is infinite."""
    if reference == 0.0:
        return 1.0 if loss == 0.0 else math.nan if math.isnan(loss) else math.inf
    return loss / reference


@torch.no_grad()
def healing(trial: RuleTrial, grown: Particles) -> list[LossCurve]:
    """Damage grown worlds in every way; return the loss curves of the control and of each damage.

    If a damage removes half of the particles, undamaged copies grew with half as many.
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
    """Run undamaged copies and damaged worlds in one batch; return the loss curve of each damage.

    With `control`, the first curve is that of undamaged worlds with other random update masks.
    """
    steps = trial.plan.heal_steps
    masks, other_masks = (
        trial.random(stream).keys for stream in (MASKS_AFTER_DAMAGE, MASKS_OF_CONTROL)
    )
    near: dict[str, tuple[LocalLoss, list[Tensor]]] = {}
    batch = {"undamaged": (undamaged, masks)}
    if control:
        batch[CONTROL] = undamaged, other_masks
    for name, damage in damages.items():
        random = trial.random(StreamId.DAMAGE)
        x, s = damage.apply(grown.x, grown.s, random, trial.task.box)
        batch[name] = undamaged._replace(x=x, s=trial.with_codes_restored(x, s)), masks
        wound = trial.wound(name, grown.x)
        if wound is not None:
            near[name] = LocalLoss(trial.task, grown, wound), []
    worlds, keys = zip(*batch.values(), strict=True)
    random = WorldRandom.from_keys(torch.cat(keys))

    def watch(now: Particles) -> None:
        for (loss, values), k in ((each, [*batch].index(name)) for name, each in near.items()):
            some = slice(k * trial.world_count, (k + 1) * trial.world_count)
            values.append(loss(Particles(now.x[some], now.s[some])) / loss.bound)

    _, losses = trial.run(combined(torch.cat, worlds), random, steps, watch)
    # Of each entry of the batch a row for each seed.
    rows = trial.by_seed(losses.view(len(steps), len(batch), -1)).permute(1, 2, 0).tolist()
    reference, *others = (tuple(map(tuple, row)) for row in rows)
    curves = []
    for name, row in zip(list(batch)[1:], others, strict=True):
        # A world that is not finite stays as the damage left it.
        ratios = torch.stack(near[name][1], dim=1).tolist() if name in near else []
        curves.append(LossCurve(name, steps, row, reference, tuple(map(tuple, ratios))))
    return curves
