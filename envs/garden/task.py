"""Living worlds: a rule runs them, and an agent touches them."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.state import not_finite
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.worlds import BatchedWorlds
from npa_envs.envs.garden.brushes import (
    SEEN_AT_A_PLACE,
    SEEN_LIMIT,
    BrushSpaces,
    GardenConfig,
    brushed,
    grid_places,
    holds,
    offsets,
)
from npa_envs.envs.grown import GrownTask, check_runs, run_rule
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.targets.points import PointTarget
from npa_envs.world.cuda_graph import makes_plain_tensors, to_device_async
from npa_envs.world.randomness import StreamId, WorldRandom

SEEN_SCALES = (2.0, 4.0, 4.0, 4.0, 4.0, 4.0)
"""Of these numbers (dimensionless): they make them about as large as one another."""

Config = TypeVar("Config", bound=GardenConfig)


class LivingWorlds(BatchedWorlds):
    """Worlds whose particles a rule runs: what the task makes of an action, observes and pays.

    On a CPU worlds are stepped one after the other, as there a rule's products change in the last
    bit with the number of worlds.
    """

    def _prepare_actions(self) -> None:
        self.context = self.x.new_zeros(self.world_count, self.task.context_count)
        """What the task keeps of the start of each world, shape [B, M]."""

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Do what `step` does but wait for the device, and return what is observed there then."""
        action = action.to(self.device)
        if not bool(torch.isfinite(action).all()):
            raise not_finite(action)
        diverged = torch.zeros_like(self.diverged, dtype=torch.bool)
        limits = self.physics.limits.position, self.physics.limits.state
        for own, new, limit in zip((self.x, self.s), self._stepped(action), limits, strict=True):
            # NaN is not within any limit.
            diverged |= ~(new.abs() < limit).flatten(1).all(dim=1)
            own.copy_(torch.nan_to_num(new, nan=0.0).clamp(-limit, limit))
        self.diverged.copy_(diverged)
        self.judge()
        if self._side_stream is not None:
            self._side_stream.mark()
        return self.perceive(out)

    def _stepped(self, action: Tensor) -> tuple[Tensor, Tensor]:
        x, s = self.x, self.s
        if x.is_cuda or len(x) == 1:
            stepped: tuple[Tensor, Tensor] = self.task.step(x, s, action, self.random)
            return stepped
        worlds = []
        for k in range(len(x)):
            one = slice(k, k + 1)
            random = self.random.take(one)
            worlds.append(self.task.step(x[one], s[one], action[one], random))
        self.random.sync_with(random, self.task.config.rule_steps)
        x, s = (torch.cat(part) for part in zip(*worlds, strict=True))
        return x, s

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return the observations of all worlds as they are, shape [B, O], written to `out`."""
        seen: Tensor = self.task.observe(self.x, self.s, self.loss, self.context)
        return seen if out is None else out.copy_(seen)

    def restart(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of some worlds, [M], and write what is observed there."""
        index = to_device_async(worlds, self.device)
        self.start(index)
        observation[index] = self.perceive()[index]

    @property
    def pays_last_step_alone(self) -> bool:
        """Whether an episode's last step is the only one that is paid."""
        return super().pays_last_step_alone and not self.task.pays_each_step

    def begin(self, worlds: Tensor, start: Start, *, check: bool) -> None:
        """Begin episodes in some worlds, and keep the task's context of their starts."""
        super().begin(worlds, start, check=check)
        draws = self.random.take(worlds).substream(StreamId.GOAL)
        self.context[worlds] = self.task.episode_context(start, self.loss[worlds], draws)

    def judge(self) -> None:
        """Write rewards, losses and endings of the worlds as they now are."""
        super().judge()
        loss, (ended, late) = self.report.numbers[1], self.report.endings[:2]
        reward = self.task.reward(self.x, self.s, loss, self.context)
        if self.pays_last_step_alone:
            last = ended | late
            if self.episode_steps is None:
                last = last | (self.elapsed == self.task.config.episode_steps)
            reward = torch.where(last, reward, 0.0)
        self.task.next_goals(self.elapsed, self.context, self.goal)
        self.report.numbers[0].copy_(reward)
        if self.x.is_cuda and len(self.x) == 1:
            self.host_numbers.copy_(self.report.numbers, non_blocking=True)

    def extra_info(self) -> dict[str, Tensor]:
        """Return what infos hold besides, shape [B, ...] each."""
        infos: dict[str, Tensor] = self.task.context_info(self.x, self.s, self.context)
        return infos


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


class Living:
    """The part of tasks whose worlds a rule runs while an agent acts on them from outside."""

    worlds_type = LivingWorlds

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


class GardenTask(Living, GrownTask[Config]):
    """A grown picture that goes on living; differentiable in the brushes."""

    config_type: ClassVar[type[GardenConfig]] = GardenConfig
    form_type: ClassVar[Any] = BrushSpaces

    def __init__(self, config: Config, device: torch.device) -> None:
        super().__init__(config, device)
        constants = {"eps0": config.eps0, "moment_inverse": config.moment_inverse}
        check_runs(self.rule, alpha=config.alpha, **constants)
        self.rule.requires_grad_(False)
        self.lacking = TargetDeficit(grid_places(config, device), self.task.target, config)
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
        return world_mean(x) - self.task.target.points.mean(dim=0)

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
        picture, target = self.task.picture(x, s), self.task.target_picture
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


class GardenEnv(NPAEnv):
    """One living world as a Gymnasium environment; subclasses name the task.

    The sections below belong to the docstring of every subclass, after its own of the same name.

    ## Observation space

    | `observe` | Observed | Unit |
    |---|---|---|
    | `"grid"` | what lacks at each place of a grid, [6 P²] with P = `place_count` | dimensionless |
    | `"picture"` | a coarse picture, [4 G²] with G = `picture_size` | dimensionless |
    | `"moments"` | means over all particles, [5 + 3C] | lengths, dimensionless |

    The grid has P × P places, row by row from the bottom up, from −`place_reach` to `place_reach`
    along x and y of the picture's middle. Each place has six numbers: what a brush there would hold
    of the target less what it holds now. These are the number of particles, its products with their
    x and y from the brush in brush radii, and red, green and blue. The first is 2 and the others
    are 4 where as many particles lack as a brush holds at an average place of the target.

    The picture is red, green, blue, then density, each row by row from the bottom up; it spans
    [-1, 1] × [-1, 1] around the picture's middle. Colours are sums over particles, as the density
    is. `observe_error=True` adds four channels: the target's picture less this one.

    Moments are the means of x and y; then, about that place, of x², x y, y², of each state, of x
    times each state, and of y times each state. Numbers are clipped to ±8.

    ## Action space

    With `actions="grid"`, `Box(-1, 1, (P², W), float32)`: a row for the brush at each place of the
    grid. All act at once, their effects add up, and then the rule runs for `rule_steps` steps.
    Zeros do nothing.

    | Columns | Action a | An action of 1 is | Effect where the brush holds w of a particle |
    |---|---|---|---|
    | 2, of `"push"` | how far to push | `push_length` | x ← x + w `push_length` a |
    | 1, of `"wipe"` | how much to wipe | all of it | s ← s − w a s |
    | 1 a channel, of `"inject"` | what to inject | `state_scale` | s ← s + w `state_scale` a |
    | 1, of `"rate"` | how fast to live | twice as fast | steps of the rule count 1 + w a times |

    `tools` says which columns there are; the default has `"push"` alone. `"inject"` has one for
    each of `inject_channels`. w = (1 − r²)² at r brush radii from the brush, 0 outside. What is
    wiped is clipped to [0, 1] of a state, rates to [0, 2], entries to [-1, 1]. A number that is not
    finite raises `NPAError` and leaves the world as it was. `env.unwrapped.task.step(x, s, action,
    random)` is differentiable in all of them, but for the correction of moments that
    [perception](../mathematics.md#perception) holds constant.

    With `actions="free"`, `Box(-1, 1, (K, 2 + W), float32)`: there are K = `brush_count` brushes,
    and two columns more in front say where each is used, along x and y [length units].

    With `actions="discrete"`, `MultiDiscrete` with four numbers for each of K brushes: its place
    on the grid along x and along y; its tool, which is nothing, a push in one of eight directions,
    wipe, inject each channel up or down, stop, quicken, as far as there are such tools; and its
    strength, among `strength_count`.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss` | reset, step | L as it is now: how far the picture is from the target's |
    | `loss_density`, `loss_colour` | reset, step | the parts of the loss |
    | `reward_density`, `reward_colour` | step | how much each part fell in this step |
    | `success`, `diverged` | step | whether it did so in this step, bool |
    | `reason` | last step | why the episode ended, see above; None for worlds that go on |

    ## Vectorized environment

    As in [every environment](Morphogenesis2D.md#vectorized-environment), but on a CPU worlds are
    stepped one after the other: a batch saves no time there.
    """
