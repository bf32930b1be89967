"""How good a rule is, in numbers: stable over thousands of steps, healing what is done to it."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.dynamics import rollout
from npa_envs.errors import NPAError
from npa_envs.rule import NPARule
from npa_envs.tasks.damage import cut, erase_state, random_particle
from npa_envs.tasks.task import PictureTask

CHECKPOINTS = (64, 128, 256, 512, 1024, 2048, 4096)
"""Steps at which a rule is measured, unless others are asked for."""

HEALED = 1.2
"""A world is healed once its loss is at most this many times the undamaged one."""

Damage = Callable[[Tensor, Tensor, torch.Generator], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class EvaluationRow:
    """Several worlds after a number of steps from the seed."""

    step: int
    """Steps from the seed."""

    loss: float
    """The task's metric, mean of the worlds."""

    loss_worst: float
    """The task's metric in the worst world."""

    psnr: float
    """PSNR of the picture against the target's, four channels in [0, 1], mean [dB]."""

    psnr_worst: float
    """PSNR in the worst world [dB]."""

    overflow: float
    """mean |s − clip(s, −1, 1)|, mean of the worlds (dimensionless)."""

    extent: float
    """Longest side of a world's bounding box, mean of the worlds [length units]."""


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
    """Worlds whose own loss came within 20 % of their own undamaged one."""

    world_count: int
    """Worlds damaged."""

    end: float
    """The metric at the end, mean of the worlds."""


@torch.no_grad()
def evaluate(
    rule: NPARule,
    task: PictureTask,
    *,
    checkpoints: Sequence[int] = CHECKPOINTS,
    seeds: Sequence[int] = tuple(range(8)),
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
) -> list[EvaluationRow]:
    """Grow one world from every seed and measure them along the way.

    Args:
        rule: The rule, in the precision to run it in.
        task: What it should do.
        checkpoints: Steps to measure at, positive and increasing.
        seeds: One number for each world; the same numbers give the same table.
        device: Where to run.
        progress: Called with the number of steps done since its last call.

    Returns:
        One row for each of `checkpoints`.

    Raises:
        NPAError: `checkpoints` or `seeds` are empty or out of order.
    """
    check_steps("checkpoints", checkpoints)
    x, s, generator = _seed_worlds(rule, task, seeds, torch.device(device))
    rule = copy.deepcopy(rule).to(device)
    rows = []
    done = 0
    for step in checkpoints:
        x, s = _grow(rule, task, x, s, step - done, generator)
        if progress is not None:
            progress(step - done)
        done = step
        rows.append(measure(task, x, s, step))
    return rows


def measure(task: PictureTask, x: Tensor, s: Tensor, step: int) -> EvaluationRow:
    """Measure worlds as they are.

    Args:
        task: What they should be.
        x: Positions [length units], shape [B, N, D].
        s: States, shape [B, N, C].
        step: Steps they have behind them.
    """
    loss = task.metric(x, s)
    ratio = psnr(task.picture(x, s), task.target_picture.to(x.device))
    overflow = (s - s.clamp(-1.0, 1.0)).abs().mean()
    extent = (x.amax(1) - x.amin(1)).amax(1).mean()
    return EvaluationRow(
        step=step,
        loss=loss.mean().item(),
        loss_worst=loss.max().item(),
        psnr=ratio.mean().item(),
        psnr_worst=ratio.min().item(),
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
    task: PictureTask,
    *,
    grow_steps: int = 1024,
    heal_steps: int = 1000,
    every: int = 25,
    seeds: Sequence[int] = tuple(range(8)),
    erase_radius: float = 0.2,
    cut_gap: float = 0.1,
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
) -> list[HealingRow]:
    """Grow worlds, damage them, and measure how long they take to be themselves again.

    Two damages, each on the same grown worlds: a cut through the middle at a random angle that
    pushes the halves apart, and a disk around a random particle whose state is erased.

    Args:
        rule: The rule, in the precision to run it in.
        task: What it should grow.
        grow_steps: Steps from the seed to the damage.
        heal_steps: Steps after the damage.
        every: Steps between two measurements.
        seeds: One number for each world.
        erase_radius: Radius of the erased disk [length units].
        cut_gap: Width of the cut [length units].
        device: Where to run.
        progress: Called with the number of steps done since its last call.

    Raises:
        NPAError: A number of steps is not positive, or there are no seeds.
    """
    check_steps("grow_steps", [grow_steps])
    check_steps("heal_steps", [heal_steps])
    check_steps("every", [every])
    x, s, generator = _seed_worlds(rule, task, seeds, torch.device(device))
    rule = copy.deepcopy(rule).to(device)
    x, s = _grow(rule, task, x, s, grow_steps, generator)
    if progress is not None:
        progress(grow_steps)
    before = task.metric(x, s)

    def erased(x: Tensor, s: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        centre = random_particle(x, generator=generator)
        return x, erase_state(x, s, centre=centre, radius=erase_radius)

    def halved(x: Tensor, s: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        normal = torch.randn(
            len(x), x.shape[2], generator=generator, device=x.device, dtype=x.dtype
        )
        normal = normal / normal.norm(dim=1, keepdim=True)
        return cut(x, s, centre=x.mean(1), normal=normal, gap=cut_gap)

    damages: dict[str, Damage] = {
        f"cut, gap {cut_gap:g}": halved,
        f"erased disk, radius {erase_radius:g}": erased,
    }
    rows = []
    for name, damage in damages.items():
        hurt_x, hurt_s = damage(x, s, generator)
        losses = [task.metric(hurt_x, hurt_s)]
        steps = [0]
        while steps[-1] < heal_steps:
            more = min(every, heal_steps - steps[-1])
            hurt_x, hurt_s = _grow(rule, task, hurt_x, hurt_s, more, generator)
            losses.append(task.metric(hurt_x, hurt_s))
            steps.append(steps[-1] + more)
            if progress is not None:
                progress(more)
        rows.append(_healing_row(name, before, torch.stack(losses), steps))
    return rows


def _healing_row(name: str, before: Tensor, losses: Tensor, steps: list[int]) -> HealingRow:
    mean_within = (losses.mean(1) <= HEALED * before.mean()).tolist()
    worlds_within = (losses <= HEALED * before).any(0)
    return HealingRow(
        damage=name,
        before=before.mean().item(),
        after=losses[0].mean().item(),
        steps_to_heal=next((n for n, ok in zip(steps, mean_within, strict=True) if ok), None),
        worlds_healed=int(worlds_within.sum()),
        world_count=len(before),
        end=losses[-1].mean().item(),
    )


def table_text(rows: Sequence[EvaluationRow] | Sequence[HealingRow]) -> str:
    """Return rows as a plain text table, one line each under a line of headings.

    Args:
        rows: What `evaluate` or `healing` returned.
    """
    if not rows:
        return ""
    names = [field.name for field in dataclasses.fields(rows[0])]
    cells = [[name.replace("_", " ") for name in names]]
    cells += [[_cell(getattr(row, name)) for name in names] for row in rows]
    widths = [max(len(line[column]) for line in cells) for column in range(len(names))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in cells
    )


def table_json(rows: Sequence[EvaluationRow] | Sequence[HealingRow]) -> str:
    """Return rows as a JSON list of objects; a number that is not finite becomes null.

    Args:
        rows: What `evaluate` or `healing` returned.
    """

    def plain(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    objects = [{k: plain(v) for k, v in dataclasses.asdict(row).items()} for row in rows]
    return json.dumps(objects, indent=2, allow_nan=False) + "\n"


def _cell(value: str | int | float | None) -> str:
    if value is None:
        return "never"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def check_steps(name: str, steps: Sequence[int]) -> None:
    """Check that numbers of steps are positive and increasing.

    Args:
        name: What the caller calls them.
        steps: The numbers.

    Raises:
        NPAError: They are not, or there are none.
    """
    ordered = all(a < b for a, b in itertools.pairwise(steps))
    if not steps or min(steps) < 1 or not ordered:
        raise NPAError(
            f"{name} must be whole numbers of at least 1, increasing, got {tuple(steps)}: "
            f"for example {CHECKPOINTS}"
        )


def _seed_worlds(
    rule: NPARule, task: PictureTask, seeds: Sequence[int], device: torch.device
) -> tuple[Tensor, Tensor, torch.Generator]:
    """Return one world per seed [B, N, D] and [B, N, C], and a generator for the rest."""
    if not seeds:
        raise NPAError("seeds must hold at least one number, got none: for example seeds=(0, 1)")
    dtype = next(rule.parameters()).dtype
    worlds = [
        task.seed(1, generator=torch.Generator(device).manual_seed(seed), device=device)
        for seed in seeds
    ]
    x = torch.cat([world[0] for world in worlds]).to(dtype)
    s = torch.cat([world[1] for world in worlds]).to(dtype)
    return x, s, torch.Generator(device).manual_seed(seeds[0] + len(seeds))


def _grow(
    rule: NPARule, task: PictureTask, x: Tensor, s: Tensor, steps: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    return rollout(
        rule,
        x,
        s,
        steps,
        eps=task.eps,
        box=task.box,
        update_prob=task.update_prob,
        generator=generator,
    )
