"""Draw the film at the top of README, `docs/images/gecko.webp`: growth, a cut, erasure, healing.

    python docs/draw_film.py

It takes a minute on a CPU. Draw anew when the gecko's rule changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

import npa_envs
from npa_envs.files import atomic_path
from npa_envs.render import draw_worlds
from npa_envs.training.trained_tasks import task_of_rule
from npa_envs.world.brushes import cut, erase_state

IMAGES = Path(__file__).resolve().parent / "images"
SEED = 1_000_001
RESOLUTION = 512
FRAME_MILLISECONDS = 50
QUALITY = 50
"""Of WebP, 0 to 100: a GIF of the same film takes five times as much."""
STILL = 8
"""Frames for which the film holds its breath before something happens."""

# Steps from frame to frame: slow where the eye has much to see.
GROWTH = [0] * STILL + [1] * 24 + [2] * 20 + [4] * 16 + [16] * 12
HEALING = [0] * STILL + [1] * 12 + [2] * 14 + [8] * 14


@torch.no_grad()
def frames() -> Iterator[NDArray[np.uint8]]:
    """Draw the gecko's world after each stretch of steps."""
    rule = npa_envs.load_rule("gecko")
    task = task_of_rule("gecko", rule, torch.device("cpu")).task
    generator = torch.Generator().manual_seed(SEED)
    x, s = task.seed(1, generator=generator)

    def picture() -> NDArray[np.uint8]:
        drawn: NDArray[np.uint8] = draw_worlds(
            x,
            s,
            resolution=RESOLUTION,
            pixel_size=task.target.pixel_size,
            sigma=0.55,
            half_width=1.0,
        )
        return drawn[0]

    def run(stretches: list[int]) -> Iterator[NDArray[np.uint8]]:
        nonlocal x, s
        for steps in stretches:
            if steps:
                x, s = npa_envs.rollout(
                    rule, x, s, steps, update_prob=task.update_prob, generator=generator
                )
            yield picture()

    def place(*coordinates: float) -> Tensor:
        return x.new_tensor([coordinates])

    yield from run(GROWTH)
    x, s = cut(x, s, centre=place(0.0, 0.0), normal=place(0.8, 1.0), gap=0.16)
    yield from run(HEALING)
    s = erase_state(x, s, centre=place(0.3, 0.3), radius=0.22)
    yield from run(HEALING + [0] * STILL)


if __name__ == "__main__":
    first, *others = map(Image.fromarray, frames())
    with atomic_path(IMAGES / "gecko.webp") as temporary:
        first.save(
            temporary,
            format="WebP",
            save_all=True,
            append_images=others,
            duration=FRAME_MILLISECONDS,
            loop=0,
            quality=QUALITY,
            method=4,
        )
