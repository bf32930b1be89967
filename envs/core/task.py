"""Tasks as environments see them: where worlds start, and how far they are from the goal."""

from __future__ import annotations

import copy
import random
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig, WorldConfig
from npa_envs.errors import NPAError, shown
from npa_envs.render import draw_worlds
from npa_envs.world.actions import marginal_gains
from npa_envs.world.cuda_graph import recording_lock
from npa_envs.world.randomness import StreamId, WorldRandom

AnyConfig = TypeVar("AnyConfig", bound=WorldConfig)
Config = TypeVar("Config", bound=EnvConfig)

SHARPNESS = 0.7
"""Standard deviation of a particle's spot in pictures, in distances between particles."""

TURN = 2.0
"""Degrees by which the camera turns around a 3D world in one step."""


class Start(NamedTuple):
    """Worlds at the beginning of their episodes."""

    x: Tensor
    """Positions [length units], shape [B, N, D]."""

    s: Tensor
    """States, dimensionless, shape [B, N, C]."""

    success_loss: Tensor | None = None
    """Loss at which each world's episode ends in success, shape [B]; None: never."""

    goal: Tensor | None = None
    """What each world is to come to, int64, shape [B], where worlds differ in that."""


class WorldTask(Generic[AnyConfig]):
    """What tasks of one species and of several have in common: constants and pictures.

    Args:
        config: The environment's configuration.
        device: Where the worlds live.
    """

    config_type: ClassVar[type[WorldConfig]] = WorldConfig
    """The configuration's class: its fields are the environment's keywords."""

    space_dim: ClassVar[int] = 2
    """Space dimension D."""

    static: ClassVar[bool] = False
    """Whether particles stay where they are; actions are then state steps alone."""

    worlds_type: ClassVar[Any] = None
    """How worlds are acted on, observed and judged; None: particles act and perceive."""

    form_type: ClassVar[Any] = None
    """The spaces of observations and actions; None: a row for each particle."""

    def __init__(self, config: AnyConfig, device: torch.device) -> None:
        self.config = config
        self.device = device

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures [length units]."""
        raise NotImplementedError

    @property
    def open_half_width(self) -> float:
        """From the middle of a picture to its edge in open space; 1 at least [length units]."""
        return 1.0

    @property
    def half_width(self) -> float:
        """From the middle of a picture to its edge [length units]."""
        box = self.config.box
        return max(1.0, self.open_half_width if box is None else 0.5 * box)

    def draw_particles(
        self, x: Tensor, s: Tensor, style: str, azimuth: float = 0.0
    ) -> NDArray[np.uint8]:
        """Return a picture of each world in one of `STYLES`, shape [B, R, R, 3].

        Positions are x [length units], [B, N, D], and states s, [B, N, C]. The camera of 3D worlds
        stands at an azimuth [degrees].
        """
        return draw_worlds(
            x,
            s,
            style=style,
            resolution=self.config.render_size,
            pixel_size=self.pixel_size,
            sigma=SHARPNESS,
            half_width=self.half_width,
            periodic=self.space_dim == 2 and (self.config.periodic_box or 0.0) >= 2.0,
            azimuth=azimuth,
        )


class EnvTask(WorldTask[Config]):
    """One task as environments see it; subclass it, and name the subclass in an `NPAEnv`.

    `seed` and `losses` are all that a task must have. None of the methods may wait for the device
    (no `.item()`, no branch on a tensor's value), and the result for one world must not depend on
    the others: take means over particles or pixels with `npa_envs.world_mean`. Everywhere x are
    positions [length units], shape [B, N, D], and s states, dimensionless, shape [B, N, C].

    Args:
        config: The environment's configuration.
        device: Where the worlds live.
    """

    config_type: ClassVar[type[EnvConfig]] = EnvConfig

    def __init__(self, config: Config, device: torch.device) -> None:
        super().__init__(config, device)
        self._pool: Start | None = None
        self.target_rows: Tensor | None = None
        """What rows of observations hold of each goal behind perception, [K, T]; None: nothing."""

    @classmethod
    def extra_bytes(cls, config: Any, world_count: int) -> int:
        """Return about how much memory the task needs besides the worlds [bytes]: their pool.

        Args:
            config: The environment's configuration.
            world_count: Worlds B.
        """
        numbers = config.particle_count * (cls.space_dim + config.state_dim)
        return int(4 * config.seed_pool * numbers)

    def seed(self, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return fresh worlds: positions [B, N, D] and states [B, N, C].

        Args:
            random: Where they come from, one stream a world; B is `random.world_count`.
        """
        raise NotImplementedError

    def fresh(self, random: WorldRandom) -> Start:
        """Return fresh worlds, with their goals where the task has such: by default `seed`'s.

        Args:
            random: As for `seed`.
        """
        return self._as_start("seed", self.seed(random))

    def _as_start(self, method: str, made: Any) -> Start:
        """Return what one of the task's methods made, positions and states first, as a `Start`."""
        if not isinstance(made, tuple | list) or not 2 <= len(made) <= len(Start._fields):
            raise NPAError(
                f"{type(self).__name__}.{method} must return positions and states, got a "
                f"{type(made).__name__}: return x, s"
            )
        return Start(*made)

    def toward(self, goal: Tensor) -> Self:
        """Return the task with losses for worlds of these goals; by default there are none.

        Args:
            goal: The worlds' goals, int64, shape [B]; read anew at each call of `losses`.
        """
        return self

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return the named parts of each world's loss, shape [B] each; their sum is the loss."""
        raise NotImplementedError

    def extra_info(self, s: Tensor) -> dict[str, Tensor]:
        """Return what infos tell of worlds besides, shape [B, ...] each; by default nothing."""
        return {}

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's share of its world's loss, shape [B, N]; their mean is the loss.

        Raises:
            NPAError: The task has none.
        """
        raise NPAError(
            f"{type(self).__name__} has no losses of single particles: choose reward='dense' or "
            "'sparse', or give it a particle_losses method"
        )

    def particle_gains(self, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> Tensor:
        """Return what each world would have lost without a particle's action, times N; [B, N].

        By default from the gradient of `losses`, as `marginal_gains` says; a task whose particles
        have losses of their own can be exact.

        Args:
            before: Positions and states before a step.
            after: The same after it.

        Raises:
            NPAError: The losses have no gradient.
        """
        box = self.config.periodic_box
        sides = None if box is None else (box,) * self.space_dim
        gains = marginal_gains(self.losses, before, after, sides)
        if gains is None:
            raise NPAError(
                f"the losses of {type(self).__name__} must be differentiable for "
                "reward='marginal', but no gradient leads from them to positions or states: choose "
                "'particle' or 'dense', or give it a particle_gains method"
            )
        return gains

    @property
    def start_is_short(self) -> bool:
        """Whether `start` takes few operations, so that restarts are recorded on CUDA."""
        return True

    def start(self, random: WorldRandom) -> Start:
        """Return worlds at the beginning of their episodes: fresh ones, or some from the pool.

        Args:
            random: Where they come from, one stream a world.
        """
        if self.config.seed_pool == 0:
            start = self._as_start("fresh", self.fresh(random))
        else:
            start = self.pooled(random.integers(self.config.seed_pool, 1)[:, 0])
        threshold, success = self.config.success_loss, None
        if threshold is not None:
            success = torch.full((len(start.x),), threshold, device=self.device)
        return start._replace(success_loss=success)

    @property
    def first_pool_seed(self) -> int:
        """Seed of the first world of the pool; each of the others has one more."""
        return 0

    def pooled(self, numbers: Tensor) -> Start:
        """Return worlds of the pool, which is made when first asked for.

        Args:
            numbers: Which ones, below `seed_pool`, int64, shape [B].
        """
        if self._pool is None:
            self._pool = self.made_for_pool(range(self.config.seed_pool))
        x, s, _, goal = self._pool
        return Start(x[numbers], s[numbers], goal=None if goal is None else goal[numbers])

    def made_for_pool(self, numbers: Sequence[int]) -> Start:
        """Make worlds of the pool, each from a seed of its own."""
        seeds = [self.first_pool_seed + number for number in numbers]
        # Not the streams that episodes with these seeds go on with.
        random = WorldRandom(seeds, device=self.device).substream(StreamId.GROWTH)
        return self._as_start("fresh", self.fresh(random))

    def draw(self, x: Tensor, s: Tensor, steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return a picture of each world, shape [B, R, R, 3], so many steps after its start, [B].

        A camera turns around 3D worlds.
        """
        style = self.config.render_style
        if self.space_dim == 2:
            return self.draw_particles(x, s, style)
        # Each is seen from an angle of its own.
        angles = TURN * steps.astype(float)
        seen = [
            self.draw_particles(x[k : k + 1], s[k : k + 1], style, a) for k, a in enumerate(angles)
        ]
        return np.concatenate(seen)

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: their distance where N fill the unit disk or ball."""
        volume = np.pi if self.space_dim == 2 else 4.0 * np.pi / 3.0
        return float((volume / self.config.particle_count) ** (1.0 / self.space_dim))


class TargetEnvTask(EnvTask[Config]):
    """A task that rules are trained on, too: `npa_envs.tasks` has its targets and losses."""

    task: Any
    """The task as training sees it."""

    def seed(self, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return worlds as training begins with them, all states zero."""
        x, s, *_ = self.task.seed(random.world_count, generator=random, device=self.device)
        return x, s

    def toward(self, goal: Tensor) -> Self:
        """Return the task with losses for worlds of these goals, where training has such too."""
        aimed = copy.copy(self)
        aimed.task = self.task.toward(goal)
        return aimed

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's share of the task's loss."""
        shares: Tensor = self.task.particle_shares(x, s)
        return shares


# What tasks return, checked: a mistake of an own task would be a wrong reward without a word.


def starter(task: EnvTask[Any]) -> str:
    """Return the name of the method that a task says with where worlds start."""
    own = (
        name for name in ("start", "fresh") if getattr(type(task), name) != getattr(EnvTask, name)
    )
    return next(own, "seed")


def check_start(task: EnvTask[Any], start: Start, world_count: int, shapes: Any) -> None:
    """Check the starts of some worlds, whose shapes are of more, without waiting for the device."""
    name = starter(task)
    if not isinstance(start, Start):
        raise NPAError(
            f"{type(task).__name__}.{name} must return a Start, got a {type(start).__name__}: "
            "return npa_envs.envs.Start(x, s)"
        )
    for part, value, shape in zip(("positions", "states"), start, shapes, strict=False):
        checked_tensor(task, name, part, value, (world_count, *shape[1:]))
    for part, value, dtype in (
        ("success_loss", start.success_loss, torch.float32),
        ("goal", start.goal, torch.int64),
    ):
        if value is not None:
            checked_tensor(task, name, part, value, (world_count,), dtype)


def checked_losses(
    task: EnvTask[Any], losses: Any, world_count: int, names: tuple[str, ...]
) -> list[Tensor]:
    """Return the parts of worlds' losses, shape [B] each, without waiting for the device."""
    name = f"{type(task).__name__}.losses"
    if not isinstance(losses, Mapping) or not losses or not all(type(n) is str for n in losses):
        came = list(losses) if isinstance(losses, Mapping) else type(losses).__name__
        raise NPAError(
            f"{name} must return the parts of each world's loss by name, at least one, got {came}: "
            "for example {'distance': distance}, of shape [B]"
        )
    if names and tuple(losses) != names:
        raise NPAError(
            f"{name} must return the same parts in the same order in each call, got "
            f"{list(losses)} after {list(names)}: return zeros for a part that does not count"
        )
    return [
        checked_tensor(task, "losses", f"part {shown(part)}", value, (world_count,))
        for part, value in losses.items()
    ]


def checked_tensor(
    task: EnvTask[Any],
    method: str,
    part: str,
    value: Any,
    shape: tuple[int, ...],
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Return what a method of a task returned, a tensor of this shape and type."""
    device = task.device
    if not isinstance(value, Tensor):
        came = f"a {type(value).__name__}"
    elif tuple(value.shape) != shape or value.dtype != dtype or value.device.type != device.type:
        came = f"{value.dtype} of shape {tuple(value.shape)} on {value.device}"
    else:
        return value
    raise NPAError(
        f"{part} of {type(task).__name__}.{method} must be a {dtype} tensor of shape {shape} on "
        f"{device}, got {came}: reshape or convert it there"
    )


def check_finite(task: EnvTask[Any], method: str, parts: Mapping[str, Tensor]) -> None:
    """Check that numbers of worlds are finite; waits for the device."""
    for part, value in parts.items():
        bad = ~torch.isfinite(value.flatten(1) if value.ndim > 1 else value[:, None]).all(dim=1)
        if bool(bad.any()):
            worlds = bad.nonzero()[:, 0].tolist()
            raise NPAError(
                f"{part} of {type(task).__name__}.{method} must be finite, got NaN or infinite "
                f"numbers in {len(worlds)} of {len(bad)} worlds, first in world {worlds[0]}: "
                "divide and take roots of positive numbers only"
            )


class GlobalDraws:
    """The states of the global generators of random numbers: a task must not draw from them."""

    def __init__(self, task: EnvTask[Any]) -> None:
        self._task = task
        self._before = self._states()

    def check(self, method: str) -> None:
        """Check that none of them has moved since, by the method of the task."""
        now = self._states()
        moved = [name for name, state in self._before.items() if state != now[name]]
        if moved:
            raise NPAError(
                f"{type(self._task).__name__}.{method} must not draw from global generators, which "
                f"reset(seed=...) does not seed, got draws from {' and '.join(moved)}: draw from "
                "the WorldRandom that seed is given, for example random.uniform(...)"
            )

    def _states(self) -> dict[str, Any]:
        _, key, *rest = np.random.get_state()
        states: dict[str, Any] = {
            "torch's": torch.get_rng_state().numpy().tobytes(),
            "NumPy's": (np.asarray(key).tobytes(), *rest),
            "Python's": random.getstate(),
        }
        if self._task.device.type == "cuda":
            # A capture of another thread puts another generator in its place for a moment.
            with recording_lock:
                state = torch.cuda.get_rng_state(self._task.device)
            states["torch's on CUDA"] = state.numpy().tobytes()
        return states
