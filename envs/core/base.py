"""Base classes of environments: spaces, conversion of actions and observations, rendering.

Users give and get NumPy arrays or torch tensors; worlds take float32 tensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import number_tensor
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.step_report import StepNumbers, named_terms
from npa_envs.envs.core.task import EnvTask
from npa_envs.envs.core.worlds import CentralWorlds, ParticleWorlds
from npa_envs.errors import NPAError
from npa_envs.render import Window, show
from npa_envs.render.display import side_by_side
from npa_envs.world.cuda_graph import to_device_async
from npa_envs.world.environment_steps import Physics

SHOWN_ACROSS = 4
"""Maximum number of worlds side by side in a window, and of rows of worlds."""


class ParticleSpaces:
    """Spaces of observations and actions with a row for each particle, and conversions of both."""

    def __init__(self, physics: Physics, config: EnvConfig) -> None:
        count, limit = config.particle_count, physics.limits.perception
        columns = physics.perception_dim + config.target_dim
        self.observation_space: Space[Any] = Box(-limit, limit, (count, columns), np.float32)
        """Space of one world's observations."""
        self._shape = (count, physics.action_dim)
        self.action_space: Space[Any] = Box(-1.0, 1.0, self._shape, np.float32)
        """Space of one world's actions."""
        self._output = config.output

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return checked actions, float32, [B, N, A]; `world_count` None: of one world, B = 1."""
        return batch_tensor(action, world_count, self._shape, "N, A")

    def observation_output(self, observation: Tensor) -> Any:
        """Return observations, [B, N, P] or [N, P], as array or tensor, as `config.output` says."""
        return to_output(observation, self._output)

    def final_observation_output(self, observation: Tensor, ended: NDArray[np.bool_]) -> Any:
        """Return `infos["final_obs"]` for observations [B, ...]; `ended`: of which worlds, [B].

        Tensors are those of all worlds. Arrays are objects of an array, and None elsewhere.
        """
        batched = self.observation_output(observation)
        return batched if self._output == "torch" else per_world(batched, ended)


class CentralSpaces(ParticleSpaces):
    """Spaces of a controller that observes a coarse picture and acts at the places of a grid."""

    def __init__(self, physics: Physics, config: EnvConfig) -> None:
        super().__init__(physics, config)
        limit, size = physics.limits.perception, 4 * config.picture_size**2
        self.observation_space = Box(-limit, limit, (size,), np.float32)
        self._shape = (config.place_count**2, physics.action_dim)
        self._flat = (self._shape[0] * self._shape[1],)
        self.action_space = Box(-1.0, 1.0, self._flat, np.float32)

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return checked actions, float32, [B, P², A]: a row for each place, bottom row first."""
        return batch_tensor(action, world_count, self._flat, "P² A").view(-1, *self._shape)


def to_output(tensor: Tensor, output: str) -> Any:
    """Return a tensor as it is if `output` is "torch", as a NumPy array if it is "numpy"."""
    return tensor if output == "torch" else tensor.cpu().numpy()


def per_world(batched: Any, which: NDArray[np.bool_]) -> NDArray[Any]:
    """Return observations of worlds, objects [B], from an array [B, ...] or a dict of arrays.

    Worlds where `which`, [B], is False have None.
    """
    worlds = np.full(len(which), None, dtype=object)
    for k in np.flatnonzero(which):
        is_dict = isinstance(batched, dict)
        worlds[k] = {n: rows[k] for n, rows in batched.items()} if is_dict else batched[k]
    return worlds


def batch_tensor(
    action: Any,
    world_count: int | None,
    shape: tuple[int, ...],
    letters: str,
    *,
    discrete: bool = False,
) -> Tensor:
    """Return checked actions of `world_count` worlds, float32, [B, *shape].

    `world_count` None: `action` is that of one world, [*shape], and B is 1. `letters` names the
    dimensions of `shape` in the error message, such as "N, A". `discrete` actions are int64.
    """
    expected = shape
    if world_count is not None:
        expected, letters = (world_count, *shape), ", ".join(filter(None, ("B", letters)))
    if not discrete:
        checked = action_tensor("action", action, expected, "env.action_space", f"[{letters}] = ")
        return checked[None] if world_count is None else checked
    choices = number_tensor("action", action)
    if tuple(choices.shape) != expected or choices.is_floating_point():
        raise NPAError(
            f"action must be whole numbers of shape [{letters}] = {expected}, got "
            f"{tuple(choices.shape)} of {choices.dtype}: see env.action_space"
        )
    return choices.long().view(-1, *shape)


def action_tensor(
    name: str, action: Any, expected: tuple[int, ...], space: str, letters: str = ""
) -> Tensor:
    """Return an action of shape `expected` as float32, after a check; a tensor keeps its device.

    The error message calls the action `name`, and refers to the space called `space`.
    """
    actual = ""
    if not isinstance(action, Tensor):
        try:
            array = np.asanyarray(action)
            if array.dtype.kind not in "biufO" or np.ma.is_masked(array):
                raise TypeError("no real numbers, or some that are masked")
            # Torch needs writable arrays.
            action = torch.from_numpy(np.require(array, np.float32, ("C", "W")))
        except (TypeError, ValueError, OverflowError):
            actual = type(action).__name__
            actual += f" of {action.dtype}" if isinstance(action, np.ndarray) else ""
    if not actual and (tuple(action.shape) != expected or action.dtype.is_complex):
        actual = f"{tuple(action.shape)} of {action.dtype}"
    elif not actual and (action.layout != torch.strided or action.is_meta):
        actual = f"a tensor that is {action.layout} on {action.device}"
    if actual:
        raise NPAError(
            f"{name} must be real numbers of shape {letters}{expected}, got {actual}: see {space}"
        )
    checked: Tensor = action.detach().to(torch.float32)
    return checked


class ShownEnv:
    """Base class of all environments: pictures, the window, and arrays or tensors as output."""

    config: Any
    """The environment's configuration."""
    worlds: Any
    """The batch of worlds."""
    metadata: Any = {"render_modes": ["rgb_array", "human"], "render_fps": 25}  # noqa: RUF012
    _is_batch: ClassVar[bool] = False
    _started = False
    _closed = False
    _window: Window | None = None

    def render(self) -> Any:
        """Return a picture, uint8, [R, R, 3], or a tuple of one for each world of a batch.

        The result is None unless `render_mode` is "rgb_array".
        """
        self.check_begun("render needs worlds")
        if self.config.render_mode is None:
            gymnasium.logger.warn(
                "render() draws nothing without a render_mode: make the environment with "
                "render_mode='rgb_array' or 'human'"
            )
        # A window is updated by reset and step.
        if self.config.render_mode != "rgb_array":
            return None
        pictures = tuple(self.worlds.pictures(self.worlds.world_count))
        return pictures if self._is_batch else pictures[0]

    def check_begun(self, what: str) -> None:
        """Raise an NPAError unless there are worlds; `what` needs them, as "step needs worlds"."""
        if not self._started:
            closed = ", which close has ended" if self._closed else ""
            raise NPAError(f"{what}{closed}: call reset first")

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """Return what Jupyter displays: text, and after a reset pictures of the first worlds."""
        text = {"text/plain": str(self)}
        if not self._started:
            return text
        count = min(self.worlds.world_count, SHOWN_ACROSS**2)
        return show(side_by_side(self.worlds.pictures(count)))._repr_mimebundle_() | text

    def _show_in_window(self, title: str) -> None:
        """Show the first worlds in a window if `render_mode` is "human"."""
        if self.config.render_mode != "human":
            return
        count, size = self.worlds.world_count, self.config.render_size
        across = min(math.ceil(math.sqrt(count)), SHOWN_ACROSS)
        shown = min(count, across * across)
        frame = np.full((across * across, size, size, 3), 255, np.uint8)
        frame[:shown] = self.worlds.pictures(shown)
        frame = frame.reshape(across, across, size, size, 3).swapaxes(1, 2)
        if self._window is None:
            self._window = Window(title, across * size, fps=self.metadata["render_fps"])
        self._window.show(frame.reshape(across * size, across * size, 3))

    def close(self) -> None:
        """End all worlds, until the next reset, and close the window, if there is one."""
        self._started, self._closed = False, True
        if self._window is not None:
            self._window.close()
            self._window = None

    def _out(self, values: Tensor | NDArray[Any]) -> Any:
        """Return values as an array, or as a tensor on the device if `output` is "torch"."""
        if isinstance(values, np.ndarray) and self.config.output == "torch":
            return to_device_async(values, self.worlds.device)
        return to_output(values, self.config.output) if isinstance(values, Tensor) else values


class WorldsEnv(ShownEnv):
    """Base class of environments of one species; subclasses set `task_type`."""

    task_type: ClassVar[type[EnvTask[Any]]]
    """Class of the task."""

    spec: Any

    def _make_worlds(self, keywords: dict[str, Any], world_count: int, steps: int | None) -> None:
        """Set `config`, `worlds`, `task` and `spaces`; `steps`: maximum of an episode."""
        self.config = self.task_type.config_type.from_keywords(keywords)
        self.render_mode = self.config.render_mode
        is_central = self.config.control == "central"
        worlds_type = self.task_type.worlds_type or ParticleWorlds
        worlds_type = CentralWorlds if is_central else worlds_type
        self.worlds = worlds_type(self.task_type, self.config, world_count, steps)
        self.task = self.worlds.task
        spaces_type = self.task_type.spaces_type or ParticleSpaces
        spaces_type = CentralSpaces if is_central else spaces_type
        self.spaces: ParticleSpaces = spaces_type(self.worlds.physics, self.config)

    def _change_worlds(
        self,
        change: Callable[..., Any],
        world_indices: Tensor,
        values: Any,
        buffer: Tensor | None = None,
    ) -> Tensor:
        """Call `change(world_indices, values)`; return observations, in `buffer` if given."""
        with self.worlds.device_context():
            change(world_indices, values)
            observation: Tensor = self.worlds.perceive(buffer)
        self._started = True
        self._show()
        return observation

    def losses_of(self, numbers: Any) -> dict[str, Any]:
        """Return the loss and its terms by name, as in infos, from `StepReport.numbers`."""
        named, names = StepNumbers.from_rows(numbers), self.worlds.episodes.term_names
        return {"loss": named.loss} | named_terms("loss", names, named.terms)

    def _improvements(self, numbers: Any) -> dict[str, Any]:
        improvements = StepNumbers.from_rows(numbers).improvements
        return named_terms("reward", self.worlds.episodes.term_names, improvements)

    def _show(self) -> None:
        self._show_in_window(self.spec.id if self.spec is not None else type(self).__name__)
