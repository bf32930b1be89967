"""The window that shows worlds side by side, and what `render` returns."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.config import WorldConfig
from npa_envs.envs.core.spaces import ParticleSpaces, to_output
from npa_envs.envs.core.task import EnvTask
from npa_envs.envs.core.worlds import PARTICLES, BatchedWorlds, Parts
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
    """What `render` of an environment returns or shows."""

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
        """Return what Jupyter shows of an environment: the worlds as they are, or some."""
        count = min(self._worlds.world_count, SHOWN_ACROSS**2)
        picture = show(side_by_side(self._worlds.pictures(count)))
        return {**picture._repr_mimebundle_(), "text/plain": name}

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


class ShownEnv:
    """The common part of environments of all kinds: pictures, and the type of returned arrays."""

    config: Any
    """The environment's configuration."""
    _screen: Screen
    _started = False

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """Return what Jupyter shows: the worlds as they are, or some, from the first reset on."""
        if not self._started:
            return {"text/plain": str(self)}
        return self._screen.for_notebook(str(self))

    def _out(self, tensor: Tensor) -> Any:
        return to_output(tensor, self.config.output)


class WorldsEnv(ShownEnv):
    """The common part of environments of one species; subclasses name the task."""

    task_type: ClassVar[type[EnvTask[Any]]]
    """The task: starts and losses."""

    parts: ClassVar[Parts] = PARTICLES
    """How the worlds are acted on, observed and judged."""

    form_type: ClassVar[type[ParticleSpaces]] = ParticleSpaces
    """The spaces of observations and actions."""

    metadata: Any
    spec: Any

    def _make_worlds(self, keywords: dict[str, Any], world_count: int, steps: int | None) -> None:
        """Make configuration, worlds, spaces and screen."""
        self.config = self.task_type.config_type.from_keywords(keywords)
        self.render_mode = self.config.render_mode
        self.worlds = BatchedWorlds(
            self.task_type, self.config, world_count, steps, parts=self.parts
        )
        self.task = self.worlds.task
        self.form = self.form_type(self.worlds.physics, self.config)
        self._screen = Screen(self.worlds, self.config, self.metadata["render_fps"])

    def _show(self) -> None:
        self._screen.show(self.spec.id if self.spec is not None else type(self).__name__)
