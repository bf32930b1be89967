"""What an environment asks of its task: where worlds start, and how far they are from the goal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Generic, NamedTuple, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.errors import NPAError
from npa_envs.render import draw_worlds
from npa_envs.world.randomness import Purpose, WorldRandom

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


class EnvTask(Generic[Config]):
    """One task as environments see it; subclass it, and name the subclass in an `NPAEnv`.

    `seed` and `losses` are all that a task must have. None of the methods may wait for the device
    (no `.item()`, no branch on a tensor's value), and the result for one world must not depend on
    the others: take means over particles or pixels with `npa_envs.world_mean`.

    Args:
        config: The environment's configuration.
        device: Where the worlds live.
    """

    config_type: ClassVar[type[EnvConfig]] = EnvConfig
    """The configuration's class: its fields are the keywords of `gym.make`."""

    space_dim: ClassVar[int] = 2
    """Space dimension D."""

    static: ClassVar[bool] = False
    """Whether particles stay where they are; actions are then state steps alone."""

    def __init__(self, config: Config, device: torch.device) -> None:
        self.config = config
        self.device = device
        self._pool: Start | None = None

    @classmethod
    def extra_bytes(cls, config: EnvConfig, world_count: int) -> int:
        """Return about how much memory the task needs besides the worlds [bytes]: their pool.

        Args:
            config: The environment's configuration.
            world_count: Worlds B.
        """
        return 4 * config.seed_pool * config.particle_count * (cls.space_dim + config.state_dim)

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
        return Start(*self.seed(random))

    def toward(self, goal: Tensor) -> Self:
        """Return the task with losses for worlds of these goals; by default there are none.

        Args:
            goal: The worlds' goals, int64, shape [B]; read anew at each call of `losses`.
        """
        return self

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return the named parts of each world's loss, shape [B] each; their sum is the loss.

        Args:
            x: Positions [length units], shape [B, N, D].
            s: States, dimensionless, shape [B, N, C].
        """
        raise NotImplementedError

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's share of its world's loss, shape [B, N]; their mean is the loss.

        Args:
            x: Positions [length units], shape [B, N, D].
            s: States, dimensionless, shape [B, N, C].

        Raises:
            NPAError: The task has none.
        """
        raise NPAError(
            f"{type(self).__name__} has no losses of single particles: choose reward='dense' or "
            "'sparse', or give it a particle_losses method"
        )

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
            start = self.fresh(random)
        else:
            pool = self.pool()
            chosen = random.integers(self.config.seed_pool, 1)[:, 0]
            goal = None if pool.goal is None else pool.goal[chosen]
            start = Start(pool.x[chosen], pool.s[chosen], goal=goal)
        return start._replace(success_loss=self._constant_success(len(start.x)))

    def pool(self) -> Start:
        """Return the worlds that episodes start from, made when first asked for."""
        if self._pool is None:
            # Not the streams that episodes with these seeds go on with.
            random = WorldRandom(range(self.config.seed_pool), device=self.device)
            self._pool = self.fresh(random.beside(Purpose.GROWTH))
        return self._pool

    def draw(self, x: Tensor, s: Tensor, steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return a picture of each world, shape [B, R, R, 3]; a camera turns around 3D worlds.

        Args:
            x: Positions [length units], shape [B, N, D].
            s: States, dimensionless, shape [B, N, C].
            steps: Steps since each episode's start, shape [B].
        """
        # All 2D worlds at once; in 3D each is seen from an angle of its own.
        batches = [slice(None)] if self.space_dim == 2 else [slice(k, k + 1) for k in range(len(x))]
        pictures = [
            draw_worlds(
                x[batch],
                s[batch],
                style=self.config.render_style,
                resolution=self.config.render_size,
                pixel_size=self.pixel_size,
                sigma=SHARPNESS,
                half_width=max(1.0, 0.5 * (self.config.box or 0.0)),
                periodic=self.space_dim == 2 and (self.config.box or 0.0) >= 2.0,
                azimuth=TURN * float(steps[batch][0]),
            )
            for batch in batches
        ]
        return np.concatenate(pictures)

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: their distance where N fill the unit disk or ball."""
        volume = np.pi if self.space_dim == 2 else 4.0 * np.pi / 3.0
        return float((volume / self.config.particle_count) ** (1.0 / self.space_dim))

    def _constant_success(self, world_count: int) -> Tensor | None:
        threshold = self.config.success_loss
        if threshold is None:
            return None
        return torch.full((world_count,), threshold, device=self.device)
