"""Spaces of gardens, and their arrays in and out."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, MultiDiscrete, Space
from torch import Tensor

from npa_envs.checks import number_tensor
from npa_envs.envs.core.base import ParticleSpaces, action_tensor
from npa_envs.envs.garden.brush_layout import BrushLayout, grid_places, tool_table
from npa_envs.envs.garden.config import GardenConfig
from npa_envs.envs.garden.task import SEEN_AT_A_PLACE, SEEN_LIMIT
from npa_envs.errors import NPAError, shown
from npa_envs.world.actions import Physics


class BrushSpaces(ParticleSpaces):
    """A coarse picture or moments are seen; actions say what each brush does."""

    def __init__(self, physics: Physics, config: GardenConfig) -> None:
        self._config = config
        self._output = config.output
        space = observed(config)
        self.observation_space: Space[Any] = space
        self.seen_dim = len(space.shape)
        """Dimensions of what is seen of one world."""
        on_grid = config.actions == "grid"
        count = config.place_count**2 if on_grid else config.brush_count
        self.rows_shape = (count, BrushLayout.of(config).width)
        """Of the rows of a world's brushes, (K, W)."""
        self._tools = tool_table(config)
        self._choices = [config.place_count] * 2 + [len(self._tools), config.strength_count]
        self.action_space: Space[Any] = Box(-1.0, 1.0, self.rows_shape, np.float32)
        if config.actions == "discrete":
            self.action_space = MultiDiscrete(self._choices * config.brush_count)

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return actions as worlds take them, rows of brushes, float32, shape [B, K, W]."""
        batch = () if world_count is None else (world_count,)
        letters = "" if world_count is None else "B, "
        if self._config.actions != "discrete":
            shape = (*batch, *self.rows_shape)
            rows = action_tensor("action", action, shape, "env.action_space", f"[{letters}K, W] = ")
            return rows.view(-1, *self.rows_shape)
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
        across, up = chosen[..., 0], chosen[..., 1]
        places = grid_places(config, chosen.device)[up * config.place_count + across]
        strength = (chosen[..., 3:] + 1.0) / config.strength_count
        return torch.cat((places, strength * tools[chosen[..., 2]]), dim=-1)


def observed(config: GardenConfig) -> Box:
    """Return the space of what is seen of a world."""
    counts = {
        "grid": SEEN_AT_A_PLACE * config.place_count**2,
        "picture": (8 if config.observe_error else 4) * config.picture_size**2,
        "moments": 5 + 3 * config.state_dim,
    }
    return Box(-SEEN_LIMIT, SEEN_LIMIT, (counts[config.observe],), np.float32)
