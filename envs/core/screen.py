"""The window that shows worlds side by side, and what `render` returns."""

from __future__ import annotations

import math
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from npa_envs.envs.core.config import WorldConfig
from npa_envs.render import Window, show
from npa_envs.render.display import side_by_side

SHOWN_ACROSS = 4
"""A window shows at most so many worlds side by side."""


class Drawn(Protocol):
    """Worlds that can be drawn."""

    world_count: int

    def pictures(self, count: int) -> NDArray[np.uint8]:
        """Return pictures of the first worlds, uint8, shape [count, R, R, 3]."""


class Screen:
    """What `render` of an environment returns or shows.

    Args:
        worlds: The environment's worlds.
        config: The environment's configuration.
        fps: Most frames a second that the window shows.
    """

    def __init__(self, worlds: Drawn, config: WorldConfig, fps: float) -> None:
        self._worlds = worlds
        self._config = config
        self._fps = fps
        self._window: Window | None = None

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of each world, uint8, shape [B, R, R, 3]; None unless "rgb_array"."""
        if self._config.render_mode is None:
            gymnasium.logger.warn(
                "render() draws nothing without a render_mode: make the environment with "
                "render_mode='rgb_array' or 'human'"
            )
        # A window already shows the worlds as they are.
        if self._config.render_mode != "rgb_array":
            return None
        return self._worlds.pictures(self._worlds.world_count)

    def for_notebook(self, name: str) -> dict[str, Any]:
        """Return what Jupyter shows in place of an environment: the worlds as they are, or some."""
        count = min(self._worlds.world_count, SHOWN_ACROSS**2)
        told: dict[str, Any] = show(side_by_side(self._worlds.pictures(count)))._repr_mimebundle_()
        return told | {"text/plain": name}

    def show(self, title: str) -> None:
        """Show the worlds as they are, the first ones where they are many; only if "human"."""
        if self._config.render_mode != "human":
            return
        count, size = self._worlds.world_count, self._config.render_size
        across = min(math.ceil(math.sqrt(count)), SHOWN_ACROSS)
        shown = min(count, across * across)
        frame = np.full((across * across, size, size, 3), 255, np.uint8)
        frame[:shown] = self._worlds.pictures(shown)
        frame = frame.reshape(across, across, size, size, 3).swapaxes(1, 2)
        if self._window is None:
            self._window = Window(title, across * size, fps=self._fps)
        self._window.show(frame.reshape(across * size, across * size, 3))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
