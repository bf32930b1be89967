"""Quality of trained rules: loss and PSNR over thousands of steps, healing, accuracy, and what was
measured of the shipped ones.
"""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from npa_envs.devices import check_device
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.measure.tables import table_text, tables_json
from npa_envs.rule.files import shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.damage import cut, random_particle, wipe_state
from npa_envs.tasks.point_classification import PointClassification, majority, particle_classes
from npa_envs.world.rollout import rollout

__all__ = [
    "CHECKPOINTS",
    "CLOUD_CHECKPOINTS",
    "AccuracyRow",
    "ChangeRow",
    "EvaluationRow",
    "HealingRow",
    "accuracies",
    "changes_of_mind",
    "check_steps",
    "evaluate",
    "healing",
    "measure",
    "psnr",
    "score_line",
    "scores",
    "table_text",
    "tables_json",
    "tables_of",
]

PROGRESS_STEPS = 32
"""Steps between two reports of progress."""

CHECKPOINTS = (64, 128, 256, 512, 1024, 2048, 4096)
"""Steps at which a rule is measured, unless others are asked for."""

LOST = 10.0
"""A world whose loss has risen to so many times its undamaged one has run away."""

HEALED = 1.2
"""A world is healed once its loss is at most this many times the undamaged one."""


@dataclass(frozen=True)
class EvaluationRow:
    """Several worlds after a number of steps from the seed."""

    step: int
    """Steps from the seed."""
    loss: float
    """The task's metric, mean of the worlds."""
    loss_worst: float
    """The task's metric in the worst world."""
    psnr: float | None
    """PSNR of the picture against the target's, four channels in [0, 1], mean [dB]; in 3D that of
    held-out views; None where a world is not to match the target pixel by pixel."""
    psnr_worst: float | None
    """PSNR in the worst world [dB], likewise."""
    overflow: float
    """mean |s − clip(s, −1, 1)|, mean of the worlds (dimensionless)."""
    extent: float
    """Longest side of a world's bounding box, mean of the worlds [length units]."""

    @property
    def figures(self) -> str:
        """The loss and, where there is one, the PSNR, in words."""
        psnr = "" if self.psnr is None else f", PSNR {self.psnr:5.2f} dB"
        return f"loss {self.loss:.4f}{psnr}"


@dataclass(frozen=True)
class HealingRow:
    """Several worlds, grown, damaged, and left to themselves."""

    damage: str
    """What was done to them."""
    before: float
    """The task's metric before the damage, mean of the worlds."""
    after: float
    """Right after it."""
    steps_to_heal: int | None
    """Steps until the mean is within 20 % of `before`; None: not within the steps allowed."""
    worlds_healed: int
    """Worlds whose own loss came within 20 % of their own undamaged one, but for those that have by
    the end run away, to ten times their undamaged loss."""
    world_count: int
    """Worlds damaged."""
    end: float
    """The metric at the end, mean of the worlds."""


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
    """Grow one world from every seed and measure them along the way.

    Args:
        rule: The rule, in the precision to run it in.
        task: What it should do.
        checkpoints: Steps to measure at, positive and increasing.
        seeds: One number for each world; the same numbers give the same table.
        device: Where to run.
        progress: Called with the number of steps done since its last call.
        watch: Called at each of `checkpoints` with positions, states and the step.

    Returns:
        One row for each of `checkpoints`.

    Raises:
        NPAError: `checkpoints` or `seeds` are empty or out of order.
    """
    check_steps("checkpoints", checkpoints)
    runner, x, s = _from_seeds(rule, task, seeds, check_device(device), progress)
    rows = []
    for step, before in zip(checkpoints, (0, *checkpoints), strict=False):
        x, s = runner.run(x, s, step - before)
        rows.append(measure(runner.task, x, s, step))
        if watch is not None:
            watch(x, s, step)
    return rows


def measure(task: Task, x: Tensor, s: Tensor, step: int) -> EvaluationRow:
    """Measure worlds as they are.

    Args:
        task: What they should be.
        x: Positions [length units], shape [B, N, D].
        s: States, shape [B, N, C].
        step: Steps they have behind them.
    """
    loss = task.metric(x, s)
    ratio = None
    if task.has_views:
        ratio = task.view_psnr(x, s)
    elif task.aligned:
        ratio = psnr(task.picture(x, s), task.target_picture.to(x.device))
    overflow = (s - s.clamp(-1.0, 1.0)).abs().mean()
    extent = (x.amax(1) - x.amin(1)).amax(1).mean()
    return EvaluationRow(
        step=step,
        loss=loss.mean().item(),
        loss_worst=loss.max().item(),
        psnr=None if ratio is None else ratio.mean().item(),
        psnr_worst=None if ratio is None else ratio.min().item(),
        overflow=overflow.item(),
        extent=extent.item(),
    )


def psnr(picture: Tensor, target: Tensor) -> Tensor:
    """Return the peak signal-to-noise ratio of pictures against a target [dB], shape [B].

    Args:
        picture: rgb sums and density, shape [B, R, R, 4]; clipped to [0, 1].
        target: The same of the target, shape [R, R, 4].
    """
    error = (picture.clamp(0.0, 1.0) - target.clamp(0.0, 1.0)).square().flatten(1).mean(1)
    return -10.0 * torch.log10(error)


@torch.no_grad()
def healing(
    rule: NPARule,
    task: Task,
    *,
    grow_steps: int = 1024,
    heal_steps: int = 1000,
    every: int = 25,
    seeds: Sequence[int] = tuple(range(8)),
    wipe_radius: float = 0.2,
    cut_gap: float = 0.1,
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
) -> list[HealingRow]:
    """Grow worlds, damage them, and measure how long they take to be themselves again.

    Two damages, each on the same grown worlds: a slit through the middle at a random angle, and a
    disk around a random particle whose state is wiped. Damage that raises the loss by less than
    20 % counts as healed at step 0.

    Args:
        rule: The rule, in the precision to run it in.
        task: What it should grow.
        grow_steps: Steps from the seed to the damage.
        heal_steps: Steps after the damage.
        every: Steps between two measurements.
        seeds: One number for each world.
        wipe_radius: Radius of the wiped disk [length units].
        cut_gap: Width of the cut [length units].
        device: Where to run.
        progress: Called with the number of steps done since its last call.

    Raises:
        NPAError: A number of steps is not positive, or there are no seeds.
    """
    check_steps("grow_steps", [grow_steps])
    check_steps("heal_steps", [heal_steps])
    check_steps("every", [every])
    runner, x, s = _from_seeds(rule, task, seeds, check_device(device), progress)
    x, s = runner.run(x, s, grow_steps)
    task = runner.task
    before = task.metric(x, s)
    normal = torch.randn(
        len(x), x.shape[2], generator=runner.generator, dtype=x.dtype, device=x.device
    )
    centre = random_particle(x, generator=runner.generator)
    damaged = {
        f"cut, gap {cut_gap:g}": cut(
            x, s, centre=x.mean(1), normal=normal, gap=cut_gap, box=task.box
        ),
        f"wiped disk, radius {wipe_radius:g}": (
            x,
            task.coded(wipe_state(x, s, centre=centre, radius=wipe_radius, box=task.box)),
        ),
    }
    rows = []
    for name, (hurt_x, hurt_s) in damaged.items():
        losses = [task.metric(hurt_x, hurt_s)]
        steps = [0]
        while steps[-1] < heal_steps:
            more = min(every, heal_steps - steps[-1])
            hurt_x, hurt_s = runner.run(hurt_x, hurt_s, more)
            losses.append(task.metric(hurt_x, hurt_s))
            steps.append(steps[-1] + more)
        rows.append(_healing_row(name, before, torch.stack(losses), steps))
    return rows


def _healing_row(name: str, before: Tensor, losses: Tensor, steps: list[int]) -> HealingRow:
    gone = ~(losses[-1] <= LOST * before)
    mean_within = ((losses.mean(1) <= HEALED * before.mean()) & ~gone.all()).tolist()
    worlds_within = (losses <= HEALED * before).any(0) & ~gone
    return HealingRow(
        damage=name,
        before=before.mean().item(),
        after=losses[0].mean().item(),
        steps_to_heal=next((n for n, ok in zip(steps, mean_within, strict=True) if ok), None),
        worlds_healed=int(worlds_within.sum()),
        world_count=len(before),
        end=losses[-1].mean().item(),
    )


# Rules that classify clouds: who is right, and whether clouds change their mind when changed.


CLOUD_CHECKPOINTS = (8, 16, 24, 32, 64, 128)
"""Steps after which clouds are asked for their class, unless others are given."""

CUT_SHARE = 0.25
"""Share of its particles that a cut cloud loses."""

BATCH = 256
"""Clouds that are run at once."""


@dataclass(frozen=True)
class AccuracyRow:
    """All clouds after a number of steps."""

    step: int
    """Steps from blank states."""
    majority: float
    """Share of the clouds whose majority says the right class."""
    particle: float
    """Share of all particles that say the right class."""
    agreement: float
    """Share of all particles that say what their cloud's majority says."""
    loss: float
    """Mean squared error to the class (dimensionless)."""
    overflow: float
    """mean |s − clip(s, −1, 1)| (dimensionless)."""


@dataclass(frozen=True)
class ChangeRow:
    """All clouds, some steps after something was done to them."""

    change: str
    """What was done; the states of the particles were left as they were."""
    steps: int
    """Steps since."""
    majority: float
    """Share of the clouds whose majority says the class that they now show."""
    particle: float
    """Share of all particles that say so."""
    majority_before: float
    """Share of the clouds whose majority says the class that they showed before."""


@torch.no_grad()
def accuracies(
    rule: NPARule,
    task: PointClassification,
    *,
    checkpoints: Sequence[int] = CLOUD_CHECKPOINTS,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[AccuracyRow]:
    """Let a rule classify all clouds of a task, and count who is right along the way.

    Args:
        rule: The rule, on the device of the task.
        task: Gives the clouds: those of its split, as they are.
        checkpoints: Steps to ask at, positive and increasing.
        seed: Randomness of the updates.
        progress: Called with the number of steps done since its last call.

    Returns:
        One row for each of `checkpoints`.

    Raises:
        NPAError: `checkpoints` are empty or out of order.
    """
    check_steps("checkpoints", checkpoints)
    runner = RuleRunner(rule, task, task.clouds.x.device, seed, progress)
    places = task.clouds.x.to(runner.dtype)
    sums = torch.zeros(len(checkpoints), 5, dtype=torch.float64)
    for index, label, blank in _batches(task):
        x, s = places[index], blank.to(runner.dtype)
        aimed = runner.task.toward(label)
        for row, (step, before) in enumerate(zip(checkpoints, (0, *checkpoints), strict=False)):
            _, s = runner.run(x, s, step - before)
            outputs = runner.task.outputs(s)
            says, most = particle_classes(outputs), majority(outputs)
            sums[row] += _sums(
                most == label,
                (says == label[:, None]).double().mean(1),
                (says == most[:, None]).double().mean(1),
                aimed.metric(x, s),
                (s - s.clamp(-1.0, 1.0)).abs().mean((1, 2)),
            )
    means = (sums / len(places)).tolist()
    return [AccuracyRow(step, *row) for step, row in zip(checkpoints, means, strict=True)]


@torch.no_grad()
def changes_of_mind(
    rule: NPARule,
    task: PointClassification,
    *,
    settle_steps: int = 32,
    steps: Sequence[int] = (0, 32, 64, 128),
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[ChangeRow]:
    """Let clouds settle on a class, change them, and count what they say then.

    A cut cloud loses a quarter of its particles, on a random side. A mutated one becomes a cloud of
    another class, wholly or in its upper half: its particles move there and keep their states.

    Args:
        rule: The rule, on the device of the task.
        task: Gives the clouds, as for `accuracies`.
        settle_steps: Steps from blank states to the change.
        steps: Steps after the change to ask at, 0 or more and increasing.
        seed: Randomness of the updates and of the cuts.
        progress: Called with the number of steps done since its last call.

    Returns:
        One row for each change and each of `steps`.

    Raises:
        NPAError: A number of steps is out of range, or half of all clouds or more are of one class.
    """
    check_steps("settle_steps", [settle_steps])
    check_steps("steps", steps, at_least=0)
    runner = RuleRunner(rule, task, task.clouds.x.device, seed, progress)
    places, classes = task.clouds.x.to(runner.dtype), task.clouds.label
    partner = _partners(classes)
    names = (f"{CUT_SHARE:.0%} cut off", "upper half mutated", "all mutated")
    sums = torch.zeros(len(names), len(steps), 3, dtype=torch.float64)
    for index, label, blank in _batches(task):
        x, other_x, other = places[index], places[partner[index]], classes[partner[index]]
        _, s = runner.run(x, blank.to(runner.dtype), settle_steps)
        changed = (
            (*_cut(x, s, runner.generator), label),
            (*_chimera(x, s, other_x), other),
            (other_x, s, other),
        )
        for number, (new_x, new_s, goal) in enumerate(changed):
            for row, (step, before) in enumerate(zip(steps, (0, *steps), strict=False)):
                _, new_s = runner.run(new_x, new_s, step - before)
                outputs = runner.task.outputs(new_s)
                most = majority(outputs)
                right = (particle_classes(outputs) == goal[:, None]).double().mean(1)
                sums[number, row] += _sums(most == goal, right, most == label)
    means = (sums / len(places)).tolist()
    return [
        ChangeRow(name, step, *row)
        for name, rows in zip(names, means, strict=True)
        for step, row in zip(steps, rows, strict=True)
    ]


def _cut(x: Tensor, s: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return clouds without the particles that lie farthest to one side, random for each."""
    normal = torch.randn(len(x), 2, generator=generator, device=x.device, dtype=x.dtype)
    order = (x * normal[:, None]).sum(-1).argsort(dim=1)
    kept = order[:, : max(1, round((1.0 - CUT_SHARE) * x.shape[1])), None]
    return x.gather(1, kept.expand(-1, -1, 2)), s.gather(1, kept.expand(-1, -1, s.shape[2]))


def _chimera(x: Tensor, s: Tensor, other_x: Tensor) -> tuple[Tensor, Tensor]:
    """Return clouds of the lower half of one and the upper half of the other, lowest first."""
    order = x[..., 1].argsort(dim=1)[..., None]
    other_order = other_x[..., 1].argsort(dim=1)[..., None]
    half = x.shape[1] // 2
    low = x.gather(1, order.expand_as(x))[:, :half]
    high = other_x.gather(1, other_order.expand_as(other_x))[:, half:]
    return torch.cat((low, high), dim=1), s.gather(1, order.expand_as(s))


def _partners(label: Tensor) -> Tensor:
    """Return for each cloud the index of one of another class, each cloud once; shape [M]."""
    largest = int(label.bincount().max())
    if 2 * largest > len(label):
        raise NPAError(
            f"no class may have more than half of the clouds, got {largest} of {len(label)}: "
            "mutated digits need others to become"
        )
    order = label.argsort(stable=True)
    partner = torch.empty_like(order)
    # Classes lie side by side in this order, none of them longer than this.
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
    watch: Callable[[Tensor, Tensor, int], None] | None = None,
) -> dict[str, Sequence[Any]]:
    """Return the tables that are measured of a rule of any task, by name.

    Args:
        rule: The rule, in the precision to run it in.
        task: What it should do.
        checkpoints: Steps to measure at; None: `CHECKPOINTS`, of clouds `CLOUD_CHECKPOINTS`.
        seeds: One number for each world; of clouds the first is the randomness of the updates.
        changed: Also damage worlds and measure how they heal, or change clouds.
        device: Where to run; clouds are where their task is.
        progress: Called with the number of steps done since its last call.
        watch: As for `evaluate`; clouds are not watched.

    Returns:
        `growth` and, where asked for, `healing`; of clouds `accuracy` and `changes`.

    Raises:
        NPAError: As for the functions that measure them.
    """
    if task.classifies:
        task = cast(PointClassification, task)
        told: dict[str, Any] = {"seed": seeds[0], "progress": progress}
        clouds: dict[str, Sequence[Any]] = {
            "accuracy": accuracies(rule, task, checkpoints=checkpoints or CLOUD_CHECKPOINTS, **told)
        }
        return clouds | ({"changes": changes_of_mind(rule, task, **told)} if changed else {})
    told = {"seeds": seeds, "device": device, "progress": progress}
    growth = evaluate(rule, task, checkpoints=checkpoints or CHECKPOINTS, watch=watch, **told)
    return {"growth": growth} | ({"healing": healing(rule, task, **told)} if changed else {})


# The rule at work


class RuleRunner:
    """A rule on the worlds of a task, on the device and in the precision of the rule's copy.

    `progress` is called with the number of steps done since its last call.
    """

    def __init__(
        self,
        rule: NPARule,
        task: Any,
        device: torch.device,
        seed: int,
        progress: Callable[[int], None] | None,
    ) -> None:
        # The caller's own rule stays on its device.
        self._rule = copy.deepcopy(rule).to(device)
        self.dtype = next(rule.parameters()).dtype
        self.task = task.for_rule(self._rule)
        self.generator = torch.Generator(device).manual_seed(seed)
        self._progress = progress

    def run(self, x: Tensor, s: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Return worlds x [B, N, D], s [B, N, C] some steps later."""
        while steps > 0:
            some = min(steps, PROGRESS_STEPS)
            x, s = rollout(
                self._rule,
                x,
                s,
                some,
                eps=self.task.eps,
                box=self.task.box,
                update_prob=self.task.update_prob,
                generator=self.generator,
            )
            if self._progress is not None:
                self._progress(some)
            steps -= some
        return x, s


def _from_seeds(
    rule: NPARule,
    task: Task,
    seeds: Sequence[int],
    device: torch.device,
    progress: Callable[[int], None] | None,
) -> tuple[RuleRunner, Tensor, Tensor]:
    """Return what runs one world for each of the seeds, and these, x [B, N, D] and s [B, N, C]."""
    if not seeds:
        raise NPAError("seeds must hold at least one number, got none: for example seeds=(0, 1)")
    runner = RuleRunner(rule, task, device, seeds[0] + len(seeds), progress)
    worlds = [
        task.seed(1, generator=torch.Generator(device).manual_seed(seed), device=device)[:2]
        for seed in seeds
    ]
    x, s = (torch.cat(parts).to(runner.dtype) for parts in zip(*worlds, strict=True))
    return runner, x, s


def _batches(task: PointClassification) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield indices [B], classes [B] and blank states [B, N, C] of some clouds after the other."""
    x, label = task.clouds.x, task.clouds.label
    for index in torch.split(torch.arange(len(label), device=x.device), BATCH):
        yield index, label[index], x.new_zeros(len(index), x.shape[1], task.config.state_dim)


def _sums(*figures: Tensor) -> Tensor:
    """Return the sums over clouds of figures [B], float64, on the host."""
    return torch.stack([figure.double().sum() for figure in figures]).cpu()


def check_steps(name: str, steps: Sequence[int], at_least: int = 1) -> None:
    """Check that numbers of steps are increasing and not too small.

    Args:
        name: What the caller calls them.
        steps: The numbers.
        at_least: The smallest that is allowed.

    Raises:
        NPAError: They are not, or there are none.
    """
    ordered = all(a < b for a, b in itertools.pairwise(steps))
    if not steps or min(steps) < at_least or not ordered:
        raise NPAError(
            f"{name} must be whole numbers of at least {at_least}, increasing, got {tuple(steps)}: "
            f"for example {CHECKPOINTS}"
        )


# What was measured of the shipped rules: the tables of `npa-envs evaluate`, beside each rule.


SCORED_STEPS = (128, 256, 512, 1024, 4096)
"""Steps from the seed that a line of scores names, where they were measured."""

CLOUD_STEP = 32
"""Step at which clouds are asked what they are."""


def scores(name: str) -> dict[str, Any]:
    """Return what was measured of a shipped rule.

    Args:
        name: A name from `npa_envs.rule.files.shipped_rules`.

    Returns:
        `command`, `commit`, `date`, `machine`, `metric` (what the loss is), and tables, lists of
        rows by column: `growth` with `step`, `loss`, `psnr` [dB] and others, for some rules
        `healing`, for textures `judge`; of a rule that classifies `accuracy` and `changes`.

    Raises:
        NPAError: There is no such rule.
    """
    rules = shipped_rules()
    if not isinstance(name, str) or name not in rules:
        raise NPAError(f"unknown rule {shown(name)}: {suggest(name, rules)}")
    found: dict[str, Any] = json.loads(rules[name].with_suffix(".json").read_text("utf-8"))
    return found


def score_line(measured: Mapping[str, Any]) -> str:
    """Return scores in a line.

    Args:
        measured: What `scores` returns.
    """
    if "accuracy" in measured:
        (row,) = (row for row in measured["accuracy"] if row["step"] == CLOUD_STEP)
        shares = f"{row['majority']:.1%} of clouds by majority, {row['particle']:.1%} of particles"
        return f"{shares} at step {CLOUD_STEP}"
    rows = [row for row in measured["growth"] if row["step"] in SCORED_STEPS]
    if measured["metric"] == "view loss":
        return f"PSNR of held-out views {_at_steps(rows, 'psnr', '.1f', ' dB')}"
    if "judge" in measured:
        judged = [row for row in measured["judge"] if row["step"] in SCORED_STEPS]
        return f"judge's ratio {_at_steps(judged, 'ratio', '.2g', '')}"
    return f"{measured['metric']} {_at_steps(rows, 'loss', '.3g', '')}"


def _at_steps(rows: Sequence[Mapping[str, Any]], column: str, form: str, unit: str) -> str:
    told = []
    for row in rows:
        value = row[column]
        # JSON has no numbers that are not finite.
        said = "no finite number" if value is None else format(value, form) + unit
        told.append(f"{said} at {row['step']}")
    return ", ".join(told)
