"""Pictures of worlds that several species share."""

from __future__ import annotations

import colorsys

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.species.config import SPECIES_STYLE
from npa_envs.envs.species.world import SpeciesWorld
from npa_envs.envs.task import SHARPNESS
from npa_envs.render import draw_worlds
from npa_envs.rule import COLOUR_OFFSET


def species_colours(species_count: int) -> Tensor:
    """Return a colour for each species, evenly around the wheel, in [0, 1], shape [K, 3]."""
    hues = [k / species_count for k in range(species_count)]
    return torch.tensor([colorsys.hsv_to_rgb(hue, 0.85, 0.8) for hue in hues])


class SpeciesView:
    """A world as `Screen` sees it: a batch of one, and a task that draws it.

    Args:
        world: The world.
    """

    world_count = 1
    """Worlds to be shown."""

    def __init__(self, world: SpeciesWorld) -> None:
        self._world = world
        self.config = world.config
        self.elapsed = world.elapsed

    @property
    def task(self) -> SpeciesView:
        """What draws."""
        return self

    @property
    def x(self) -> Tensor:
        """Positions [length units], shape [1, N, 2]."""
        return self._world.x

    @property
    def s(self) -> Tensor:
        """States, dimensionless, shape [1, N, C]."""
        return self._world.s

    def draw(self, x: Tensor, s: Tensor, steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return the world's picture, shape [1, R, R, 3]; white where nobody is left.

        Args:
            x: Its positions.
            s: Its states.
            steps: Not used.
        """
        config, task = self.config, self._world.task
        size, style = config.render_size, config.render_style
        if x.shape[1] == 0:
            return np.full((1, size, size, 3), 255, np.uint8)
        if style == SPECIES_STYLE:
            style = "particles"
            colours = species_colours(config.species_count).to(s)
            s = (colours[self._world.population.species] - COLOUR_OFFSET)[None]
        periodic = config.boundary == "periodic"
        return draw_worlds(
            x,
            s,
            style=style,
            resolution=size,
            pixel_size=task.pixel_size,
            sigma=SHARPNESS,
            half_width=task.half_width,
            periodic=periodic and config.box_size >= 2.0,
        )
