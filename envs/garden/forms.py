"""Spaces of gardens, and their arrays in and out."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, MultiDiscrete, Space
from torch import Tensor

from npa_envs.envs.core.spaces import Rows, action_tensor, number_tensor
from npa_envs.envs.garden.brushwork import PLACE, Columns, tool_table
from npa_envs.envs.garden.config import GardenConfig
from npa_envs.envs.garden.task import SEEN_LIMIT
from npa_envs.errors import NPAError, shown
from npa_envs.world.actions import Physics


class Brushes(Rows):
    """A coarse picture or moments are seen; actions say what each brush does.

    Args:
        physics: The worlds' constants.
        config: The environment's configuration.
    """

    def __init__(self, physics: Physics, config: GardenConfig) -> None:
        self._config = config
        self._output = config.output
        space = observed(config)
        self.observation_space: Space[Any] = space
        self.seen_dim = len(space.shape)
        """Dimensions of what is seen of one world."""
        width = Columns.of(config).width
        self._shape = (config.brush_count, width)
        self._tools = tool_table(config)
        self._choices = [config.place_count] * 2 + [len(self._tools), config.strength_count]
        self.action_space: Space[Any] = Box(-1.0, 1.0, self._shape, np.float32)
        if config.actions == "discrete":
            self.action_space = MultiDiscrete(self._choices * config.brush_count)

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return actions as worlds take them, rows of brushes, float32, shape [B, K, W].

        Raises:
            NPAError: They are no numbers, or have another shape, or a choice does not exist.
        """
        batch = () if world_count is None else (world_count,)
        letters = "" if world_count is None else "B, "
        if self._config.actions == "box":
            shape = (*batch, *self._shape)
            rows = action_tensor("action", action, shape, "env.action_space", f"[{letters}K, W] = ")
            return rows.view(-1, *self._shape)
        brushes = self._config.brush_count
        wanted = (*batch, 4 * brushes)
        chosen = number_tensor("action", action)
        if tuple(chosen.shape) != wanted or chosen.is_floating_point():
            raise NPAError(
                f"action must be whole numbers of shape [{letters}4 K] = {wanted}, got "
                f"{tuple(chosen.shape)} of {chosen.dtype}: see env.action_space"
            )
        chosen = chosen.long().view(-1, brushes, 4)
        highest = torch.tensor(self._choices, device=chosen.device)
        if not bool(((chosen >= 0) & (chosen < highest)).all()):
            raise NPAError(
                f"action must choose below {self._choices} for each brush (place across and up, "
                f"tool, strength), got numbers up to {shown(int(chosen.abs().max()))}"
            )
        return self._rows(chosen)

    def _rows(self, chosen: Tensor) -> Tensor:
        """Return the rows of brushes that choices mean, shape [B, K, W]."""
        config, tools = self._config, self._tools.to(chosen.device)
        places = (2.0 * chosen[..., PLACE] + 1.0) / config.place_count - 1.0
        strength = (chosen[..., 3:] + 1.0) / config.strength_count
        return torch.cat((places, strength * tools[chosen[..., 2]]), dim=-1)


def observed(config: GardenConfig) -> Box:
    """Return the space of what is seen of a world."""
    shape: tuple[int, ...] = (5 + 3 * config.state_dim,)
    if config.observe == "picture":
        shape = ((8 if config.observe_error else 4) * config.picture_size**2,)
    return Box(-SEEN_LIMIT, SEEN_LIMIT, shape, np.float32)
