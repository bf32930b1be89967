"""Spaces of environments, and arrays in and out: NumPy or torch outside, float32 tensors inside."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.config import WorldConfig
from npa_envs.errors import NPAError
from npa_envs.world.actions import Physics


def observation_space(physics: Physics, particle_count: int) -> Box:
    """Return the space of a world's observations: float32, shape [N, P], ± the perception limit."""
    limit = physics.limits.perception
    return Box(-limit, limit, (particle_count, physics.perception_dim), np.float32)


def action_space(physics: Physics, particle_count: int) -> Box:
    """Return the space of a world's actions: float32, shape [N, A], in [-1, 1]."""
    return Box(-1.0, 1.0, (particle_count, physics.action_dim), np.float32)


class ParticleSpaces:
    """How most worlds are seen and acted upon: one row for each particle."""

    def __init__(self, physics: Physics, config: WorldConfig) -> None:
        count = config.particle_count
        self.observation_space: Space[Any] = observation_space(physics, count)
        """Of a world."""
        self.action_space: Space[Any] = action_space(physics, count)
        """Of a world."""
        self._shape = (count, physics.action_dim)
        self._output = config.output

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return actions as worlds take them, float32, [B, N, A]; B is None for a single world."""
        if world_count is None:
            return action_tensor("action", action, self._shape, "env.action_space", "[N, A] = ")[
                None
            ]
        shape = (world_count, *self._shape)
        return action_tensor("action", action, shape, "env.action_space", "[B, N, A] = ")

    def seen(self, observation: Tensor) -> Any:
        """Return observations of worlds, or of one, as they are handed out."""
        return to_output(observation, self._output)

    def last_seen(self, observation: Tensor, ended: NDArray[np.bool_]) -> Any:
        """Return worlds' last observations, [B, ...], where some, bool, [B], have ended."""
        return self.seen(observation)


def to_output(tensor: Tensor, output: str) -> Any:
    """Return a tensor as it is handed out: as it is for "torch", as an array for "numpy"."""
    return tensor if output == "torch" else tensor.cpu().numpy()


def action_tensor(
    name: str, action: Any, wanted: tuple[int, ...], space: str, letters: str = ""
) -> Tensor:
    """Return an action as a float32 tensor, on the device where it came from."""
    came = ""
    if not isinstance(action, Tensor):
        try:
            given = np.asanyarray(action)
            if given.dtype.kind not in "biufO" or np.ma.is_masked(given):
                raise TypeError("no real numbers, or some that are masked")
            # Torch cannot read what may not be written.
            action = torch.from_numpy(np.require(given, np.float32, ("C", "W")))
        except (TypeError, ValueError, OverflowError):
            came = type(action).__name__
            came += f" of {action.dtype}" if isinstance(action, np.ndarray) else ""
    if not came and (tuple(action.shape) != wanted or action.dtype.is_complex):
        came = f"{tuple(action.shape)} of {action.dtype}"
    elif not came and (action.layout != torch.strided or action.is_meta):
        came = f"a tensor that is {action.layout} on {action.device}"
    if came:
        raise NPAError(
            f"{name} must be real numbers of shape {letters}{wanted}, got {came}: see {space}"
        )
    checked: Tensor = action.detach().to(torch.float32)
    return checked
