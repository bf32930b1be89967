"""How worlds heal: the loss after damage beside that of twins that nothing was done to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch

from npa_envs.measure.robustness.damages import DAMAGES, Damage
from npa_envs.measure.robustness.grounds import Ground, Home, courses
from npa_envs.world.randomness import Purpose, WorldRandom

RECOVERED = 1.1
"""A world has recovered once its loss is at most this many times its twin's at the same step."""

CONTROL = "nothing"
"""Name of what is done to worlds that only draw other masks than their twins."""

AFTERWARDS, OTHERWISE = 1001, 1002
"""Streams of the masks after the damage, and of those of the control."""


@dataclass(frozen=True)
class Course:
    """The losses of all seeds after one damage."""

    damage: str
    """What was done."""
    steps: tuple[int, ...]
    """Steps since, increasing."""
    losses: tuple[tuple[float, ...], ...]
    """Loss of each seed at each of `steps`; NaN where a world is not finite."""
    twins: tuple[tuple[float, ...], ...]
    """Those of the same worlds without the damage, with the same masks."""

    def recovery_steps(self) -> list[int | None]:
        """Return for each seed the first of `steps` at which it has recovered; None: at none."""
        return [
            recovery_step(self.steps, loss, twin)
            for loss, twin in zip(self.losses, self.twins, strict=True)
        ]

    def recovered(self) -> int:
        """Return how many seeds have recovered."""
        return sum(step is not None for step in self.recovery_steps())

    def median_step(self) -> float | None:
        """Return the median recovery time of those that recovered [steps]; None: none did."""
        found = [step for step in self.recovery_steps() if step is not None]
        return median(found) if found else None

    def ratios(self, place: int) -> list[float]:
        """Return for each seed the loss over its twin's.

        Args:
            place: Index into `steps`: 0 is right after the damage, -1 the end.
        """
        pairs = zip(self.losses, self.twins, strict=True)
        return [ratio(loss[place], twin[place]) for loss, twin in pairs]

    def within_at_end(self) -> int:
        """Return how many seeds are within `RECOVERED` at the last of `steps`."""
        return sum(value <= RECOVERED for value in self.ratios(-1))


def ratio(loss: float, twin: float) -> float:
    """Return a loss over a twin's; of two zeros it is 1."""
    if twin == 0.0:
        return 1.0 if loss == 0.0 else math.nan if math.isnan(loss) else math.inf
    return loss / twin


def recovery_step(
    steps: Sequence[int], losses: Sequence[float], twins: Sequence[float]
) -> int | None:
    """Return the first step at which a loss is at most `RECOVERED` times the twin's.

    Args:
        steps: Steps since the damage, increasing.
        losses: The loss at each.
        twins: The twin's.
    """
    # Comparisons with NaN are false.
    rows = zip(steps, losses, twins, strict=True)
    return next((step for step, loss, twin in rows if loss <= RECOVERED * twin), None)


@torch.no_grad()
def healing(ground: Ground, home: Home) -> list[Course]:
    """Damage grown worlds in every way, and watch them beside their twins.

    Args:
        ground: The rule, and how long to watch.
        home: Its worlds, grown.

    Returns:
        A course for the control and for each damage that can be done. Where half of the particles
        are removed, twins are worlds that were grown from as many.
    """
    chosen = [d for d in DAMAGES.values() if d.static or not ground.rule.static]
    found = _beside_twins(ground, home, home, [d for d in chosen if not d.halves], control=True)
    smaller = ground.home(share=0.5)
    grown = ground.run(smaller, ground.random(Purpose.GROWTH))
    grown.advance(ground.plan.grow_steps)
    twins = smaller.with_worlds(grown.x, grown.s)
    return found + _beside_twins(
        ground, home, twins, [d for d in chosen if d.halves], control=False
    )


def _beside_twins(
    ground: Ground, home: Home, twins: Home, damages: Sequence[Damage], *, control: bool
) -> list[Course]:
    """Watch twins and damaged worlds as one batch."""
    steps = ground.plan.heal_steps
    copies = [(twins.x, twins.s)]
    keys = [ground.random(AFTERWARDS).keys]
    names = [damage.name for damage in damages]
    for damage in damages:
        random = ground.random(Purpose.DAMAGE)
        copies.append(damage.apply(home.x, home.s, random, home.task.box))
        keys.append(keys[0])
    if control:
        copies.append(copies[0])
        keys.append(ground.random(OTHERWISE).keys)
        names.append(CONTROL)
    x, s = (torch.cat(parts) for parts in zip(*copies, strict=True))
    batch = twins.with_worlds(x, s)
    run = ground.run(batch, WorldRandom.from_keys(torch.cat(keys)))
    losses = courses(batch, run, steps).view(len(steps), len(copies), -1)
    # One row for each copy and seed.
    twin, *others = ground.by_seed(losses).permute(1, 2, 0).tolist()
    rows = [
        Course(name, steps, tuple(map(tuple, other)), tuple(map(tuple, twin)))
        for name, other in zip(names, others, strict=True)
    ]
    return rows[-1:] + rows[:-1] if control else rows
