"""Rules of many pictures: loss and PSNR of each picture by its code, and by another code."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.quality import check_steps, psnr, run_worlds
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.world.randomness import WorldRandom

WORLDS = 64
"""Worlds that are run at once."""

PICTURE_CHECKPOINTS = (64, 256, 1024)
"""Steps from the seed after which pictures are compared, unless others are asked for."""

MEDIAN = "(median)"
"""What stands in place of a picture's name in rows of medians."""


@dataclass(frozen=True)
class PictureRow:
    """Worlds of one picture, or medians of all pictures: means of splat loss and PSNR [dB].

    `shuffled` is the loss with the code of the next picture of the list.
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
) -> list[tuple[Tensor, Tensor]]:
    """Return x [T, B, N, 2] and s [T, B, N, C] of T tasks at each of `checkpoints`.

    All tasks have equal worlds, each its own code, and start from the same seeds; `progress` is
    called with the number of steps done since its last call.
    """
    check_steps("checkpoints", checkpoints)
    together = max(1, WORLDS // len(seeds))
    found: list[list[tuple[Tensor, Tensor]]] = [[] for _ in checkpoints]
    for first in range(0, len(tasks), together):
        some = tasks[first : first + together]
        fresh = [
            task.seed(len(seeds), generator=WorldRandom(seeds, device=device), device=device)
            for task in some
        ]
        x, s = (torch.cat(parts) for parts in zip(*fresh, strict=True))
        random = WorldRandom([*seeds] * len(some), device=device)
        done = 0
        for number, step in enumerate(checkpoints):
            x, s = run_worlds(rule, some[0], x, s, step - done, random)
            found[number].append((x, s))
            if progress is not None:
                progress(step - done)
            done = step
    return [
        (_by_task(tasks, [x for x, _ in parts]), _by_task(tasks, [s for _, s in parts]))
        for parts in found
    ]


def _by_task(tasks: Sequence[Morphogenesis2D], parts: Sequence[Tensor]) -> Tensor:
    whole = torch.cat(list(parts))
    return whole.view(len(tasks), -1, *whole.shape[1:])


@torch.no_grad()
def picture_rows(
    rule: NPARule,
    tasks: Sequence[Morphogenesis2D],
    *,
    checkpoints: Sequence[int] = PICTURE_CHECKPOINTS,
    seeds: Sequence[int],
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
) -> list[PictureRow]:
    """Return for each of `checkpoints` a row for each picture, and one of the medians.

    Arguments are those of `grown`.

    Raises:
        NPAError: There are fewer than two pictures, or `checkpoints` are empty or out of order.
    """
    if len(tasks) < 2:
        raise NPAError(f"pictures must be two or more, got {len(tasks)}: nothing to tell apart")
    worlds = grown(
        rule, tasks, checkpoints=checkpoints, seeds=seeds, device=device, progress=progress
    )
    rows = []
    for step, (x, s) in zip(checkpoints, worlds, strict=True):
        own = [_row(step, tasks, number, x, s) for number in range(len(tasks))]
        medians = {
            name: statistics.median(getattr(row, name) for row in own)
            for name in ("loss", "shuffled", "psnr")
        }
        rows += [*own, PictureRow(step=step, target=MEDIAN, **medians)]
    return rows


def _row(
    step: int, tasks: Sequence[Morphogenesis2D], number: int, x: Tensor, s: Tensor
) -> PictureRow:
    """Return the row of one task from the worlds of all."""
    task, other = tasks[number], (number + 1) % len(tasks)
    ratio = psnr(task.picture(x[number], s[number]), task.target_picture)
    return PictureRow(
        step=step,
        target=task.target.name,
        loss=task.metric(x[number], s[number]).mean().item(),
        shuffled=task.metric(x[other], s[other]).mean().item(),
        psnr=ratio.mean().item(),
    )
