"""Worlds in the looping films of the pages, which are WebP."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import npa_envs
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task

IMAGES = Path(__file__).resolve().parents[1] / "images"
FPS = 20.0
STILL = 8
"""Frames for which a film holds its breath before something happens."""

Frame = NDArray[np.uint8]


def opened(frames: Iterable[Frame], fps: float) -> list[Frame]:
    """Show what has grown first, for two seconds: it is all that is seen of a film at rest."""
    frames = [*frames]
    return [frames[-1]] * round(2 * fps) + frames


class FilmedWorld:
    """Worlds of one rule that are drawn after each stretch of steps."""

    x: Tensor
    """Positions [length units], shape [B, N, D]."""

    s: Tensor
    """States, shape [B, N, C]."""

    def __init__(
        self,
        rule: NPARule,
        task: Task,
        draw: Callable[[Tensor, Tensor], Frame],
        *,
        seed: int,
        world_count: int = 1,
    ) -> None:
        self.rule, self.task, self.draw = rule, task, draw
        self.generator = torch.Generator().manual_seed(seed)
        cpu = torch.device("cpu")
        self.x, self.s, *_ = task.seed(world_count, generator=self.generator, device=cpu)

    @torch.no_grad()
    def run(self, stretches: Sequence[int]) -> Iterator[Frame]:
        """Run so many steps before each picture; none for a picture that stands still."""
        for steps in stretches:
            if steps:
                self.x, self.s = npa_envs.rollout(
                    self.rule,
                    self.x,
                    self.s,
                    steps,
                    box=self.task.box,
                    update_prob=self.task.update_prob,
                    generator=self.generator,
                )
            yield self.draw(self.x, self.s)
