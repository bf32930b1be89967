"""Quality of a rule: loss and PSNR over thousands of steps, healing what is done to it."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.devices import check_device
from npa_envs.errors import NPAError
from npa_envs.measure.tables import table_text, tables_json
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import PictureTask, ViewTask, task_for_rule
from npa_envs.tasks.damage import cut, erase_state, random_particle
from npa_envs.world.rollout import rollout

__all__ = [
    "CHECKPOINTS",
    "EvaluationRow",
    "HealingRow",
    "check_steps",
    "evaluate",
    "healing",
    "measure",
    "psnr",
    "table_text",
    "tables_json",
]

PROGRESS_STEPS = 32
"""Steps between two reports of progress."""

CHECKPOINTS = (64, 128, 256, 512, 1024, 2048, 4096)
"""Steps at which a rule is measured, unless others are asked for."""

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
    worlds = _Worlds(rule, task, seeds, check_device(device), progress)
    x, s, task = worlds.x, worlds.s, worlds.task
    rows = []
    for step, before in zip(checkpoints, (0, *checkpoints), strict=False):
        x, s = worlds.run(x, s, step - before)
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
    ratio = None
    if isinstance(task, ViewTask):
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

    Two damages, each on the same grown worlds: a slit through the middle at a random angle, and a
    disk around a random particle whose state is erased. Damage that raises the loss by less than
    20 % counts as healed at step 0.

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
    worlds = _Worlds(rule, task, seeds, check_device(device), progress)
    x, s = worlds.run(worlds.x, worlds.s, grow_steps)
    task = worlds.task
    before = task.metric(x, s)
    normal = torch.randn(
        len(x), x.shape[2], generator=worlds.generator, dtype=x.dtype, device=x.device
    )
    centre = random_particle(x, generator=worlds.generator)
    damaged = {
        f"cut, gap {cut_gap:g}": cut(x, s, centre=x.mean(1), normal=normal, gap=cut_gap),
        f"erased disk, radius {erase_radius:g}": (
            x,
            erase_state(x, s, centre=centre, radius=erase_radius),
        ),
    }
    rows = []
    for name, (hurt_x, hurt_s) in damaged.items():
        losses = [task.metric(hurt_x, hurt_s)]
        steps = [0]
        while steps[-1] < heal_steps:
            more = min(every, heal_steps - steps[-1])
            hurt_x, hurt_s = worlds.run(hurt_x, hurt_s, more)
            losses.append(task.metric(hurt_x, hurt_s))
            steps.append(steps[-1] + more)
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


class Runner:
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
        self.task = task_for_rule(task, self._rule)
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


class _Worlds(Runner):
    """One seed world for each of `seeds` (x [B, N, D], s [B, N, C]), and what lets them grow."""

    def __init__(
        self,
        rule: NPARule,
        task: PictureTask,
        seeds: Sequence[int],
        device: torch.device,
        progress: Callable[[int], None] | None,
    ) -> None:
        if not seeds:
            raise NPAError(
                "seeds must hold at least one number, got none: for example seeds=(0, 1)"
            )
        super().__init__(rule, task, device, seeds[0] + len(seeds), progress)
        worlds = [
            task.seed(1, generator=torch.Generator(device).manual_seed(seed), device=device)
            for seed in seeds
        ]
        self.x, self.s = (torch.cat(parts).to(self.dtype) for parts in zip(*worlds, strict=True))
