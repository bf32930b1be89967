"""Pictures of worlds that several species share."""

from __future__ import annotations

import colorsys

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.task import SHARPNESS
from npa_envs.envs.multi.config import SPECIES_STYLE
from npa_envs.envs.multi.task import Population
from npa_envs.envs.multi.worlds import SpeciesWorlds
from npa_envs.render import draw_worlds
from npa_envs.rule.rule import COLOUR_OFFSET


def species_colours(species_count: int) -> Tensor:
    """Return a colour for each species, evenly around the wheel, in [0, 1], shape [K, 3]."""
    hues = [k / species_count for k in range(species_count)]
    return torch.tensor([colorsys.hsv_to_rgb(hue, 0.85, 0.8) for hue in hues])


class SpeciesView:
    """Worlds of several species as they are drawn.

    Args:
        worlds: The worlds.
    """

    def __init__(self, worlds: SpeciesWorlds) -> None:
        self._worlds = worlds
        self.config = worlds.config
        self.world_count = worlds.world_count

    def pictures(self, count: int) -> NDArray[np.uint8]:
        """Return pictures of the first worlds, shape [count, R, R, 3]; white where nobody is left.

        Args:
            count: How many.
        """
        return np.concatenate([self._picture(self._worlds.population(k)) for k in range(count)])

    def _picture(self, population: Population) -> NDArray[np.uint8]:
        config, task = self.config, self._worlds.task
        size, style = config.render_size, config.render_style
        x, s = population.x, population.s
        if x.shape[1] == 0:
            return np.full((1, size, size, 3), 255, np.uint8)
        if style == SPECIES_STYLE:
            style = "particles"
            colours = species_colours(config.species_count).to(s)
            s = (colours[population.species] - COLOUR_OFFSET)[None]
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
