"""Base classes of tasks: start worlds and losses of environments, with checks of both."""

from __future__ import annotations

import contextlib
import copy
import random
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, NamedTuple, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import checked_tensor
from npa_envs.envs.core.config import EnvConfig, WorldConfig
from npa_envs.envs.core.step_report import REWARDS
from npa_envs.errors import NPAError, shown
from npa_envs.render import draw_worlds
from npa_envs.world.cuda_graph import capture_lock
from npa_envs.world.environment_steps import wrapped
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import StreamId, WorldRandom

if TYPE_CHECKING:
    from npa_envs.envs.core.base import ParticleSpaces
    from npa_envs.envs.core.worlds import BatchedWorlds

AnyConfig = TypeVar("AnyConfig", bound=WorldConfig)
Config = TypeVar("Config", bound=EnvConfig)

Controls = Literal["particles", "species", "brushes", "codes", "central"]
"""What the actions of an environment control."""

PICTURE_SIGMA = 0.7
"""Standard deviation of a particle's Gaussian in pictures, as a multiple of `pixel_size`."""

CAMERA_TURN = 2.0
"""Angle by which the camera turns around a 3D world in one step [degrees]."""


class Start(NamedTuple):
    """B worlds at the beginning of their episodes."""

    x: Tensor
    """Positions [length units], shape [B, N, D]."""
    s: Tensor
    """States, dimensionless, shape [B, N, C]."""
    success_loss: Tensor | None = None
    """Loss at which each world's episode ends in success, shape [B]; None: never."""
    goal: Tensor | None = None
    """Index of each world's goal, such as its target picture, int64, shape [B]; None: one goal."""


class WorldTask(Generic[AnyConfig]):
    """Base class of all tasks: what all worlds of a task have in common, and pictures of them."""

    config_type: ClassVar[type[WorldConfig]] = WorldConfig
    """The configuration's class: its fields are the environment's keywords."""

    controls: ClassVar[Controls] = "particles"
    """What actions control."""

    space_dim: ClassVar[int] = 2
    """Space dimension D."""

    static: ClassVar[bool] = False
    """Whether particles never move; actions then only change states."""

    def __init__(self, config: AnyConfig, device: torch.device) -> None:
        self.config, self.device = config, device

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures [length units]."""
        raise NotImplementedError

    @property
    def open_half_width(self) -> float:
        """Half of a picture's side in open space [length units], raised to 1 if it is less."""
        return 1.0

    @property
    def half_width(self) -> float:
        """Half of a picture's side [length units]."""
        box = self.config.box
        return max(1.0, self.open_half_width if box is None else 0.5 * box)

    def draw_particles(
        self, particles: Particles, style: str, azimuth: float = 0.0
    ) -> NDArray[np.uint8]:
        """Return pictures, uint8, [B, R, R, 3]; `azimuth`: angle of 3D cameras [degrees]."""
        return draw_worlds(
            particles.x,
            particles.s,
            style=style,
            resolution=self.config.render_size,
            pixel_size=self.pixel_size,
            sigma=PICTURE_SIGMA,
            half_width=self.half_width,
            periodic=self.space_dim == 2 and (self.config.periodic_box or 0.0) >= 2.0,
            azimuth=azimuth,
        )


class EnvTask(WorldTask[Config]):
    """The task of an environment; subclass it, and set `task_type` of an `NPAEnv` to the subclass.

    A task must define `losses`, and `seed` or `fresh`. `seed` returns positions and states of new
    worlds. `fresh` returns new worlds with goals; by default it calls `seed`. `start` returns the
    worlds of episodes: new ones of `fresh`, or some of a pool that `fresh` has filled; a task can
    change these, for example damage them.

    No method may synchronise with the device (no `.item()`, no branch on a tensor's value), and the
    result for one world must not depend on the others: take means over particles or pixels with
    `npa_envs.world_mean`. In all methods x are positions [length units], shape [B, N, D], and s
    states, dimensionless, shape [B, N, C]. `random` has a stream of random numbers for each world.
    """

    config_type: ClassVar[type[EnvConfig]] = EnvConfig

    worlds_type: ClassVar[type[BatchedWorlds] | None] = None
    """Class that steps and observes the worlds; None: `ParticleWorlds`, where particles act and
    perceive. Tasks whose particles a rule moves take `RuleDrivenWorlds`."""

    spaces_type: ClassVar[type[ParticleSpaces] | None] = None
    """Class of the spaces; None: `ParticleSpaces`, a row for each particle."""

    place_middle: ClassVar[float] = 0.0
    """Both coordinates of the middle of the square of central control [length units]."""

    grows: bool = False
    """Whether a rule grows each new world, in many steps."""

    def __init__(self, config: Config, device: torch.device) -> None:
        super().__init__(config, device)
        self._pool: Particles | None = None
        self._pooled: set[int] = set()
        self.target_rows: Tensor | None = None
        """Last columns of observations by goal, [goals, T]; None: they end with perception."""

    @classmethod
    def extra_bytes(cls, config: Any, world_count: int) -> int:
        """Return about how much memory the pool and the losses of B worlds take [bytes]."""
        numbers = config.particle_count * (cls.space_dim + config.state_dim)
        return int(4 * config.seed_pool * numbers) + world_count * cls.bytes_per_world(config)

    @classmethod
    def bytes_per_world(cls, config: Any) -> int:
        """Return about how much memory the loss of one world takes [bytes]; by default 0."""
        return 0

    def seed(self, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return positions and states of B new worlds; B is `random.world_count`."""
        raise NotImplementedError

    def fresh(self, random: WorldRandom) -> Start:
        """Return new worlds, with goals if the task has several; by default those of `seed`."""
        return self._as_start("seed", self.seed(random))

    def _as_start(self, method: str, result: Any) -> Start:
        """Return as a `Start` the tuple `result`, which the task's `method` returned."""
        if not isinstance(result, tuple | list) or not 2 <= len(result) <= len(Start._fields):
            raise NPAError(
                f"{type(self).__name__}.{method} must return positions and states, got a "
                f"{type(result).__name__}: return x, s"
            )
        return Start(*result)

    def with_goal(self, goal: Tensor) -> Self:
        """Return the task with losses for worlds of these goals; by default the task itself.

        Goals are int64, shape [B]; each call of `losses` reads their values.
        """
        return self

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return the terms of each world's loss by name, shape [B] each; their sum is the loss."""
        raise NotImplementedError

    def extra_info(self, s: Tensor) -> dict[str, Tensor]:
        """Return values that the task adds to infos, by name, [B, ...] each; by default none."""
        return {}

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return a loss for each particle, shape [B, N], whose mean is the world's loss."""
        raise NPAError(
            f"{type(self).__name__} has no losses of single particles: choose reward='dense' or "
            "'sparse', or give it a particle_losses method"
        )

    def particle_gains(self, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> Tensor:
        """Return N times what each particle's action contributed to the loss's decrease, [B, N].

        `before` and `after` are positions and states around a step. By default the contribution is
        minus the particle's change times the gradient of `losses` in the middle of the step. It is
        the particle's Shapley value: exactly for losses that are quadratic in the changes, and up
        to third order for others. Detached parts of the loss do not count.
        """
        box = self.periodic_sides
        moved, changed = wrapped(after[0] - before[0], box), after[1] - before[1]
        with torch.enable_grad():
            x = wrapped(after[0] - 0.5 * moved, box).requires_grad_()
            s = (after[1] - 0.5 * changed).requires_grad_()
            loss = torch.stack(list(self.losses(x, s).values())).sum()
            if not loss.requires_grad:
                raise NPAError(
                    f"the losses of {type(self).__name__} must be differentiable for "
                    "reward='marginal', but no gradient leads from them to positions or states: "
                    "choose 'particle' or 'dense', or give it a particle_gains method"
                )
            slopes = torch.autograd.grad(loss, (x, s), allow_unused=True)
        gains = torch.zeros_like(moved[..., 0])
        for slope, change in zip(slopes, (moved, changed), strict=True):
            if slope is not None:
                # Added one by one, because torch's sums have no fixed order.
                for column in (slope * change).unbind(dim=-1):
                    gains = gains - column
        return gains * gains.shape[1]

    @property
    def periodic_sides(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units]; None: open space, or walls."""
        box = self.config.periodic_box
        return None if box is None else (box,) * self.space_dim

    @property
    def start_is_short(self) -> bool:
        """Whether `start` takes few operations, so that on CUDA it is captured as a graph."""
        return not self.grows or self.config.seed_pool > 0

    @property
    def rewards_last_step_only(self) -> bool:
        """Whether only the last step of an episode is rewarded."""
        return REWARDS[self.config.reward].last_step_only

    def start(self, random: WorldRandom) -> Start:
        """Return the worlds of B episodes: new ones of `fresh`, or random ones of the pool."""
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
        """Seed of world 0 of the pool; world k has this seed plus k."""
        return 0

    def pooled(self, indices: Tensor) -> Start:
        """Return the worlds of the pool with these indices, int64 [B]; make them if needed."""
        if self.device.type == "cpu":
            missing = sorted(set(indices.tolist()) - self._pooled)
        else:
            # Reading the indices would synchronise, so the first call makes all worlds.
            missing = list(range(self.config.seed_pool)) if self._pool is None else []
        if missing:
            seeds = [self.first_pool_seed + index for index in missing]
            # Other streams than those of episodes with these seeds.
            random = WorldRandom(seeds, device=self.device).substream(StreamId.GROWTH)
            start = self._as_start("fresh", self.fresh(random))
            made, size = Particles(start.x, start.s, goal=start.goal), self.config.seed_pool
            if self._pool is None:
                self._pool = made.map(lambda value: value.new_empty(size, *value.shape[1:]))
            self._pool.put_(torch.tensor(missing, device=self.device), made)
            self._pooled.update(missing)
        assert self._pool is not None, "the first call makes worlds"
        taken = self._pool.take(indices)
        return Start(taken.x, taken.s, goal=taken.goal)

    def draw(self, particles: Particles, steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return pictures, uint8, [B, R, R, 3]; `steps` since each start, [B], turn 3D cameras."""
        style = self.config.render_style
        if self.space_dim == 2:
            return self.draw_particles(particles, style)
        indices = torch.split(torch.arange(len(steps), device=self.device), 1)
        pictures = [
            self.draw_particles(particles.take(world), style, CAMERA_TURN * float(step))
            for world, step in zip(indices, steps, strict=True)
        ]
        return np.concatenate(pictures)

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: the spacing of N particles in the unit disk or ball."""
        volume = np.pi if self.space_dim == 2 else 4.0 * np.pi / 3.0
        return float((volume / self.config.particle_count) ** (1.0 / self.space_dim))


class TargetEnvTask(EnvTask[Config]):
    """A task with the targets and losses of a training task of `npa_envs.tasks`."""

    task: Any
    """The training task."""

    training_task: ClassVar[type[Any]]
    """Class of the training task."""

    pixel_bytes: ClassVar[int] = 0
    """About how much memory comparing one pixel of a world's picture takes [bytes]."""

    def __init__(self, config: Config, device: torch.device) -> None:
        super().__init__(config, device)
        self.task = self._make_task()

    def _make_task(self) -> Any:
        return self.training_task(self.config.task_config, device=self.device)

    @classmethod
    def bytes_per_world(cls, config: Any) -> int:
        """Return about how much memory the loss of one world takes [bytes]."""
        copies = 4 if config.per_particle_reward else 1
        return copies * cls.pixel_bytes * int(getattr(config, "resolution", 0)) ** 2

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures [length units], from the training task."""
        return float(self.task.pixel_size)

    def fresh(self, random: WorldRandom) -> Start:
        """Return the training task's initial worlds, with their goals if it has several."""
        worlds = self.task.seed(random.world_count, generator=random, device=self.device)
        # Leaves out the channels of codes, which only rules of many pictures use.
        s = worlds.s[..., -self.config.state_dim :].contiguous()
        return Start(worlds.x, s, goal=worlds.goal)

    def with_goal(self, goal: Tensor) -> Self:
        """Return a copy whose losses compare world b with target `goal[b]`, an index, int64 [B]."""
        goal_task = copy.copy(self)
        goal_task.task = self.task.with_goal(goal)
        return goal_task

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the training task's loss of each particle, shape [B, N]."""
        losses: Tensor = self.task.particle_contributions(x, s)
        return losses


# Checks of what tasks return: a mistake in a custom task would silently give wrong rewards.


def start_method(task: EnvTask[Any]) -> str:
    """Return which method the task's class overrides to make worlds: start, fresh or seed."""
    names = ("start", "fresh")
    return next((n for n in names if getattr(type(task), n) != getattr(EnvTask, n)), "seed")


def check_start(task: EnvTask[Any], start: Start, world_count: int, shapes: Any) -> None:
    """Check shapes and types of some start worlds, without synchronising; `shapes`: of all."""
    name = start_method(task)
    if not isinstance(start, Start):
        raise NPAError(
            f"{type(task).__name__}.{name} must return a Start, got a {type(start).__name__}: "
            "return npa_envs.envs.Start(x, s)"
        )
    for field, value, shape in zip(("positions", "states"), start, shapes, strict=False):
        checked_tensor(task, name, field, value, (world_count, *shape[1:]))
    for field, value, dtype in (
        ("success_loss", start.success_loss, torch.float32),
        ("goal", start.goal, torch.int64),
    ):
        if value is not None:
            checked_tensor(task, name, field, value, (world_count,), dtype)


def checked_losses(
    task: EnvTask[Any], losses: Any, world_count: int, names: tuple[str, ...]
) -> list[Tensor]:
    """Return the terms of `losses`, [B] each, after a check; `names`: terms of earlier calls."""
    name = f"{type(task).__name__}.losses"
    if not isinstance(losses, Mapping) or not losses or not all(type(n) is str for n in losses):
        actual = list(losses) if isinstance(losses, Mapping) else type(losses).__name__
        raise NPAError(
            f"{name} must return the terms of each world's loss by name, at least one, got "
            f"{actual}: for example {{'distance': distance}}, of shape [B]"
        )
    if names and tuple(losses) != names:
        raise NPAError(
            f"{name} must return the same terms in the same order in each call, got "
            f"{list(losses)} after {list(names)}: return zeros for a term that does not count"
        )
    return [
        checked_tensor(task, "losses", f"term {shown(term)}", value, (world_count,))
        for term, value in losses.items()
    ]


def check_finite(task: EnvTask[Any], method: str, values: Mapping[str, Tensor]) -> None:
    """Check that tensors, [B, ...], by their names in the error, are finite; synchronises."""
    for field, value in values.items():
        bad = ~torch.isfinite(value.flatten(1) if value.ndim > 1 else value[:, None]).all(dim=1)
        if bool(bad.any()):
            worlds = bad.nonzero()[:, 0].tolist()
            raise NPAError(
                f"{field} of {type(task).__name__}.{method} must be finite, got NaN or infinite "
                f"numbers in {len(worlds)} of {len(bad)} worlds, first in world {worlds[0]}: "
                "divide and take roots of positive numbers only"
            )


def global_rng_states(device: torch.device) -> dict[str, Any]:
    """Return the states of the global random generators, from which a task must not draw."""
    _, key, *rest = np.random.get_state()
    states: dict[str, Any] = {
        "torch's": torch.get_rng_state().numpy().tobytes(),
        "NumPy's": (np.asarray(key).tobytes(), *rest),
        "Python's": random.getstate(),
    }
    if device.type == "cuda":
        # A capture in another thread replaces this generator for a moment.
        with capture_lock:
            states["torch's on CUDA"] = torch.cuda.get_rng_state(device).numpy().tobytes()
    return states


@contextlib.contextmanager
def no_global_draws(task: EnvTask[Any], method: str) -> Iterator[None]:
    """Check that `method`, called in the `with` block, draws from no global generator.

    Tasks of this library are not checked: draws of other threads look like theirs.
    """
    if type(task).__module__.startswith("npa_envs."):
        yield
        return
    before = global_rng_states(task.device)
    yield
    now = global_rng_states(task.device)
    moved = [name for name, state in before.items() if state != now[name]]
    if moved:
        raise NPAError(
            f"{type(task).__name__}.{method} must not draw from global generators, which "
            f"reset(seed=...) does not seed, got draws from {' and '.join(moved)}: draw from "
            "the WorldRandom that seed is given, for example random.uniform(...)"
        )
