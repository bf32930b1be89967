"""What an agent does to living worlds with its brushes: few numbers, each between -1 and 1."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.envs.garden.config import GardenConfig
from npa_envs.world.brushes import inject, push, softness

PLACE = slice(0, 2)
"""Columns of a brush that say where it is."""

DIRECTIONS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""Ways in which a brush of the "discrete" form pushes."""


class Columns(NamedTuple):
    """Where the numbers of each tool are in a brush's row; empty for tools that it lacks."""

    push: slice
    erase: slice
    inject: slice
    rate: slice
    width: int

    @classmethod
    def of(cls, config: GardenConfig) -> Columns:
        """Return the columns of a configuration's brushes."""
        widths = {"push": 2, "erase": 1, "inject": len(config.inject_channels), "rate": 1}
        first, found = PLACE.stop, {}
        for tool, width in widths.items():
            found[tool] = slice(first, first + (width if tool in config.tools else 0))
            first = found[tool].stop
        return cls(**found, width=first)


def brushed(
    x: Tensor, s: Tensor, action: Tensor, middle: Tensor, config: GardenConfig
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return worlds after their brushes have been used; differentiable in all of them.

    One brush comes after the other; each pushes, erases, then injects.

    Args:
        x: Positions [length units], shape [B, N, 2].
        s: States, dimensionless, shape [B, N, C].
        action: Rows of brushes, in [-1, 1], shape [B, K, W], as `Columns` says.
        middle: What places are counted from [length units], shape [B, 2].
        config: Says how large and how strong brushes are.

    Returns:
        Positions, states, and each particle's rate, the share of its rule's steps that it makes,
        dimensionless, shape [B, N, 1]; None where no tool sets it.
    """
    columns = Columns.of(config)
    box = None if config.box is None else (config.box,) * 2
    radius = config.brush_radius
    rate = torch.ones_like(x[..., :1]) if "rate" in config.tools else None
    channels = [channel % config.state_dim for channel in config.inject_channels]
    for row in action.clamp(-1.0, 1.0).unbind(dim=1):
        centre = middle + row[:, PLACE]
        if "push" in config.tools:
            move = config.push_length * row[:, columns.push]
            x = push(x, centre=centre, move=move, radius=radius, box=box)
        if "erase" in config.tools:
            strength = row[:, columns.erase].squeeze(1).clamp_min(0.0)
            blank = s.new_zeros(len(s), s.shape[2])
            s = inject(x, s, centre=centre, radius=radius, state=blank, strength=strength, box=box)
        if "inject" in config.tools or rate is not None:
            held = softness(x, centre=centre, radius=radius, box=box)
            if "inject" in config.tools:
                dose = config.state_scale * row[:, None, columns.inject] * held
                s = s.index_add(2, _index(channels, s), dose)
            if rate is not None:
                rate = rate + row[:, None, columns.rate] * held
    return x, s, None if rate is None else rate.clamp(0.0, 2.0)


def _index(channels: list[int], s: Tensor) -> Tensor:
    return torch.tensor(channels, device=s.device)


def tool_table(config: GardenConfig) -> Tensor:
    """Return what a brush of the "discrete" form can do at full strength, shape [M, W - 2].

    Nothing; pushes in eight directions; erase; inject each channel, up and down; stop, quicken.
    """
    columns = Columns.of(config)
    rows = [torch.zeros(columns.width)]

    def add(column: slice, values: tuple[float, ...]) -> None:
        row = torch.zeros(columns.width)
        row[column] = torch.tensor(values)
        rows.append(row)

    if "push" in config.tools:
        for x, y in DIRECTIONS:
            length = (x * x + y * y) ** 0.5
            add(columns.push, (x / length, y / length))
    if "erase" in config.tools:
        add(columns.erase, (1.0,))
    if "inject" in config.tools:
        count = len(config.inject_channels)
        for channel in range(count):
            for sign in (1.0, -1.0):
                add(columns.inject, tuple(sign * (k == channel) for k in range(count)))
    if "rate" in config.tools:
        add(columns.rate, (-1.0,))
        add(columns.rate, (1.0,))
    return torch.stack(rows)[:, PLACE.stop :]
