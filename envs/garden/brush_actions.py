"""Actions by brushes in gardens: configuration, columns, effects on particles, and spaces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from gymnasium.spaces import Box, MultiDiscrete, Space
from torch import Tensor

from npa_envs.checks import check_field, check_flag, check_positive, is_whole
from npa_envs.envs.core.base import ParticleSpaces, batch_tensor
from npa_envs.envs.core.config import check_picture_size
from npa_envs.envs.trained_rules import OF_PARTICLES, GrownConfig
from npa_envs.errors import NPAError, shown
from npa_envs.world.brushes import sums_under_brushes
from npa_envs.world.environment_steps import Physics
from npa_envs.world.particles import Particles

OBSERVATION_LIMIT = 8.0
"""Observations are clipped to plus and minus this (dimensionless, or length units)."""

VALUES_PER_PLACE = 6
"""Number of values observed at a place of the grid: count, x, y, red, green, blue."""

BrushActions = Literal["grid", "free", "discrete"]
ActionShape = Literal["flat", "brushes"]
Observe = Literal["grid", "picture", "moments"]
GARDEN_REWARDS = "dense", "sparse"

BRUSH_TOOLS = ("push", "wipe", "inject", "rate")
"""Effects that a brush of an agent can have."""


@dataclass(frozen=True, kw_only=True)
class GardenConfig(GrownConfig):
    """`GrownConfig` with the brushes of agents and what is observed."""

    fixed = GrownConfig.fixed | OF_PARTICLES
    choices = GrownConfig.choices | {
        "reward": GARDEN_REWARDS,
        "actions": get_args(BrushActions),
        "action_shape": get_args(ActionShape),
        "observe": get_args(Observe),
    }

    reward: str = "dense"
    """"dense": the world's score in each step; "sparse": its score in the last step only."""

    target: str = "heart"
    particle_count: int = 512
    resolution: int = 32
    seed_pool: int = 16

    state_scale: float = 0.5
    """Change of a channel by an injection of 1 at the centre of a brush (dimensionless)."""

    rule_steps: int = 8
    """Steps of the rule in one step of the environment."""

    brush_radius: float = 0.6
    """Radius of a brush: full strength at its centre, falling to 0 at its edge [length units]."""

    tools: tuple[str, ...] = ("push",)
    """Effects of the brushes: some of "push", "wipe", "inject" and "rate", in this order."""

    push_length: float = 0.15
    """Displacement by a push of 1 at the centre of a brush [length units]."""

    inject_channels: tuple[int, ...] = (-3, -2, -1)
    """State channels that brushes inject; the last three are the colour."""

    actions: BrushActions = "grid"
    """Form of actions: "grid", a brush at each place of a grid; "free", brushes whose positions are
    part of the action; or "discrete", a place of the grid, a tool and a strength for each brush, as
    Gymnasium's MultiDiscrete."""

    action_shape: ActionShape = "flat"
    """Shape of actions that are no choices: "flat", the rows of all brushes one after another, or
    "brushes", a row for each; `step` takes both."""

    place_count: int = 4
    """Places on each side of the grid."""

    place_reach: float = 0.75
    """Half of the grid's extent along x and y [length units]."""

    brush_count: int = 1
    """Brushes J where actions are "free" or "discrete"; all of them are used in each step."""

    strength_count: int = 3
    """Number of strengths, where actions are "discrete"."""

    observe: Observe = "grid"
    """Form of observations: "grid", the deficit to the target at each place of the grid; "picture",
    a coarse one; or "moments", of positions and states."""

    picture_size: int = 16
    """Pixels on each side of the observed picture; a divisor of `resolution`."""

    observe_error: bool = False
    """Whether the observed picture also has the target's picture minus its own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, int, "rule_steps", "brush_count", "strength_count", "picture_size")
        check_positive(self, int, "place_count", at_least=2)
        check_positive(self, float, "brush_radius", "push_length", "place_reach")
        check_picture_size(self)
        check_flag(self, "observe_error")
        tools, channels, count = self.tools, self.inject_channels, self.state_dim
        known = isinstance(tools, tuple) and tools == tuple(t for t in BRUSH_TOOLS if t in tools)
        rule = f"be some of {BRUSH_TOOLS}, in this order"
        check_field(self, "tools", known and bool(tools), rule, "try ('push',)")
        whole = isinstance(channels, tuple) and bool(channels) and all(map(is_whole, channels))
        differ = whole and len({channel % count for channel in channels}) == len(channels)
        check_field(self, "inject_channels", differ, "be different whole numbers", "try (-1,)")
        exist = all(-count <= channel < count for channel in channels)
        rule, hint = f"lie in [{-count}, {count - 1}]", f"there are {count} channels"
        check_field(self, "inject_channels", exist, rule, hint)

    @cached_property
    def brush_layout(self) -> BrushLayout:
        """Columns of actions."""
        return BrushLayout.for_config(self)


PUSH_DIRECTIONS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""Directions of pushes of the "discrete" form."""


class BrushLayout(NamedTuple):
    """Columns of the place and of each tool in a brush's row of an action; empty if not used."""

    place: slice
    push: slice
    wipe: slice
    inject: slice
    rate: slice
    width: int

    @classmethod
    def for_config(cls, config: GardenConfig) -> BrushLayout:
        """Return the columns for a configuration; brushes of the grid have no columns of places."""
        widths = {"place": 0 if config.actions == "grid" else 2}
        widths |= {"push": 2, "wipe": 1, "inject": len(config.inject_channels), "rate": 1}
        first, columns = 0, {}
        for name, width in widths.items():
            columns[name] = slice(first, first + (width * (name in ("place", *config.tools))))
            first = columns[name].stop
        return cls(**columns, width=first)


def grid_places(config: GardenConfig, device: torch.device | None = None) -> Tensor:
    """Return the places of the grid [length units], row by row from the bottom up, [P², 2]."""
    fraction = torch.arange(config.place_count, device=device) / (config.place_count - 1)
    steps = config.place_reach * (2.0 * fraction - 1.0)
    up, across = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack((across.flatten(), up.flatten()), dim=-1)


def brush_options(config: GardenConfig) -> dict[str, Any]:
    """Return radius and box of brushes, as `sums_under_brushes` takes them."""
    box = None if config.periodic_box is None else (config.periodic_box, config.periodic_box)
    return {"radius": config.brush_radius, "box": box}


def apply_brushes(
    particles: Particles,
    action: Tensor,
    middle: Tensor,
    config: GardenConfig,
    grid: Tensor | None = None,
) -> tuple[Particles, Tensor | None]:
    """Return particles after all brushes at once, whose effects add up, and rates; differentiable.

    A rate multiplies a particle's change in each step of the rule, dimensionless, [B, N, 1]; None
    without the tool "rate". `action` has a row for each brush, [B, J, W]; `middle`, [B, 2], is the
    origin of places; `grid`, the result of `grid_places`, saves making it again.
    """
    x, s, *_ = particles
    columns, action = config.brush_layout, action.clamp(-1.0, 1.0)
    places = action[..., columns.place]
    if config.actions == "grid":
        grid = grid_places(config, x.device).to(x) if grid is None else grid
        # Several agents may each have a brush at every place.
        places = grid.repeat(action.shape[1] // len(grid), 1)
    # What all brushes do to a particle is a sum over the brushes near it.
    total = sums_under_brushes(x, middle[:, None] + places, action, **brush_options(config))
    if "push" in config.tools:
        x = x + config.push_length * total[..., columns.push]
    if "wipe" in config.tools:
        s = s * (1.0 - total[..., columns.wipe].clamp(0.0, 1.0))
    if "inject" in config.tools:
        s, amounts = s.clone(), config.state_scale * total[..., columns.inject]
        # One by one: a tensor of the channels would be copied to the device.
        for channel, amount in zip(config.inject_channels, amounts.unbind(dim=-1), strict=True):
            s[..., channel] += amount
    rate = (1.0 + total[..., columns.rate]).clamp(0.0, 2.0) if "rate" in config.tools else None
    return particles._replace(x=x, s=s), rate


def tool_table(config: GardenConfig) -> Tensor:
    """Return the tool columns of each choice of a "discrete" brush, at full strength, [choices, W].

    Choices: nothing; pushes in eight directions; wipe; each channel up, down; rates 0 and 2.
    """
    columns, choices = BrushLayout.for_config(config), list[tuple[slice, Tensor]]()
    if "push" in config.tools:
        directions = torch.tensor(PUSH_DIRECTIONS).float()
        lengths = directions.square().sum(dim=1, keepdim=True).sqrt()
        choices += [(columns.push, direction) for direction in directions / lengths]
    if "wipe" in config.tools:
        choices.append((columns.wipe, torch.ones(1)))
    if "inject" in config.tools:
        for channel in torch.eye(len(config.inject_channels)):
            choices += [(columns.inject, channel), (columns.inject, -channel)]
    if "rate" in config.tools:
        choices += [(columns.rate, -torch.ones(1)), (columns.rate, torch.ones(1))]
    table = torch.zeros(1 + len(choices), columns.width)
    for row, (column, values) in zip(table[1:], choices, strict=True):
        row[column] = values
    return table[:, columns.place.stop :]


class BrushSpaces(ParticleSpaces):
    """Spaces with one observation of a whole world and with actions of brushes."""

    def __init__(self, physics: Physics, config: GardenConfig) -> None:
        self._config, self._output = config, config.output
        counts = {
            "grid": VALUES_PER_PLACE * config.place_count**2,
            "picture": (8 if config.observe_error else 4) * config.picture_size**2,
            "moments": 5 + 3 * config.state_dim,
        }
        limit, shape = OBSERVATION_LIMIT, (counts[config.observe],)
        self.observation_space: Space[Any] = Box(-limit, limit, shape, np.float32)
        count = config.place_count**2 if config.actions == "grid" else config.brush_count
        self.rows_shape = (count, BrushLayout.for_config(config).width)
        """Shape (J, W) of a world's rows of brushes."""
        self._tools = tool_table(config)
        self._choices = [config.place_count] * 2 + [len(self._tools), config.strength_count]
        flat = (count * self.rows_shape[1],)
        self.action_shape = flat if config.action_shape == "flat" else self.rows_shape
        """Shape of a world's actions, unless they are choices: (J W,), or (J, W)."""
        self.action_space: Space[Any] = Box(-1.0, 1.0, self.action_shape, np.float32)
        if config.actions == "discrete":
            self.action_space = MultiDiscrete(self._choices * config.brush_count)

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return checked actions float32, [B, J, W]: W columns for each of J brushes.

        Actions that are no choices may have either form of `action_shape`.
        """
        if self._config.actions != "discrete":
            return self._rows(action, world_count)
        brushes = self._config.brush_count
        chosen = batch_tensor(action, world_count, (4 * brushes,), "4 J", discrete=True)
        chosen = chosen.view(-1, brushes, 4)
        highest = torch.tensor(self._choices, device=chosen.device)
        if not bool(((chosen >= 0) & (chosen < highest)).all()):
            raise NPAError(
                f"action must choose below {self._choices} for each brush (place across and up, "
                f"tool, strength), got numbers up to {shown(int(chosen.abs().max()))}"
            )
        config, tools = self._config, self._tools.to(chosen.device)
        across, up = chosen[..., 0], chosen[..., 1]
        places = grid_places(config, chosen.device)[up * config.place_count + across]
        strength = (chosen[..., 3:] + 1.0) / config.strength_count
        return torch.cat((places, strength * tools[chosen[..., 2]]), dim=-1)

    def _rows(self, action: Any, world_count: int | None) -> Tensor:
        """Return checked rows of brushes, [B, J, W], from actions [J W] or [J, W] of each world."""
        flat = (self.rows_shape[0] * self.rows_shape[1],)
        forms = {1: (flat, "J W"), 2: (self.rows_shape, "J, W")}
        dimensions = getattr(action, "ndim", 0) - (world_count is not None)
        shape, letters = forms.get(dimensions, forms[len(self.action_shape)])
        return batch_tensor(action, world_count, shape, letters).reshape(-1, *self.rows_shape)
