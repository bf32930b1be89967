"""Measurements of trained rules: growth, healing, classes of clouds, many pictures; scores."""

from __future__ import annotations

import copy
import itertools
import json
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from npa_envs.checks import check_device
from npa_envs.errors import NPAError, check_known
from npa_envs.measure.texture_metric import TextureMetric, TextureRow
from npa_envs.measure.wounds import WoundRow, wound_rows, wounded
from npa_envs.render.colours import to_uint8
from npa_envs.rule.files import shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.damage import Wound, random_wound
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.tasks.morphogenesis3d import Morphogenesis3D
from npa_envs.tasks.point_classification import PointClassification, majority
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness, WorldRandom, normal_draws
from npa_envs.world.rollout import rollout_particles

PROGRESS_STEPS = 32
"""Steps between two calls of `progress`."""

FIRST_SEED = 1_000_000
"""Random seed of the first measured world; training uses smaller ones."""

CHECKPOINTS = (64, 128, 256, 512, 1024, 2048, 4096)
"""Default steps from the start at which worlds are measured."""

WHITE_SIDE = 256
"""Side of the pictures that `psnr_on_white` compares [pixels]."""

DIVERGED_FACTOR = 10.0
"""A damaged world has diverged if its last loss exceeds this multiple of that before the damage."""

HEALED = 1.2
"""A world of a texture has healed once its loss is at most this multiple of that before."""

GROW_STEPS, HEAL_STEPS = 1024, 1000
"""Default steps of `healing` before the damage, and after it."""

PLACES = {"cuda": 32, "cpu": 6}
"""Default number of places at which `healing` wounds a world, by kind of device."""


@dataclass(frozen=True)
class EvaluationRow:
    """Means over worlds at `step`; fields `..._worst` are those of the worst world.

    `loss` is the task's metric. `psnr` compares pictures with the target's, four channels in
    [0, 1], in 3D held-out views [dB]; None for tasks whose worlds need not match their target pixel
    by pixel. `overflow` is mean |s - clip(s, -1, 1)| (dimensionless), `extent` the longest side of
    the particles' bounding box [length units].
    """

    step: int
    loss: float
    loss_worst: float
    psnr: float | None
    psnr_worst: float | None
    overflow: float
    extent: float

    @property
    def summary(self) -> str:
        """The loss and, if measured, the PSNR, as text."""
        psnr = "" if self.psnr is None else f", PSNR {self.psnr:5.2f} dB"
        return f"loss {self.loss:.4f}{psnr}"


@dataclass(frozen=True)
class HealingRow:
    """Mean losses of grown worlds `before` a damage, right `after` it, and at the `end` of the run.

    `steps_to_heal`: steps until the mean loss is at most `HEALED` times `before`; None: never.
    `worlds_healed`: number of worlds whose own loss was that low at some step, and did not diverge.
    """

    damage: str
    before: float
    after: float
    steps_to_heal: int | None
    worlds_healed: int
    world_count: int
    end: float

    @property
    def summary(self) -> str:
        """How many worlds have healed, as text."""
        return f"{self.damage}: healed in {self.worlds_healed} of {self.world_count} worlds"


@torch.no_grad()
def evaluate(
    rule: NPARule,
    task: Task,
    *,
    checkpoints: Sequence[int] = CHECKPOINTS,
    seeds: Sequence[int] = tuple(range(8)),
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
    watch: Callable[[Tensor, Tensor, int], None] | None = None,
) -> list[EvaluationRow]:
    """Grow one world from every seed; return a row for each of `checkpoints`, increasing steps.

    `progress` is called with the steps done since its last call, `watch` at each checkpoint with
    positions, states and the step. The same seeds give the same rows.
    """
    check_steps("checkpoints", checkpoints)
    runner, worlds = _from_seeds(rule, task, seeds, device, progress)
    rows = []
    for step, (x, s, *_) in runner.at(checkpoints, worlds):
        rows.append(measure(runner.task, x, s, step))
        if watch is not None:
            watch(x, s, step)
    return rows


def measure(task: Task, x: Tensor, s: Tensor, step: int) -> EvaluationRow:
    """Return the measurements of worlds x and s of a task, `step` steps after their start."""
    loss, ratio = task.metric(x, s), None
    if task.has_views:
        ratio = cast(Morphogenesis3D, task).view_psnr(x, s)
    elif task.aligned:
        ratio = psnr(task.picture(x, s), task.target_picture.to(x.device))
    return EvaluationRow(
        step=step,
        loss=loss.mean().item(),
        loss_worst=loss.max().item(),
        psnr=None if ratio is None else ratio.mean().item(),
        psnr_worst=None if ratio is None else ratio.min().item(),
        overflow=_overflow(s).mean().item(),
        extent=(x.amax(1) - x.amin(1)).amax(1).mean().item(),
    )


def _overflow(s: Tensor) -> Tensor:
    return (s - s.clamp(-1.0, 1.0)).abs()


def psnr(picture: Tensor, target: Tensor) -> Tensor:
    """Return the PSNR [dB], [B], of pictures [B, R, R, 4] to a target, all clipped to [0, 1]."""
    error = (picture.clamp(0.0, 1.0) - target.clamp(0.0, 1.0)).square().flatten(1).mean(1)
    return -10.0 * torch.log10(error)


@torch.no_grad()
def psnr_on_white(task: Task, x: Tensor, s: Tensor) -> Tensor:
    """Return the PSNR [dB] of worlds to their target, both drawn on white, shape [B].

    In 2D the world's mean is moved to the target's, and pictures have 256 pixels on each side; in
    3D it is the mean over the task's held-out views.
    """
    if task.has_views:
        return cast(Morphogenesis3D, task).view_psnr(x, s)
    flat = cast(Morphogenesis2D, task)
    config = replace(flat.config, resolution=WHITE_SIDE)
    fine = Morphogenesis2D(config, target=flat.target, device=x.device)
    pictures = torch.cat((fine.picture(x, s), fine.target_picture[None]))
    rgb = torch.from_numpy(to_uint8(pictures)) / 255.0
    return psnr(rgb[:-1], rgb[-1:])


@torch.no_grad()
def healing(
    rule: NPARule,
    task: Task,
    *,
    grow_steps: int = GROW_STEPS,
    heal_steps: int = HEAL_STEPS,
    every: int = 25,
    places: int | None = None,
    seeds: Sequence[int] = tuple(range(8)),
    wipe_radius: float = 0.2,
    cut_gap: float = 0.1,
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
) -> list[HealingRow] | list[WoundRow]:
    """Grow a world from each seed, damage it, and return how it heals, one row for each damage.

    Two damages are done to the same worlds, `grow_steps` steps old: a slit of width `cut_gap` at a
    random angle, and zero states within `wipe_radius` [length units]. Damaged worlds run for
    `heal_steps`.

    Rules that grow one picture or object are wounded at `places` places, spread over the body by
    farthest points, in a copy of the world each. A wound has healed if, half of `heal_steps` after
    it and at their end, the mean loss over the pixels within ε / 2 of it is at most max(1.25 × that
    before, that before + a tenth of the whole picture's mean). Only wounds that raised it above
    this bound count (`LocalLoss`). `places` None: 32, or on a CPU 6 and only the first seed.

    Other worlds are cut through the centroid, and wiped around a random particle. Losses of whole
    worlds are read every `every` steps (`HealingRow`).
    """
    for name, count in (("grow_steps", grow_steps), ("heal_steps", heal_steps), ("every", every)):
        check_steps(name, [count])
    if task.grows_picture:
        check_steps("places", [32 if places is None else places])
        kind = check_device(device).type
        if places is None and kind == "cpu":
            seeds = seeds[:1]
    runner, worlds = _from_seeds(rule, task, seeds, device, progress)
    grown = runner.run(worlds, grow_steps)
    if task.grows_picture:
        return wound_rows(
            runner, grown, places=places or PLACES[kind],
            checks=sorted({max(1, heal_steps // 2), heal_steps}),
            sizes={"cut": cut_gap, "wipe": wipe_radius},
        )  # fmt: skip
    task, x = runner.task, grown.x
    before = task.metric(x, grown.s)
    normal = normal_draws(runner.generator, (len(x), x.shape[2]), x)
    wounds = {
        f"cut, gap {cut_gap:g}": Wound("cut", x.mean(1), cut_gap, normal),
        f"wiped disk, radius {wipe_radius:g}": random_wound(
            "wipe", wipe_radius, x, runner.generator
        ),
    }
    steps = [*range(0, heal_steps, every), heal_steps]
    rows = []
    for name, wound in wounds.items():
        worlds = wounded(task, Particles(x, grown.s), wound)
        losses = torch.stack([task.metric(now.x, now.s) for _, now in runner.at(steps, worlds)])
        diverged = ~(losses[-1] <= DIVERGED_FACTOR * before)
        mean_healed = ((losses.mean(1) <= HEALED * before.mean()) & ~diverged.all()).tolist()
        healed = [step for step, is_healed in zip(steps, mean_healed, strict=True) if is_healed]
        row = HealingRow(
            damage=name,
            before=before.mean().item(),
            after=losses[0].mean().item(),
            steps_to_heal=healed[0] if healed else None,
            worlds_healed=int(((losses <= HEALED * before).any(0) & ~diverged).sum()),
            world_count=len(before),
            end=losses[-1].mean().item(),
        )
        rows.append(row)
    return rows


# Rules that classify clouds

CLOUD_CHECKPOINTS = (8, 16, 24, 32, 64, 128)
"""Default steps from zero states at which particles' predictions are read."""

CUT_FRACTION = 0.25
"""Fraction of its particles that a cut cloud loses."""

SETTLE_STEPS, CHANGED_STEPS = 32, (0, 32, 64, 128)
"""Default steps of `changes_of_mind` before a change of the clouds, and those measured after it."""

STATE_STEPS = (2, 4, 6, 8, 10, 12, 16, 24, 48)
"""Default steps of `hidden_states`."""

CLOUD_BATCH = 256
"""Maximum number of clouds that run at once."""


@dataclass(frozen=True)
class AccuracyRow:
    """Classes of clouds that their particles predict, `step` steps after zero states.

    Fractions in [0, 1]: `majority`, of clouds whose majority predicts the right class; `particle`,
    of particles that do; `agreement`, of particles that predict what their cloud's majority does.
    `loss` is the task's metric, `overflow` mean |s - clip(s, -1, 1)|.
    """

    step: int
    majority: float
    particle: float
    agreement: float
    loss: float
    overflow: float


@dataclass(frozen=True)
class ChangeRow:
    """Predictions of all clouds `steps` steps after a `change`: particles were cut off or moved.

    Fractions in [0, 1]: `majority`, of clouds whose majority predicts the class after the change;
    `particle`, of particles that do; `majority_before`, of clouds still for the former class.
    """

    change: str
    steps: int
    majority: float
    particle: float
    majority_before: float


@torch.no_grad()
def accuracies(
    rule: NPARule,
    task: PointClassification,
    *,
    checkpoints: Sequence[int] = CLOUD_CHECKPOINTS,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[AccuracyRow]:
    """Let a rule classify all clouds of `task`, from zero states; return a row for each checkpoint.

    Checkpoints are increasing steps. A copy of the rule runs on the device of the task; `seed` is
    that of the update masks. `progress` is called with the steps done since its last call.
    """
    check_steps("checkpoints", checkpoints)
    runner = _copied_runner(rule, task, task.clouds.label.device, seed, progress)

    def measured(index: Tensor) -> Iterator[tuple[Tensor, ...]]:
        label, clouds = task.clouds.label[index], _zero_clouds(runner, index)
        labelled = runner.task.with_goal(label)
        for _, (x, s, *_) in runner.at(checkpoints, clouds):
            outputs = runner.task.outputs(s)
            votes, most = outputs.argmax(-1), majority(outputs)
            yield (
                most == label,
                (votes == label[:, None]).double().mean(1),
                (votes == most[:, None]).double().mean(1),
                labelled.metric(x, s),
                _overflow(s).mean((1, 2)),
            )

    means = _cloud_means(task, measured)
    return [AccuracyRow(step, *row) for step, row in zip(checkpoints, means, strict=True)]


@torch.no_grad()
def changes_of_mind(
    rule: NPARule,
    task: PointClassification,
    *,
    settle_steps: int = SETTLE_STEPS,
    steps: Sequence[int] = CHANGED_STEPS,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[ChangeRow]:
    """Classify all clouds for `settle_steps`, change them, and return rows after more `steps`.

    There are three changes, each to the same clouds: a quarter of the particles is cut off on a
    random side; particles move to the positions of a cloud of another class, in the upper half or
    all, and keep their states. `seed` is that of the update masks and of the cuts.
    """
    check_steps("settle_steps", [settle_steps])
    check_steps("steps", steps, at_least=0)
    runner = _copied_runner(rule, task, task.clouds.label.device, seed, progress)
    classes, partner = task.clouds.label, _partners(task.clouds.label)

    def measured(index: Tensor) -> Iterator[tuple[Tensor, ...]]:
        label, other_label = classes[index], classes[partner[index]]
        x, s, *_ = runner.run(_zero_clouds(runner, index), settle_steps)
        other_x = _zero_clouds(runner, partner[index]).x
        for changed, goal in (
            (_cut(x, s, runner.generator), label),
            (_chimera(x, s, other_x), other_label),
            ((other_x, s), other_label),
        ):
            for _, (_, now, *_) in runner.at(steps, Particles(*changed)):
                outputs = runner.task.outputs(now)
                most = majority(outputs)
                right = (outputs.argmax(-1) == goal[:, None]).double().mean(1)
                yield most == goal, right, most == label

    names = (f"{CUT_FRACTION:.0%} cut off", "upper half mutated", "all mutated")
    cases = itertools.product(names, steps)
    return [
        ChangeRow(*case, *row)
        for case, row in zip(cases, _cloud_means(task, measured), strict=True)
    ]


@torch.no_grad()
def hidden_states(
    rule: NPARule,
    task: PointClassification,
    *,
    steps: Sequence[int] = STATE_STEPS,
    cloud_count: int = 16,
    particle_count: int = 3,
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """Return states of P particles at T increasing `steps`, [T, P, C], and their classes, [P].

    They are `particle_count` particles of each of the first `cloud_count` clouds of each class.
    """
    check_steps("steps", steps)
    label = task.clouds.label
    firsts = [torch.nonzero(label == kind)[:cloud_count, 0] for kind in sorted(set(label.tolist()))]
    chosen = torch.cat(firsts)
    runner = _copied_runner(rule, task, label.device, seed, None)
    history = [
        worlds.s[:, :: max(1, worlds.s.shape[1] // particle_count)][:, :particle_count]
        for _, worlds in runner.at(steps, _zero_clouds(runner, chosen))
    ]
    label = label[chosen].repeat_interleave(history[0].shape[1])
    return torch.stack(history).flatten(1, 2), label


def _zero_clouds(runner: RuleRunner, index: Tensor) -> Particles:
    x = runner.task.clouds.points(index).to(next(runner.rule.parameters()).dtype)
    return Particles(x, x.new_zeros(*x.shape[:2], runner.task.config.state_dim))


def _cloud_means(
    task: PointClassification, measured: Callable[[Tensor], Iterable[Sequence[Tensor]]]
) -> list[list[float]]:
    """Return rows of means over all clouds; `measured` maps indices [B] to rows of cells [B]."""
    count = len(task.clouds.label)
    sums = torch.zeros((), dtype=torch.float64)
    for index in torch.split(torch.arange(count, device=task.clouds.label.device), CLOUD_BATCH):
        rows = [[values.double().sum() for values in row] for row in measured(index)]
        sums = sums + torch.stack([torch.stack(row) for row in rows]).cpu()
    means: list[list[float]] = (sums / count).tolist()
    return means


def _cut(x: Tensor, s: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return clouds without `CUT_FRACTION` of their particles, farthest in a random direction."""
    normal = torch.randn(len(x), 2, generator=generator, device=x.device, dtype=x.dtype)
    order = (x * normal[:, None]).sum(-1).argsort(dim=1)
    indices = order[:, : max(1, round((1.0 - CUT_FRACTION) * x.shape[1])), None]
    return x.gather(1, indices.expand(-1, -1, 2)), s.gather(1, indices.expand(-1, -1, s.shape[2]))


def _chimera(x: Tensor, s: Tensor, other_x: Tensor) -> tuple[Tensor, Tensor]:
    """Return x, the lower halves of clouds and the upper halves of others, and s, by height."""
    order = x[..., 1].argsort(dim=1)[..., None]
    other_order = other_x[..., 1].argsort(dim=1)[..., None]
    half = x.shape[1] // 2
    low = x.gather(1, order.expand_as(x))[:, :half]
    high = other_x.gather(1, other_order.expand_as(other_x))[:, half:]
    return torch.cat((low, high), dim=1), s.gather(1, order.expand_as(s))


def _partners(label: Tensor) -> Tensor:
    """Return for each of M clouds the index of one of another class, a permutation, [M]."""
    largest = int(label.bincount().max())
    if 2 * largest > len(label):
        raise NPAError(
            f"no class may have more than half of the clouds, got {largest} of {len(label)}: "
            "mutated clouds need clouds of other classes"
        )
    order = label.argsort(stable=True)
    partner = torch.empty_like(order)
    # Sorted by class, and no class is longer than the shift.
    partner[order] = order.roll(-largest)
    return partner


def tables_of(
    rule: NPARule,
    task: Task,
    *,
    checkpoints: Sequence[int] | None = None,
    seeds: Sequence[int] = tuple(range(8)),
    changed: bool = True,
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
    texture_metric: bool = False,
) -> dict[str, Sequence[Any]]:
    """Measure a rule of any task; return tables (lists of rows) by name.

    They are `growth` (`evaluate`) and, if `changed`, `healing`; with `texture_metric` also `judge`,
    the rows of a `TextureMetric`. Of a rule that classifies clouds they are `accuracy` and, if
    `changed`, `changes`; it runs on its task's device, with the first of `seeds`.
    """
    metric = TextureMetric(task) if texture_metric else None
    options: dict[str, Any] = {"progress": progress}
    tables: dict[str, Sequence[Any]] = {}
    if task.classifies:
        clouds = cast(PointClassification, task)
        options["seed"] = seeds[0]
        steps = checkpoints or CLOUD_CHECKPOINTS
        tables["accuracy"] = accuracies(rule, clouds, checkpoints=steps, **options)
        if changed:
            tables["changes"] = changes_of_mind(rule, clouds, **options)
        return tables
    options |= {"seeds": seeds, "device": device}
    texture_rows: list[TextureRow] = []

    def watch(x: Tensor, s: Tensor, step: int) -> None:
        if metric is not None:
            texture_rows.append(metric.row(x, s, step))

    steps = checkpoints or CHECKPOINTS
    tables["growth"] = evaluate(rule, task, checkpoints=steps, watch=watch, **options)
    if changed:
        tables["healing"] = healing(rule, task, **options)
    return tables | ({"judge": texture_rows} if texture_rows else {})


def step_count(
    task: Task, *, checkpoints: Sequence[int] | None = None, changed: bool = True
) -> int:
    """Return the number of steps that `tables_of` tells `progress` with the same options."""
    if task.classifies:
        clouds = len(cast(PointClassification, task).clouds.label)
        steps = max(checkpoints or CLOUD_CHECKPOINTS)
        steps += changed * (SETTLE_STEPS + 3 * CHANGED_STEPS[-1])
        return -(-clouds // CLOUD_BATCH) * steps
    return max(checkpoints or CHECKPOINTS) + changed * (GROW_STEPS + 2 * HEAL_STEPS)


class RuleRunner:
    """Runs worlds by a rule, with a task's rollout options, some of them replaced by `changed`.

    `generator` draws the update masks; `progress` is called with the steps since its last call.
    """

    def __init__(
        self,
        rule: NPARule,
        task: Any,
        generator: Randomness,
        progress: Callable[[int], None] | None = None,
        **changed: Any,
    ) -> None:
        self.rule, self.task = rule, task
        self.generator: Any = generator
        self._progress = progress
        self._options = task.rollout_options | changed

    @torch.no_grad()
    def run(self, worlds: Particles, steps: int) -> Particles:
        """Return the worlds `steps` steps later; the given ones do not change."""
        longest = steps if self._progress is None else PROGRESS_STEPS
        while steps > 0:
            count = min(steps, longest)
            worlds = rollout_particles(
                self.rule, worlds, count, generator=self.generator, **self._options
            )
            if self._progress is not None:
                self._progress(count)
            steps -= count
        return worlds

    def at(self, steps: Sequence[int], worlds: Particles) -> Iterator[tuple[int, Particles]]:
        """Run worlds; yield each of the increasing `steps`, and the worlds at that step."""
        for step, before in zip(steps, (0, *steps), strict=False):
            worlds = self.run(worlds, step - before)
            yield step, worlds


def _copied_runner(
    rule: NPARule,
    task: Task,
    device: torch.device,
    seed: int,
    progress: Callable[[int], None] | None,
) -> RuleRunner:
    """Return a runner of a copy of the rule on `device`; `seed` is that of the update masks."""
    rule, generator = copy.deepcopy(rule).to(device), torch.Generator(device).manual_seed(seed)
    return RuleRunner(rule, task.for_rule(rule), generator, progress)


def _from_seeds(
    rule: NPARule,
    task: Task,
    seeds: Sequence[int],
    device: str | torch.device,
    progress: Callable[[int], None] | None,
) -> tuple[RuleRunner, Particles]:
    if not seeds:
        raise NPAError("seeds must have at least one number, got none: for example seeds=(0, 1)")
    device = check_device(device)
    runner = _copied_runner(rule, task, device, seeds[0] + len(seeds), progress)
    worlds = [
        task.seed(1, generator=torch.Generator(device).manual_seed(seed), device=device)[:2]
        for seed in seeds
    ]
    dtype = next(rule.parameters()).dtype
    return runner, Particles(*(torch.cat(part).to(dtype) for part in zip(*worlds, strict=True)))


def check_steps(name: str, steps: Sequence[int], at_least: int = 1) -> None:
    """Raise NPAError unless there are `steps`, which increase and are all `at_least` or more."""
    ordered = all(a < b for a, b in itertools.pairwise(steps))
    if not steps or min(steps) < at_least or not ordered:
        raise NPAError(
            f"{name} must be whole numbers of at least {at_least}, increasing, got {tuple(steps)}: "
            f"for example {CHECKPOINTS}"
        )


# Rules of many pictures: loss and PSNR of each picture with its code, and loss with another code.

PICTURE_BATCH = 64
"""Maximum number of worlds that grow pictures at once."""

PICTURE_CHECKPOINTS = (64, 256, 1024)
"""Default steps from the start at which pictures are compared."""

MEDIAN = "(median)"
"""The `target` of a row with the medians of all pictures."""


@dataclass(frozen=True)
class PictureRow:
    """Means over the worlds of one picture (`target`), or medians of all pictures, at `step`.

    `loss` is the task's metric, `shuffled` that of worlds that grew by the code of the next
    picture, `psnr` compares pictures with the target's [dB].
    """

    step: int
    target: str
    loss: float
    shuffled: float
    psnr: float


@torch.no_grad()
def grown(
    rule: NPARule,
    tasks: Sequence[Morphogenesis2D],
    *,
    checkpoints: Sequence[int] = PICTURE_CHECKPOINTS,
    seeds: Sequence[int],
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
) -> list[Particles]:
    """Grow the pictures of T tasks; return x [T, B, N, 2] and s [T, B, N, C] at each checkpoint.

    The tasks differ only in their target and its code. Each has B worlds, from the same B seeds.
    Checkpoints are increasing steps. `progress` is called with the steps done since its last call.
    """
    check_steps("checkpoints", checkpoints)
    task_count = _tasks_at_once(len(seeds))
    batches: list[list[Particles]] = [[] for _ in checkpoints]
    for begin in range(0, len(tasks), task_count):
        batch_tasks = tasks[begin : begin + task_count]
        starts = [
            task.seed(len(seeds), generator=WorldRandom(seeds, device=device), device=device)
            for task in batch_tasks
        ]
        random = WorldRandom([*seeds] * len(batch_tasks), device=device)
        runner = RuleRunner(rule, batch_tasks[0], random, progress)
        worlds = combined(torch.cat, starts)
        for batch, (_, now) in zip(batches, runner.at(checkpoints, worlds), strict=True):
            batch.append(now)
    shape = len(tasks), len(seeds)
    return [
        combined(torch.cat, batch).map(lambda part: part.view(*shape, *part.shape[1:]))
        for batch in batches
    ]


def _tasks_at_once(seed_count: int) -> int:
    return max(1, PICTURE_BATCH // seed_count)


def picture_step_count(
    task_count: int, checkpoints: Sequence[int] = PICTURE_CHECKPOINTS, *, seed_count: int
) -> int:
    """Return the number of steps that `grown` and `picture_rows` tell `progress`."""
    return -(-task_count // _tasks_at_once(seed_count)) * max(checkpoints)


@torch.no_grad()
def picture_rows(
    rule: NPARule,
    tasks: Sequence[Morphogenesis2D],
    *,
    checkpoints: Sequence[int] = PICTURE_CHECKPOINTS,
    **options: Any,
) -> list[PictureRow]:
    """Return each picture's row and the medians' at `checkpoints`; `options`: those of `grown`."""
    if len(tasks) < 2:
        raise NPAError(f"pictures must be two or more, got {len(tasks)}: give another")
    worlds = grown(rule, tasks, checkpoints=checkpoints, **options)
    rows = []
    for step, (x, s, *_) in zip(checkpoints, worlds, strict=True):
        metrics = []
        for k, task in enumerate(tasks):
            other = (k + 1) % len(tasks)
            loss, shuffled = (task.metric(x[i], s[i]).mean().item() for i in (k, other))
            ratio = psnr(task.picture(x[k], s[k]), task.target_picture).mean().item()
            metrics.append((loss, shuffled, ratio))
            rows.append(PictureRow(step, task.target.name, loss, shuffled, ratio))
        medians = map(statistics.median, zip(*metrics, strict=True))
        rows.append(PictureRow(step, MEDIAN, *medians))
    return rows


# Scores of shipped rules: the tables of `npa-envs evaluate`, in a file next to each rule.

SCORED_STEPS = (128, 256, 512, 1024, 4096)
"""Steps whose numbers `score_line` shows, if they were measured."""

CLOUD_STEP = 32
"""Step whose accuracy `score_line` shows for rules that classify clouds."""


def scores(name: str) -> dict[str, Any]:
    """Return the stored scores of a shipped rule: command, commit, date, machine, metric, tables.

    The tables are those of `tables_of`, lists of rows as dicts, by their names.
    """
    rules = shipped_rules()
    check_known("unknown rule", name, rules)
    content: dict[str, Any] = json.loads(rules[name].with_suffix(".json").read_text("utf-8"))
    return content


def score_line(measured: Mapping[str, Any]) -> str:
    """Return one line of text with the main numbers of a rule's scores (the result of `scores`)."""
    if "accuracy" in measured:
        (row,) = (row for row in measured["accuracy"] if row["step"] == CLOUD_STEP)
        clouds, particles = (f"{row[name]:.1%}" for name in ("majority", "particle"))
        return f"{clouds} of clouds by majority, {particles} of particles at step {CLOUD_STEP}"
    rows = [row for row in measured["growth"] if row["step"] in SCORED_STEPS]
    if measured["metric"] == "view loss":
        return f"PSNR of held-out views {_at_steps(rows, 'psnr', '.1f', ' dB')}"
    if "judge" in measured:
        judged = [row for row in measured["judge"] if row["step"] in SCORED_STEPS]
        return f"texture metric {_at_steps(judged, 'ratio', '.2g', '')}"
    return f"{measured['metric']} {_at_steps(rows, 'loss', '.3g', '')}"


def _at_steps(rows: Sequence[Mapping[str, Any]], column: str, form: str, unit: str) -> str:
    # Numbers that are not finite are null in JSON.
    values = [
        "no finite number" if row[column] is None else format(row[column], form) + unit
        for row in rows
    ]
    return ", ".join(f"{value} at {row['step']}" for value, row in zip(values, rows, strict=True))
