"""Films of a world: frames during a rollout with damage, and their files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.quality import run_worlds
from npa_envs.render import (
    to_uint8,
    turntable_frames,
    write_filmstrip,
    write_gaussians,
    write_gif,
    write_mp4,
    write_points,
    write_splat,
)
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.damage import DamageEvent, damage_worlds
from npa_envs.training.task_of_rule import task_of_rule

if TYPE_CHECKING:
    from npa_envs.tasks.base import Task

SCREEN = 256
"""Least default resolution of a film [pixels]."""

Style = Literal["splats", "points"]
"""How particles are drawn: as large as in training, or as small separate points."""

FRAME_COUNT = 150
"""Default number of frames of a film, without those of damage."""

EARLY_STEPS = (0, 16, 32, 64, 128)
"""Steps whose nearest frames are in every filmstrip: most of the growth is there."""


@dataclass
class WorldFilm:
    """Frames of one world, uint8, [R, R, 3], each with a caption."""

    background: str = "white"
    """The colour behind the particles: a name or "#rrggbb"."""
    frames: list[NDArray[np.uint8]] = field(default_factory=list)
    captions: list[str] = field(default_factory=list)
    marked: list[int] = field(default_factory=list)
    """Frames that show fresh damage."""
    steps: dict[int, int] = field(default_factory=dict)
    """Steps from the seed by frame; frames of fresh damage are left out."""

    def shoot(
        self,
        task: Task,
        x: Tensor,
        s: Tensor,
        caption: str,
        *,
        mark: bool = False,
        step: int | None = None,
    ) -> None:
        """Add a picture of one world; a filmstrip contains all pictures with `mark`."""
        if mark:
            self.marked.append(len(self.frames))
        if step is not None:
            self.steps[len(self.frames)] = step
        self.frames.append(to_uint8(task.picture(x, s)[0], self.background))
        self.captions.append(caption)

    def strip(self, count: int = 10) -> tuple[list[NDArray[np.uint8]], list[str]]:
        """Return frames and captions of a filmstrip: early, damaged, some between, the last.

        Of a film that is not longer than the early steps: damaged and evenly spaced ones.
        """
        last = len(self.frames) - 1
        if max(self.steps.values(), default=0) <= EARLY_STEPS[-1]:
            others = max(count - 2 - len(self.marked), 2)
            even = np.linspace(0, last, min(others, len(self.frames)))
            chosen = sorted({*self.marked, *(round(float(k)) for k in even)})
        else:
            early = {min(self.steps, key=lambda k: abs(self.steps[k] - n)) for n in EARLY_STEPS}
            chosen = sorted({*early, *self.marked, last})
            while len(chosen) < min(count, len(self.frames)):
                start, end = max(pairwise(chosen), key=lambda pair: pair[1] - pair[0])
                chosen = sorted([*chosen, (start + end) // 2])
        return [self.frames[k] for k in chosen], [self.captions[k] for k in chosen]


def film_world(
    rule: NPARule,
    task: Task,
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    generator: torch.Generator,
    damages: Sequence[DamageEvent] = (),
    every: int = 8,
    first_step: int = 0,
    film: WorldFilm | None = None,
    progress: Callable[[int], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Tensor, Tensor, WorldFilm]:
    """Run one world with damage, and add a frame to `film` every `every` steps.

    `first_step` is the world's age in steps. `progress` is called with the number of steps since
    its last call. After each frame the run ends if `stop` returns true.
    """
    film = WorldFilm() if film is None else film
    last = first_step + steps
    by_step = {damage.step: [d for d in damages if d.step == damage.step] for damage in damages}
    stops = {step for step in by_step if first_step <= step < last}
    stops |= {*range(first_step, last, every), last}
    now = first_step
    with torch.no_grad():
        for step in sorted(stops):
            x, s = run_worlds(rule, task, x, s, step - now, generator)
            progress(step - now)
            now = step
            if not film.frames or step > first_step:
                film.shoot(task, x, s, f"step {step}", step=step)
            for damage in by_step.get(step, ()) if step < last else ():
                x, s = damage_worlds(x, s, kind=damage.kind, size=damage.size, generator=generator)
                s = task.coded(s)
                film.shoot(task, x, s, f"step {step}: {damage.text}", mark=True)
            if stop():
                break
    return x, s, film


def frame_steps(steps: int) -> int:
    """Return the steps between two frames of a film of about `FRAME_COUNT` frames."""
    return math.ceil(steps / FRAME_COUNT)


def large_task(
    task: Task,
    source: str,
    rule: NPARule,
    device: torch.device,
    *,
    resolution: int | None = None,
    style: Style = "splats",
    **world: Any,
) -> Task:
    """Return a rule's task with pictures that are large enough for a film.

    `source` is the rule's name or file; the default resolution is that of training, at least
    `SCREEN`; `world` has further options of `task_of_rule`.
    """
    chosen = dict(world)
    target = getattr(task, "target_picture", None)
    side = task.config.resolution if target is None else len(target)
    if resolution is not None or side < SCREEN:
        chosen["resolution"] = SCREEN if resolution is None else resolution
    if style == "points":
        sigma = getattr(getattr(task, "config", None), "sigma", None)
        if sigma is None:
            raise NPAError("style must be 'splats' for clouds that never move, got 'points'")
        chosen["sigma"] = 0.35 * sigma
    return task if chosen == world else task_of_rule(source, rule, device, **chosen).task


def write_film(film: WorldFilm, folder: Path, name: str, *, fps: float = 25.0) -> list[Path]:
    """Write a film as GIF, MP4 and filmstrip, and return the files."""
    strip, captions = film.strip()
    paths = [folder / f"{name}.gif", folder / f"{name}.mp4", folder / f"{name}-filmstrip.png"]
    write_gif(paths[0], film.frames, fps)
    rows = math.ceil(len(strip) / 8)
    columns = math.ceil(len(strip) / rows)
    write_filmstrip(paths[2], strip, captions, columns=columns, background=film.background)
    # Written last, as it needs ffmpeg and the others do not.
    write_mp4(paths[1], film.frames, fps)
    return paths


def write_solid(
    task: Task,
    x: Tensor,
    s: Tensor,
    folder: Path,
    *,
    shown: Task | None = None,
    resolution: int = SCREEN,
    background: str = "white",
) -> list[Path]:
    """Write a grown 3D world as a turntable, drawn by `shown`, and as point files; return them."""
    names = ("turntable.gif", "points.ply", "gaussians.ply", "cloud.splat")
    paths = [folder / name for name in names]
    with torch.no_grad():
        drawn = task if shown is None else shown
        frames = turntable_frames(
            lambda cameras: drawn.views(x, s, cameras),
            resolution=resolution,
            background=background,
            device=x.device,
        )
        looks = task.gaussians(s)
    write_gif(paths[0], frames, fps=20.0)
    write_points(paths[1], x, looks)
    write_gaussians(paths[2], x, looks)
    write_splat(paths[3], x, looks)
    return paths
