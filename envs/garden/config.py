"""Configuration of living worlds and brushes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from npa_envs.checks import check_positive, is_whole
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.grown import GrownConfig
from npa_envs.errors import NPAError, shown, suggest

Actions = Literal["grid", "free", "discrete"]
Observe = Literal["grid", "picture", "moments"]
GardenReward = Literal["dense", "sparse"]

TOOLS = ("push", "wipe", "inject", "rate")
"""What a brush can do."""


@dataclass(frozen=True, kw_only=True)
class GardenConfig(GrownConfig):
    """Adds brushes and what is observed of living worlds."""

    words = EnvConfig.words | {
        "reward": get_args(GardenReward),
        "actions": get_args(Actions),
        "observe": get_args(Observe),
    }

    reward: GardenReward = "dense"
    """"dense": how good the world is, in each step; "sparse": the same, in the last step alone."""

    target: str = "heart"
    particle_count: int = 512

    resolution: int = 32
    """Pixels on each side of the picture that the loss compares, R."""

    seed_pool: int = 16
    """Episodes start from one of so many grown worlds, made once; 0: from a new one each time,
    which takes `grow_steps` steps of the rule."""

    state_scale: float = 0.5
    """What an injection of 1 adds to a channel in the middle of a brush (dimensionless)."""

    rule_steps: int = 8
    """Steps of the rule in one step of the environment."""

    brush_radius: float = 0.6
    """Radius of a brush, which is soft: full strength in its middle, none at its edge
    [length units]."""

    tools: tuple[str, ...] = ("push",)
    """What brushes can do: some of "push", "wipe", "inject" and "rate", in this order."""

    push_length: float = 0.15
    """How far a push of 1 moves a particle in the middle of a brush [length units]."""

    inject_channels: tuple[int, ...] = (-3, -2, -1)
    """State channels that brushes inject; the last three are the colour."""

    actions: Actions = "grid"
    """Form of actions: "grid", a brush at each place of a grid; "free", brushes whose places are
    numbers too; or "discrete", a place of the grid, a tool and a strength for each brush, as
    Gymnasium's MultiDiscrete."""

    place_count: int = 4
    """Places on each side of the grid."""

    place_reach: float = 0.75
    """How far the outermost places of the grid are from its middle along x and y [length units]."""

    brush_count: int = 1
    """Brushes K where actions are "free" or "discrete"; all of them are used in each step."""

    strength_count: int = 3
    """Strengths from which to choose, where actions are "discrete"."""

    observe: Observe = "grid"
    """What is seen: "grid", what lacks at each place of the grid; "picture", a coarse one; or
    "moments", of positions and states."""

    picture_size: int = 16
    """Pixels on each side of the picture that is seen; it divides `resolution`."""

    observe_error: bool = False
    """The picture that is seen has, besides, what it lacks to the target's."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        check_positive(self, int, "rule_steps", "brush_count", "strength_count", "picture_size")
        check_positive(self, int, "place_count", at_least=2)
        check_positive(self, float, "brush_radius", "push_length", "place_reach")
        if self.resolution % self.picture_size:
            raise NPAError(
                f"picture_size must divide resolution = {self.resolution}, got "
                f"{self.picture_size}: try {self.resolution // 2}"
            )
        if self.tell_updated:
            raise NPAError("tell_updated must be False, as actions do not belong to particles")
        self._check_tools()
        if not isinstance(self.observe_error, bool):
            raise NPAError(f"observe_error must be True or False, got {shown(self.observe_error)}")

    def _check_tools(self) -> None:
        given = self.tools
        if not isinstance(given, tuple) or not given:
            raise NPAError(f"tools must be some of {TOOLS}, got {shown(given)}: try ('push',)")
        for tool in given:
            if tool not in TOOLS:
                raise NPAError(
                    f"tools must be some of {TOOLS}, got {shown(tool)}: {suggest(tool, TOOLS)}"
                )
        if given != tuple(tool for tool in TOOLS if tool in given):
            raise NPAError(
                f"tools must be in the order of {TOOLS}, each once, got {shown(given)}: sort them"
            )
        channels, count = self.inject_channels, self.state_dim
        whole = isinstance(channels, tuple) and bool(channels) and all(map(is_whole, channels))
        if not whole or len({channel % count for channel in channels}) < len(channels):
            raise NPAError(
                f"inject_channels must be different whole numbers, got {shown(channels)}: try (-1,)"
            )
        if not all(-count <= channel < count for channel in channels):
            raise NPAError(
                f"inject_channels must lie in [{-count}, {count - 1}], got {shown(channels)}: "
                f"there are {count} channels"
            )
