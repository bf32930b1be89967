"""Draw the film at the top of README, `docs/images/gecko.webp`: growth, a cut, a wiped eye.

    python docs/scripts/draw_film.py

It takes a minute on a CPU. Draw anew when the gecko's rule changes.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from films import IMAGES, STILL, FilmedWorld, Frame, opened
from torch import Tensor

import npa_envs
from npa_envs.render import draw_worlds, write_webp
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.brushes import cut, wipe_state

SEED = 1_000_001
RESOLUTION = 512
FPS = 16.0
EYE = (0.27, 0.69)
"""The gecko's right eye [length units]."""

# Steps from frame to frame: slow where the eye has much to see.
GROWTH = [0] * STILL + [1] * 68 + [4] * 15 + [16] * 8
HEALING = [0] * STILL + [1] * 20 + [4] * 16 + [16] * 24


def frames() -> Iterator[Frame]:
    """Draw the gecko's world after each stretch of steps."""
    task = task_of_rule("gecko", npa_envs.load_rule("gecko"), torch.device("cpu")).task

    def draw(x: Tensor, s: Tensor) -> Frame:
        drawn: Frame = draw_worlds(
            x,
            s,
            resolution=RESOLUTION,
            pixel_size=task.target.pixel_size,
            sigma=0.55,
            half_width=1.0,
        )[0]
        return drawn

    def place(*coordinates: float) -> Tensor:
        return torch.tensor([coordinates])

    world = FilmedWorld(npa_envs.load_rule("gecko"), task, draw, seed=SEED)
    yield from world.run(GROWTH)
    world.x, world.s = cut(
        world.x, world.s, centre=place(0.0, 0.0), normal=place(0.8, 1.0), gap=0.16
    )
    yield from world.run(HEALING)
    world.s = wipe_state(world.x, world.s, centre=place(*EYE), radius=0.2)
    yield from world.run(HEALING + [0] * STILL)


if __name__ == "__main__":
    write_webp(IMAGES / "gecko.webp", opened(frames(), FPS), FPS)
