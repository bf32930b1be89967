"""Films of one world, drawn during a rollout, which may have damage, and of hidden states."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from npa_envs.ops import splat
from npa_envs.render.colours import to_uint8
from npa_envs.render.picture_files import (
    Frame,
    turntable_frames,
    write_filmstrip,
    write_gif,
    write_mp4,
)
from npa_envs.render.point_files import write_gaussians, write_points, write_splat
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.damage import DamageEvent, damage_worlds
from npa_envs.tasks.morphogenesis3d import Morphogenesis3D
from npa_envs.tasks.point_classification import class_colours
from npa_envs.world.particles import Particles
from npa_envs.world.rollout import rollout_particles

SCREEN = 256
"""Minimum side of a film's frames [pixels], unless the user sets another one."""


@dataclass
class WorldFilm:
    """Frames (uint8, [H, W, 3]) of one world in order of time, each with a caption."""

    background: str = "white"
    """The colour behind the particles: a name or "#rrggbb"."""
    frames: list[Frame] = field(default_factory=list)
    captions: list[str] = field(default_factory=list)
    steps: dict[int, int] = field(default_factory=dict)
    """Index of a frame -> steps since the initial world. Frames of damage are not in it."""

    def add(self, task: Task, worlds: Particles, step: int, damage: str = "") -> None:
        """Append a picture of the first world; its caption has the step, and damage just now."""
        if not damage:
            self.steps[len(self.frames)] = step
        self.frames.append(to_uint8(task.picture(worlds.x, worlds.s)[0], self.background))
        self.captions.append(f"step {step}: {damage}" if damage else f"step {step}")

    def filmstrip(self, count: int = 10) -> tuple[list[Frame], list[str]]:
        """Return about `count` frames, and their captions, that summarise the film.

        They are those near steps 0, 16, 32, 64 and 128, all frames of damage, the last one, and
        some between. A film that ends by step 128 gives frames of damage and evenly spaced ones.
        """
        # Most of the growth is there.
        early_steps = (0, 16, 32, 64, 128)
        damaged, last = {*range(len(self.frames))} - self.steps.keys(), len(self.frames) - 1
        if max(self.steps.values(), default=0) <= early_steps[-1]:
            others = max(count - 2 - len(damaged), 2)
            even = np.linspace(0, last, min(others, len(self.frames)))
            chosen = sorted({*damaged, *(round(float(k)) for k in even)})
        else:
            early = {min(self.steps, key=lambda k: abs(self.steps[k] - n)) for n in early_steps}
            chosen = sorted({*early, *damaged, last})
            while len(chosen) < min(count, len(self.frames)):
                start, end = max(pairwise(chosen), key=lambda pair: pair[1] - pair[0])
                chosen = sorted([*chosen, (start + end) // 2])
        return [self.frames[k] for k in chosen], [self.captions[k] for k in chosen]

    def write(self, folder: Path, name: str, *, fps: float = 25.0) -> list[Path]:
        """Write NAME.gif, NAME.mp4 and NAME-filmstrip.png to a folder; return their paths."""
        strip, captions = self.filmstrip()
        paths = [folder / f"{name}.gif", folder / f"{name}.mp4", folder / f"{name}-filmstrip.png"]
        write_gif(paths[0], self.frames, fps)
        columns = math.ceil(len(strip) / math.ceil(len(strip) / 8))
        write_filmstrip(paths[2], strip, captions, columns=columns, background=self.background)
        # Written last, as it needs ffmpeg and the others do not.
        write_mp4(paths[1], self.frames, fps)
        return paths


@torch.no_grad()
def film_world(
    rule: NPARule,
    task: Task,
    worlds: Particles,
    steps: int,
    *,
    generator: torch.Generator,
    damages: Sequence[DamageEvent] = (),
    every: int | None = None,
    first_step: int = 0,
    film: WorldFilm | None = None,
    progress: Callable[[int], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Particles, WorldFilm]:
    """Run one world for `steps` steps; return it as it is then, and its film.

    There is a frame every `every` steps (None: about 150 in all), and one after each of `damages`,
    whose steps count from the initial world; `first_step` is the age of `worlds`. Frames are
    appended to `film`; None: to a new one. `progress` is called with the steps since its last call.
    After each frame the run ends if `stop` returns True.
    """
    film = WorldFilm() if film is None else film
    last = first_step + steps
    every = every or math.ceil(steps / 150)
    stops = {damage.step for damage in damages if first_step <= damage.step < last}
    stops |= {*range(first_step, last, every), last}
    now = first_step
    for step in sorted(stops):
        worlds = rollout_particles(
            rule, worlds, step - now, generator=generator, **task.rollout_options
        )
        progress(step - now)
        now = step
        if not film.frames or step > first_step:
            film.add(task, worlds, step)
        for damage in damages:
            if damage.step == step < last:
                worlds = damage_worlds(
                    worlds, kind=damage.kind, size=damage.size, box=task.box, generator=generator
                )
                worlds = worlds._replace(s=task.with_target_code(worlds.s))
                film.add(task, worlds, step, damage.text)
        if stop():
            break
    return worlds, film


@torch.no_grad()
def write_3d_world(
    task: Task,
    worlds: Particles,
    folder: Path,
    *,
    drawn_by: Task,
    resolution: int = SCREEN,
    background: str = "white",
) -> list[Path]:
    """Write a 3D world as a turntable, drawn by a task, and as point files; return the paths."""
    names = ("turntable.gif", "points.ply", "gaussians.ply", "cloud.splat")
    paths = [folder / name for name in names]
    x, s, *_ = worlds
    frames = turntable_frames(
        lambda cameras: cast(Morphogenesis3D, drawn_by).views(x, s, cameras),
        resolution=resolution,
        background=background,
        device=x.device,
    )
    gaussians = cast(Morphogenesis3D, task).gaussians(s)
    write_gif(paths[0], frames, fps=20.0)
    write_points(paths[1], x, gaussians)
    write_gaussians(paths[2], x, gaussians)
    write_splat(paths[3], x, gaussians)
    return paths


# Hidden states of particles of many clouds.

DOT, DOT_SIGMA = 0.03, 0.7
"""Size of a dot in a picture of states whose half width is 1, and its splat's deviation / size."""


def in_the_plane(points: Tensor) -> Tensor:
    """Return points [M, C] projected to the plane so that neighbours stay neighbours, [M, 2].

    By UMAP where umap-learn is installed, else by scikit-learn's t-SNE, without either by the two
    principal components.
    """
    values = points.detach().double().cpu()
    try:
        try:
            from umap import UMAP

            method = UMAP(n_jobs=1, random_state=0)
        except ImportError:
            from sklearn.manifold import TSNE

            perplexity = min(30.0, (len(values) - 1) / 3)
            method = TSNE(perplexity=perplexity, max_iter=500, init="pca", random_state=0)
    except ImportError:
        left, size, _ = torch.linalg.svd(values - values.mean(0), full_matrices=False)
        return torch.mul(left, size)[:, :2].float()
    return torch.from_numpy(method.fit_transform(values.numpy())).float()


def film_states(
    states: Tensor, label: Tensor, steps: Sequence[int], *, between: int = 6
) -> tuple[list[Frame], list[Frame]]:
    """Return a film of hidden states at T steps, [T, P, C], and those of its frames at the steps.

    The states of P particles are projected to the plane, those of all steps at once; between two
    steps are `between` frames of interpolated positions. Colours are those of the classes `label`
    of the particles' clouds, [P], whose numbers stand at their medians in the last frame.
    """
    x = in_the_plane(states.flatten(0, 1))
    low, high = x.aminmax(dim=0)
    x = ((2.0 * x - low - high) / (high - low).max()).view(len(steps), -1, 2)
    label, edge = label.cpu(), 1.0 + 2.0 * DOT
    colour = class_colours(torch.nn.functional.one_hot(label).float())[None]
    size: dict[str, Any] = {"resolution": SCREEN, "pixel_size": DOT, "lo": -edge, "hi": edge}
    font: Any = ImageFont.load_default(SCREEN / 16)
    frames = []
    for count in range((len(steps) - 1) * (between + 1) + 1):
        last, part = divmod(count, between + 1)
        after = min(last + 1, len(steps) - 1)
        now = torch.lerp(x[last], x[after], part / (between + 1))
        frame = Image.fromarray(to_uint8(splat(now[None], colour, sigma=DOT_SIGMA, **size)[0]))
        draw = ImageDraw.Draw(frame)
        draw.text((4, 2), f"step {steps[last]}", "#333333", font)
        for number in set(label.tolist()) if last == after else ():
            across, up = (now[label == number].median(0).values / edge).tolist()
            place = 0.5 * SCREEN * (1.0 + across), 0.5 * SCREEN * (1.0 - up)
            draw.text(place, str(number), "black", font, "mm", stroke_width=2, stroke_fill="white")
        frames.append(np.asarray(frame))
    return frames, frames[:: between + 1]
