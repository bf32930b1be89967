"""Living worlds: a rule runs them, and an agent touches them."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.core.task import Start
from npa_envs.envs.garden.brush_layout import brushed, grid_places, holds, offsets
from npa_envs.envs.garden.config import GardenConfig
from npa_envs.envs.grown import GrownTask, run_rule
from npa_envs.errors import NPAError
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.targets.points import PointTarget
from npa_envs.world.randomness import WorldRandom

SEEN_LIMIT = 8.0
"""What is seen is clipped to plus and minus this (dimensionless, or length units)."""

SEEN_AT_A_PLACE = 6
"""Numbers that are seen at a place of the grid."""

SEEN_SCALES = (2.0, 4.0, 4.0, 4.0, 4.0, 4.0)
"""Of these numbers (dimensionless): they make them about as large as one another."""

Config = TypeVar("Config", bound=GardenConfig)


class TargetDeficit:
    """What lacks to a target at some places, as soft brushes there would hold it."""

    def __init__(self, places: Tensor, target: PointTarget, config: GardenConfig) -> None:
        self.places, self._config = places, config
        self._scale = torch.ones(SEEN_AT_A_PLACE, device=places.device)
        none = places.new_zeros(1, 2)
        wanted = self._held(target.points[None], target.colours[None] - COLOUR_OFFSET, none)
        # Brushes may be too small to hold anything.
        usual = wanted[..., 0].mean().clamp_min(1.0 / len(target.points))
        self._scale = torch.tensor(SEEN_SCALES, device=places.device) / usual
        self._wanted = self._scale * wanted

    def __call__(self, x: Tensor, s: Tensor, middle: Tensor) -> Tensor:
        """Return how many particles lack, towards which side, and colours, [B, P, 6].

        Numbers are dimensionless: of all particles, of their places along x and y from the brush in
        brush radii, and of their red, green and blue. They are `SEEN_SCALES` times what a brush
        holds, as multiples of the particles that one holds at an average place of the target.
        """
        return self._wanted - self._held(x, s[..., -3:], middle)

    def _held(self, x: Tensor, colour: Tensor, middle: Tensor) -> Tensor:
        away = offsets(x, middle[:, None] + self.places, self._config)
        sides = away / self._config.brush_radius
        colours = colour[:, None].expand(-1, len(self.places), -1, -1)
        values = torch.cat((torch.ones_like(sides[..., :1]), sides, colours), dim=-1)
        values = values * holds(away, self._config)[..., None]
        mean = world_mean(values.transpose(1, 2).flatten(2))
        return self._scale * mean.view(len(x), len(self.places), SEEN_AT_A_PLACE)


class GardenTask(GrownTask[Config]):
    """A grown picture that goes on living; differentiable in the brushes."""

    config_type: ClassVar[type[GardenConfig]] = GardenConfig

    def __init__(self, config: Config, device: torch.device) -> None:
        super().__init__(config, device)
        wanted = {
            "alpha": config.alpha,
            "eps0": config.eps0,
            "moment_inverse": config.moment_inverse,
        }
        for name, value in wanted.items():
            if getattr(self.rule, name) != value:
                raise NPAError(
                    f"{name} must be the rule's, {getattr(self.rule, name)}, got {value}: give "
                    f"{name}={getattr(self.rule, name)!r}, or another rule"
                )
        self.rule.requires_grad_(False)
        self.lacking = TargetDeficit(grid_places(config, device), self.goal.target, config)
        """What lacks at the places of the grid."""

    @classmethod
    def extra_bytes(cls, config: Any, world_count: int) -> int:
        """Return about how much memory pool, pictures and brushes need [bytes]."""
        values = SEEN_AT_A_PLACE * config.place_count**2 * config.particle_count
        return super().extra_bytes(config, world_count) + int(3 * 4 * values * world_count)

    def step(
        self,
        x: Tensor,
        s: Tensor,
        action: Tensor,
        random: WorldRandom,
        *,
        detach_positions: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return worlds after a step of the environment; differentiable.

        Arguments are those of `brush_and_roll`.
        """
        tended = self.brush_and_roll(x, s, action, random, detach_positions=detach_positions)
        return self.disturb(*tended, random)

    def brush_and_roll(
        self,
        x: Tensor,
        s: Tensor,
        action: Tensor,
        random: WorldRandom,
        *,
        detach_positions: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return worlds after brushes and the rule's steps, before what befalls them."""
        run = partial(
            run_rule, self.rule, self.config, random=random, detach_positions=detach_positions
        )
        x, s, rate = brushed(x, s, action, self.middle(x), self.config)
        if rate is None:
            x, s = run(x, s, self.config.rule_steps)
        else:
            for _ in range(self.config.rule_steps):
                new_x, new_s = run(x, s, 1)
                x, s = x + rate * (new_x - x), s + rate * (new_s - s)
        return x, s

    def disturb(self, x: Tensor, s: Tensor, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return worlds with what befalls them at the end of a step; by default nothing."""
        return x, s

    def middle(self, x: Tensor) -> Tensor:
        """Return what brushes' places are counted from: the mean, less the target's, [B, 2]."""
        return world_mean(x) - self.goal.target.points.mean(dim=0)

    context_count: ClassVar[int]
    """Numbers that a world keeps of its start, M."""

    pays_each_step: ClassVar[bool] = False
    """Whether a sparse reward is one of each step all the same."""

    def episode_context(self, start: Start, loss: Tensor, random: WorldRandom) -> Tensor:
        """Return what worlds keep of their start, shape [B, M]; `loss` is theirs, [B]."""
        raise NotImplementedError

    def reward(self, x: Tensor, s: Tensor, loss: Tensor, context: Tensor) -> Tensor:
        """Return what worlds are worth in a step, [B], of loss [B] and marks [B, M]."""
        raise NotImplementedError

    def next_goals(self, elapsed: Tensor, context: Tensor, goal: Tensor) -> None:
        """Change goals, in place, after a step is paid, by steps since the start, [B]."""

    def context_info(self, x: Tensor, s: Tensor, context: Tensor) -> dict[str, Tensor]:
        """Return what infos tell of worlds besides, shape [B, ...] each."""
        return {}

    def observe(self, x: Tensor, s: Tensor, loss: Tensor, context: Tensor) -> Tensor:
        """Return what is seen of worlds, shape [B, O]."""
        if self.config.observe == "grid":
            seen = self.lacking(x, s, self.middle(x))
        else:
            seen = self.moments(x, s) if self.config.observe == "moments" else self.coarse(x, s)
        seen = seen.flatten(1)
        return seen.clamp(-SEEN_LIMIT, SEEN_LIMIT)

    def coarse(self, x: Tensor, s: Tensor) -> Tensor:
        """Return coarse pictures, red, green, blue, density, shape [B, 4, G, G].

        Each is the mean over pixels of the picture that the loss compares. With `observe_error`
        four channels more are what it lacks to the target's.
        """
        picture, target = self.goal.picture(x, s), self.goal.target_picture
        if self.config.observe_error:
            picture = torch.cat((picture, target - picture), dim=-1)
        pixels = self.config.resolution // self.config.picture_size
        return F.avg_pool2d(picture.permute(0, 3, 1, 2), pixels)

    def moments(self, x: Tensor, s: Tensor) -> Tensor:
        """Return means of 1, x, y, x², x y, y² and of each state with 1, x, y, [B, 5 + 3 C].

        The first two are the mean position [length units]; all others are about it.
        """
        mean = world_mean(x)
        away = x - mean[:, None]
        across, up = away[..., :1], away[..., 1:]
        seconds = torch.cat((across * across, across * up, up * up), dim=-1)
        values = torch.cat((seconds, s, across * s, up * s), dim=-1)
        return torch.cat((mean, world_mean(values)), dim=-1)


LEAST_RISE = 0.1
"""Turning grey counts as at least this share more of a picture's loss (dimensionless)."""


def marks_of_whole(task: GardenTask[Config], start: Start, loss: Tensor) -> Tensor:
    """Return the loss of whole pictures, and how much it rises if they turn grey, shape [B, 2]."""
    grey = sum(task.losses(start.x, torch.zeros_like(start.s)).values(), torch.zeros_like(loss))
    # Worlds that have not grown are as bad as grey ones.
    return torch.stack((loss, (grey - loss).maximum(LEAST_RISE * loss)), dim=1)


def lost_share(loss: Tensor, context: Tensor) -> Tensor:
    """Return what share of pictures is lost: 0 of whole ones, 1 of grey ones, shape [B]."""
    return (loss - context[:, 0]) / context[:, 1]
