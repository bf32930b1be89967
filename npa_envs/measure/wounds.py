"""Healing where it hurts: the loss of grown worlds near a wound, compared with that before it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.tasks.morphogenesis2d import local_means
from npa_envs.world.brushes import cut, wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import normal_draws

RISE, SHARE = 1.25, 0.1
"""A wound is healed where the loss near it is at most `RISE` times that before, or has risen by at
most `SHARE` of the mean over the whole picture."""

BATCH = 16
"""Maximum number of worlds that are drawn at once."""


class Wound(NamedTuple):
    """A wound in each of B worlds."""

    kind: str
    """"wipe", states of zero in a ball, "cut", a slit, or "clump", a ball drawn together."""
    centre: Tensor
    """Its middle [length units], shape [B, D]."""
    size: float
    """Radius of the ball or width of the slit [length units]."""
    normal: Tensor | None = None
    """Direction across a cut, shape [B, D]."""

    def of(self, task: Any, worlds: Particles) -> Particles:
        """Return grown worlds of a task with this wipe or cut."""
        x, s, centre = worlds.x, worlds.s, self.centre
        if self.normal is not None:
            x, s = cut(x, s, centre=centre, normal=self.normal, gap=self.size)
        else:
            s = task.with_target_code(wipe_state(x, s, centre=centre, radius=self.size))
        return worlds._replace(x=x, s=s)

    def distance(self, points: Tensor) -> Tensor:
        """Return the distance of points [B, M, D] from what it has moved or wiped, [B, M].

        Inside it is negative. A cut moves what is within its width on both sides.
        """
        away = points - self.centre[:, None]
        if self.normal is None:
            length: Tensor = torch.linalg.vector_norm(away, dim=-1)
            return length - self.size
        across = self.normal / torch.linalg.vector_norm(self.normal, dim=-1, keepdim=True)
        height: Tensor = (away * across[:, None]).sum(-1).abs()
        return height - self.size


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
    check; NaN if there are none.
    """

    damage: str
    wounds: int
    changed: int
    healed: int
    before: float
    after: float
    end: float

    @property
    def summary(self) -> str:
        """What has healed, as text."""
        return (
            f"{self.damage}: healed at {self.healed} of {self.changed} places that the wound "
            f"changed; {self.changed} of {self.wounds} wounds changed the picture"
        )


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
        hurt = wound.of(task, worlds)
        after = end = loss(hurt)
        healed = changed = after > loss.bound
        for _, later in runner.at(checks, hurt):
            end = loss(later)
            healed = healed & (end <= loss.bound)
        count = int(changed.sum())
        losses = loss.before[changed], after[changed], end[changed]
        means = (float(each.mean()) for each in losses)
        name = f"{kind}, {'gap' if kind == 'cut' else 'radius'} {size:g}"
        rows.append(WoundRow(name, len(centre), count, int(healed.sum()), *means))
    return rows
