"""Healing where it hurts: the loss of grown worlds near a wound, compared with that before it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from npa_envs.tasks.damage import Wound
from npa_envs.tasks.morphogenesis2d import local_means
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import normal_draws

RISE, SHARE = 1.25, 0.1
"""A wound is healed where the loss near it is at most `RISE` times that before, or has risen by at
most `SHARE` of the mean over the whole picture."""

BATCH = 16
"""Maximum number of worlds that are drawn at once."""


def wounded(task: Any, worlds: Particles, wound: Wound) -> Particles:
    """Return grown worlds of a task after a wound, with the codes of their targets."""
    x, s = wound.inflict(worlds.x, worlds.s, task.box)
    return worlds._replace(x=x, s=s if s is worlds.s else task.with_target_code(s))


class LocalLoss:
    """Mean loss of each world over the pixels within ε / 2 of a wound; in 3D of held-out views.

    The pixels are those of the worlds `before` the wound, of a task with `grows_picture`. A wound
    has changed a picture if this loss is above `bound` right after it, and heals where it falls to
    `bound` again: max(1.25 × before, before + the whole picture's mean / 10), shape [B].
    """

    def __init__(self, task: Any, before: Particles, wound: Wound) -> None:
        self._task = task
        near, whole, local = [], [], []
        for some, worlds in _parts(before):
            normal = None if wound.normal is None else wound.normal[some]
            here = wound._replace(centre=wound.centre[some], normal=normal)
            near.append(task.pixels_near(worlds, here.distance, 0.5 * task.eps))
            errors = task.pixel_errors(worlds.x, worlds.s)
            local.append(local_means(errors, near[-1]))
            whole.append(local_means(errors, torch.ones_like(errors)))
        self._near = torch.cat(near)
        self.before = torch.cat(local)
        """That of the worlds before the wound, shape [B]."""
        self.bound = torch.maximum(RISE * self.before, self.before + SHARE * torch.cat(whole))

    def __call__(self, worlds: Particles) -> Tensor:
        """Return the loss of the B worlds, later, near the same places, shape [B]."""
        parts = (
            local_means(self._task.pixel_errors(now.x, now.s), self._near[some])
            for some, now in _parts(worlds)
        )
        return torch.cat([*parts])


def _parts(worlds: Particles) -> Iterator[tuple[slice, Particles]]:
    for begin in range(0, len(worlds.x), BATCH):
        some = slice(begin, begin + BATCH)
        yield some, Particles(worlds.x[some], worlds.s[some])


@dataclass(frozen=True)
class WoundRow:
    """How wounds of one kind heal at places spread over the body of grown worlds.

    Of `wounds` wounds `changed` raised the loss near them (`LocalLoss`) above its bound. Of these
    `healed` had it within the bound again at both checks. `before`, `after` and `end` are means of
    that loss over the wounds that changed the picture: before them, right after and at the last
    check; None if there are none. `scars` names the parts of the body where wounds did not heal.
    """

    damage: str
    wounds: int
    changed: int
    healed: int
    before: float | None
    after: float | None
    end: float | None
    scars: str = ""
    missing: ClassVar[str] = "too small"
    """What tables show for None."""

    @property
    def summary(self) -> str:
        """What has healed, as text."""
        if self.changed:
            marks = f"{self.changed} of {self.wounds} wounds left a mark"
            return f"{self.damage}: {marks}, and {self.healed} of these healed"
        what = f"none of {self.wounds} wounds stands out from the picture's own faults"
        return f"{self.damage}: too small to measure: {what}"


def wound_rows(
    runner: Any, grown: Particles, *, places: int, checks: Sequence[int], sizes: Mapping[str, float]
) -> list[WoundRow]:
    """Wound grown worlds at places spread over the body; return a row for each kind in `sizes`.

    Each world is wounded at each place in a copy of its own, cuts at random angles. `runner` is a
    `RuleRunner`; `checks` are increasing steps after the wound; `sizes` are those of `Wound`.
    """
    task = runner.task
    centre = task.spread_places(places, grown).flatten(0, 1)
    worlds = grown.map(lambda value: value.repeat_interleave(places, dim=0))
    rows = []
    for kind, size in sizes.items():
        normal = normal_draws(runner.generator, centre.shape, centre) if kind == "cut" else None
        wound = Wound(kind, centre, size, normal)
        loss = LocalLoss(task, worlds, wound)
        hurt = wounded(task, worlds, wound)
        after = end = loss(hurt)
        healed = changed = after > loss.bound
        for _, later in runner.at(checks, hurt):
            end = loss(later)
            healed = healed & (end <= loss.bound)
        count = int(changed.sum())
        of_changed = (each[changed] for each in (loss.before, after, end))
        first, then, last = (float(each.mean()) if count else None for each in of_changed)
        name = f"{kind}, {'gap' if kind == 'cut' else 'radius'} {size:g}"
        scars = ", ".join(dict.fromkeys(part_names(worlds.x, centre, changed & ~healed)))
        counts = len(centre), count, int(healed.sum())
        rows.append(WoundRow(name, *counts, first, then, last, scars))
    return rows


def part_names(x: Tensor, places: Tensor, chosen: Tensor) -> list[str]:
    """Return the part of the body, such as "top left", of each of the chosen places.

    A part is a ninth of the bounding box of particles `x` [B, N, D], seen with the second axis
    upwards; `places` have shape [B, D], `chosen` [B].
    """
    low, high = x.amin(1), x.amax(1)
    thirds = (3.0 * (places - low) / (high - low)).long().clamp(0, 2)[chosen]
    across, up = ("left", "", "right"), ("bottom", "", "top")
    return [f"{up[row[1]]} {across[row[0]]}".strip() or "middle" for row in thirds.tolist()]
