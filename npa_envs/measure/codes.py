"""Rules of many pictures: what each code grows, and what the code of another picture grows."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.quality import psnr
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.many_pictures import named_targets
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.rollout import rollout

WORLDS = 64
"""Worlds that are run at once."""

STEP = 256
"""Steps from the seed after which pictures are compared, where nothing else is said."""


@dataclass(frozen=True)
class PictureRow:
    """Worlds of one picture, grown from its code."""

    target: str
    """The picture's name; the last row is of the median picture."""
    loss: float
    """Splat loss with its own code, mean of the worlds."""
    psnr: float
    """PSNR with its own code, mean of the worlds [dB]."""
    shuffled: float
    """Splat loss with the code of another picture, mean of the worlds."""


def tasks_of_pictures(
    rule: NPARule, config: Morphogenesis2DConfig, *, device: str | torch.device
) -> list[Morphogenesis2D]:
    """Return the task of each picture that a rule has a code for, in the order of its codes.

    Args:
        rule: A rule of many pictures.
        config: What it was trained with.
        device: Where the targets' pictures are kept.

    Raises:
        NPAError: The rule has no codes, or a picture cannot be loaded.
    """
    if rule.codes is None:
        raise NPAError("the rule must have codes, this one has none: train it with --targets")
    sources = named_targets(config.targets)
    return [
        Morphogenesis2D(
            replace(config, target=sources.get(name, name), targets=()), device=device
        ).for_rule(rule)
        for name in rule.codes.names
    ]


@torch.no_grad()
def grown(
    rule: NPARule,
    tasks: Sequence[Morphogenesis2D],
    *,
    step: int,
    seeds: Sequence[int],
    device: str | torch.device,
    progress: Callable[[int], None] | None = None,
) -> tuple[Tensor, Tensor]:
    """Return worlds of each task after some steps from the same seeds.

    Args:
        rule: The rule.
        tasks: Tasks of equal worlds, each with its own code.
        step: Steps from the seed.
        seeds: One number for each world of a task.
        device: Where to run.
        progress: Called with the number of steps done since its last call.

    Returns:
        Positions [length units], shape [T, B, N, 2], and states, shape [T, B, N, C].
    """
    together = max(1, WORLDS // len(seeds))
    found = []
    for first in range(0, len(tasks), together):
        some = tasks[first : first + together]
        fresh = [
            task.seed(len(seeds), generator=WorldRandom(seeds, device=device), device=device)
            for task in some
        ]
        x, s = (torch.cat(parts) for parts in zip(*fresh, strict=True))
        x, s = rollout(
            rule,
            x,
            s,
            step,
            eps=some[0].eps,
            update_prob=some[0].update_prob,
            generator=WorldRandom([*seeds] * len(some), device=device),
        )
        found.append(tuple(part.view(len(some), -1, *part.shape[1:]) for part in (x, s)))
        if progress is not None:
            progress(step)
    x, s = (torch.cat(parts) for parts in zip(*found, strict=True))
    return x, s


@torch.no_grad()
def picture_rows(
    rule: NPARule,
    tasks: Sequence[Morphogenesis2D],
    *,
    step: int = STEP,
    seeds: Sequence[int],
    device: str | torch.device = "cpu",
    progress: Callable[[int], None] | None = None,
) -> list[PictureRow]:
    """Measure what each code grows, and what the code of the next picture in the list grows.

    Args:
        rule: The rule.
        tasks: The tasks of its pictures (`tasks_of_pictures`), two or more.
        step: Steps from the seed.
        seeds: One number for each world of a picture.
        device: Where to run.
        progress: Called with the number of steps done since its last call.

    Returns:
        A row for each picture, and one of the medians.

    Raises:
        NPAError: There are fewer than two pictures.
    """
    if len(tasks) < 2:
        raise NPAError(f"pictures must be two or more, got {len(tasks)}: nothing to tell apart")
    x, s = grown(rule, tasks, step=step, seeds=seeds, device=device, progress=progress)
    rows = []
    for number, task in enumerate(tasks):
        own, other = number, (number + 1) % len(tasks)
        ratio = psnr(task.picture(x[own], s[own]), task.target_picture)
        rows.append(
            PictureRow(
                target=task.target.name,
                loss=task.metric(x[own], s[own]).mean().item(),
                psnr=ratio.mean().item(),
                shuffled=task.metric(x[other], s[other]).mean().item(),
            )
        )
    median = PictureRow(
        target="(median)",
        **{
            name: statistics.median(getattr(row, name) for row in rows)
            for name in ("loss", "psnr", "shuffled")
        },
    )
    return [*rows, median]
