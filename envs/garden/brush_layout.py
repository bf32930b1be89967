"""What an agent does to living worlds with its brushes: few numbers, each between -1 and 1."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.garden.config import GardenConfig
from npa_envs.world.brushes import offsets_from, softness

DIRECTIONS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""Ways in which a brush of the "discrete" form pushes."""


class BrushLayout(NamedTuple):
    """Where the numbers of each tool are in a brush's row; empty for what it lacks."""

    place: slice
    push: slice
    wipe: slice
    inject: slice
    rate: slice
    width: int

    @classmethod
    def of(cls, config: GardenConfig) -> BrushLayout:
        """Return the columns of a configuration's brushes; those of a grid stay where they are."""
        widths = {"place": 0 if config.actions == "grid" else 2}
        widths |= {"push": 2, "wipe": 1, "inject": len(config.inject_channels), "rate": 1}
        first, found = 0, {}
        for name, width in widths.items():
            found[name] = slice(first, first + (width * (name in ("place", *config.tools))))
            first = found[name].stop
        return cls(**found, width=first)


def grid_places(config: GardenConfig, device: torch.device | None = None) -> Tensor:
    """Return the places of the grid [length units], row by row from the bottom up, shape [P, 2]."""
    share = torch.arange(config.place_count, device=device) / (config.place_count - 1)
    steps = config.place_reach * (2.0 * share - 1.0)
    up, across = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack((across.flatten(), up.flatten()), dim=-1)


def offsets(x: Tensor, places: Tensor, config: GardenConfig) -> Tensor:
    """Return the way from each place to each particle [length units], shape [B, K, N, 2]."""
    spread = x[:, None].expand(-1, places.shape[1], -1, -1)
    box = None if config.box is None else (config.box,) * 2
    return offsets_from(spread.flatten(0, 1), places.flatten(0, 1), box).view(spread.shape)


def holds(away: Tensor, config: GardenConfig) -> Tensor:
    """Return how much soft brushes hold of each particle, dimensionless, shape [B, K, N]."""
    origin = away.new_zeros(away.shape[0] * away.shape[1], 2)
    held = softness(away.flatten(0, 1), centre=origin, radius=config.brush_radius)
    return held.view(away.shape[:3])


def brushed(
    x: Tensor, s: Tensor, action: Tensor, middle: Tensor, config: GardenConfig
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return worlds after their brushes have been used; differentiable in all of them.

    All brushes are used at once: what a particle feels of them adds up.

    Returns:
        Positions, states, and each particle's rate, the share of its rule's steps that it makes,
        dimensionless, shape [B, N, 1]; None where no tool sets it.
    """
    columns, action = BrushLayout.of(config), action.clamp(-1.0, 1.0)
    places = action[..., columns.place]
    if config.actions == "grid":
        places = grid_places(config, x.device).to(x)
        # Several hands, each with a brush at every place.
        places = places.repeat(action.shape[1] // len(places), 1)
    held = holds(offsets(x, middle[:, None] + places, config), config)
    doses = held[..., None] * action[:, :, None]
    # Torch's own sums may change in the last bit with the number of worlds.
    felt = len(doses[0]) * world_mean(doses.flatten(2)).view(*x.shape[:2], columns.width)
    if "push" in config.tools:
        x = x + config.push_length * felt[..., columns.push]
    if "wipe" in config.tools:
        s = s * (1.0 - felt[..., columns.wipe].clamp(0.0, 1.0))
    if "inject" in config.tools:
        channels = [channel % config.state_dim for channel in config.inject_channels]
        index = torch.tensor(channels, device=s.device)
        s = s.index_add(2, index, config.state_scale * felt[..., columns.inject])
    rate = (1.0 + felt[..., columns.rate]).clamp(0.0, 2.0) if "rate" in config.tools else None
    return x, s, rate


def tool_table(config: GardenConfig) -> Tensor:
    """Return what a brush of the "discrete" form can do at full strength, shape [M, W - 2].

    Nothing; pushes in eight directions; wipe; inject each channel, up and down; stop, quicken.
    """
    columns = BrushLayout.of(config)
    rows = [torch.zeros(columns.width)]

    def add(column: slice, values: tuple[float, ...]) -> None:
        row = torch.zeros(columns.width)
        row[column] = torch.tensor(values)
        rows.append(row)

    if "push" in config.tools:
        for x, y in DIRECTIONS:
            length = (x * x + y * y) ** 0.5
            add(columns.push, (x / length, y / length))
    if "wipe" in config.tools:
        add(columns.wipe, (1.0,))
    if "inject" in config.tools:
        count = len(config.inject_channels)
        for channel in range(count):
            for sign in (1.0, -1.0):
                add(columns.inject, tuple(sign * (k == channel) for k in range(count)))
    if "rate" in config.tools:
        add(columns.rate, (-1.0,))
        add(columns.rate, (1.0,))
    return torch.stack(rows)[:, columns.place.stop :]
