"""Draw the films of the gallery, `docs/images/gallery/NAME.webp`: every shipped rule at work.

    python docs/scripts/draw_gallery.py [NAME ...]

It takes ten minutes on a CPU. Draw anew when a rule changes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import numpy as np
import torch
from films import FPS, IMAGES, STILL, FilmedWorld, Frame, opened
from torch import Tensor

import npa_envs
from npa_envs.render import to_uint8, turntable_frames, write_webp
from npa_envs.rule.files import shipped_rules
from npa_envs.tasks.damage import damage_worlds
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.particles import Particles

FOLDER = IMAGES / "gallery"
SEED = 1_000_001
RESOLUTION = 256
CPU = torch.device("cpu")

# Steps from frame to frame: slow where the eye has much to see.
GROWTH = [0] * STILL + [1] * 20 + [2] * 14 + [4] * 10 + [16] * 12 + [0] * STILL
HEALING = [0] * STILL + [1] * 12 + [2] * 10 + [8] * 8 + [0] * STILL
ORDER = [0] * STILL + [1] * 16 + [2] * 14 + [4] * 10 + [16] * 8 + [0] * STILL
SOLID = [0] * 2 + [1] * 16 + [2] * 10 + [4] * 10 + [2] * 22
AGREEMENT = [0] * STILL + [1] * 32 + [0] * STILL


def picture(task: Any) -> Callable[[Tensor, Tensor], Frame]:
    """Return what draws the first world."""
    return lambda x, s: to_uint8(task.picture(x, s)[0])


def grown_and_cut(name: str) -> Iterator[Frame]:
    """Grow a picture, cut it in two, and let it heal."""
    rule, task = loaded(name, resolution=RESOLUTION)
    world = FilmedWorld(rule, task, picture(task), seed=SEED)
    yield from world.run(GROWTH)
    cut = damage_worlds(
        Particles(world.x, world.s), kind="cut", size=0.1, generator=world.generator
    )
    world.x, world.s = cut.x, cut.s
    yield from world.run(HEALING)


def ordered(name: str) -> Iterator[Frame]:
    """Let a texture arise."""
    rule, task = loaded(name, resolution=RESOLUTION)
    yield from FilmedWorld(rule, task, picture(task), seed=SEED).run(ORDER)


def turned(name: str) -> Iterator[Frame]:
    """Grow a thing while the camera goes once around it."""
    rule, task = loaded(name)
    turn = count(0.0, 360.0 / len(SOLID))

    def draw(x: Tensor, s: Tensor) -> Frame:
        (frame,) = turntable_frames(
            lambda cameras: task.views(x, s, cameras),
            frame_count=1,
            resolution=RESOLUTION,
            azimuth=next(turn),
        )
        return frame

    yield from FilmedWorld(rule, task, draw, seed=SEED).run(SOLID)


def agreed(name: str) -> Iterator[Frame]:
    """Let four clouds agree on what they are, two by two."""
    rule, task = loaded(name, resolution=RESOLUTION // 2)

    def draw(x: Tensor, s: Tensor) -> Frame:
        tiles = [to_uint8(tile) for tile in task.picture(x, s)]
        return np.vstack((np.hstack(tiles[:2]), np.hstack(tiles[2:])))

    yield from FilmedWorld(rule, task, draw, seed=SEED, world_count=4).run(AGREEMENT)


def loaded(name: str, **fields: Any) -> tuple[npa_envs.NPARule, Any]:
    """Return a shipped rule and its task, with some fields of its configuration changed."""
    rule = npa_envs.load_rule(name)
    return rule, task_of_rule(name, rule, CPU, **fields).task


FILMS = {
    "morphogenesis2d": grown_and_cut,
    "texture": ordered,
    "morphogenesis3d": turned,
    "point_classification": agreed,
}
"""What the films of a task's rules show."""

QUALITY = {"texture": 40}
"""Quality of their pictures, where it is not the usual: noise all over is long to tell."""


def main(names: list[str]) -> None:
    """Draw the films of the rules, all of them if none is named."""
    for task, film in FILMS.items():
        for name in shipped_rules(task):
            if name in names or not names:
                frames = opened(film(name), FPS)
                write_webp(FOLDER / f"{name}.webp", frames, FPS, quality=QUALITY.get(task, 50))


if __name__ == "__main__":
    main(sys.argv[1:])
