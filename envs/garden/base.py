"""Base classes of gardens: a rule moves the particles of a picture, and agents have brushes."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import Start
from npa_envs.envs.garden.brush_actions import (
    OBSERVATION_LIMIT,
    VALUES_PER_PLACE,
    BrushSpaces,
    GardenConfig,
    apply_brushes,
    brush_options,
    grid_places,
)
from npa_envs.envs.trained_rules import GrownTask, RuleDrivenTask, check_matches_rule, run_rule
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.targets.picture_points import PointTarget
from npa_envs.world.brushes import nearest_image, sums_under_brushes
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom

DEFICIT_SCALES = (2.0, 4.0, 4.0, 4.0, 4.0, 4.0)
"""Factors of the six values of a place; all values then have about the same size."""

MIN_GREY_RISE = 0.1
"""Minimum rise of the loss by turning grey, as a fraction of the loss (dimensionless)."""

Config = TypeVar("Config", bound=GardenConfig)


class TargetDeficit:
    """Sums over the target minus the same sums over a world's particles, at each place."""

    def __init__(self, places: Tensor, target: PointTarget, config: GardenConfig) -> None:
        self.places, self._config = places, config
        self._scale = torch.ones(VALUES_PER_PLACE, device=places.device)
        middle = places.new_zeros(1, 2)
        whole = Particles(target.points[None], target.colours[None] - COLOUR_OFFSET)
        target_sums = self._weighted(whole, middle)
        # Brushes may be too small to cover any point.
        mean_count = target_sums[..., 0].mean().clamp_min(1.0 / len(target.points))
        self._scale = torch.tensor(DEFICIT_SCALES, device=places.device) / mean_count
        self._target_sums = self._scale * target_sums

    def __call__(self, particles: Particles, middle: Tensor) -> Tensor:
        """Return the target's sums minus the worlds' sums at each place, [B, places, 6].

        Sums are over particles, dimensionless: of 1, of x and y from the place in brush radii, and
        of red, green and blue. They are in units of the target's mean sum of 1 over all places,
        times `DEFICIT_SCALES`. `middle`, [B, 2], is the origin of the places.
        """
        return self._target_sums - self._weighted(particles, middle)

    def _weighted(self, particles: Particles, middle: Tensor) -> Tensor:
        x, colours, places = particles.x, particles.s[..., -3:], middle[:, None] + self.places
        sums = sums_under_brushes(places, x, colours, moments=True, **brush_options(self._config))
        return self._scale / x.shape[1] * sums


def coarse(pictures: Tensor, size: int) -> Tensor:
    """Return pictures, [B, R, R, channels], as coarse observations, [B, channels size²]."""
    observed = F.avg_pool2d(pictures.permute(0, 3, 1, 2), pictures.shape[1] // size).flatten(1)
    return observed.clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)


class StartLosses(NamedTuple):
    """The `context` of B episodes in gardens: losses of the grown pictures they start from."""

    intact_loss: Tensor
    """Loss of the intact picture, shape [B]."""
    rise: Tensor
    """How much more the loss of the same picture is with all states 0, grey, shape [B]."""


class GardenTask(RuleDrivenTask[Config], GrownTask[Config]):
    """Base class of tasks with brushes on a grown picture, which its rule keeps stepping."""

    config_type: ClassVar[type[GardenConfig]] = GardenConfig
    spaces_type: ClassVar[Any] = BrushSpaces
    controls = "brushes"

    def __init__(self, config: Config, device: torch.device) -> None:
        super().__init__(config, device)
        check_matches_rule(self.rule, config, "alpha", "eps0", "moment_inverse")
        self.rule.requires_grad_(False)
        self._target_middle = self.task.target.points.mean(dim=0)
        self.deficit = TargetDeficit(grid_places(config, device), self.task.target, config)
        """Difference between the target and worlds at the places of the grid."""

    @classmethod
    def bytes_per_world(cls, config: Any) -> int:
        """Return about how much memory the loss and the brushes of one world need [bytes]."""
        values = VALUES_PER_PLACE * config.place_count**2 * config.particle_count
        return super().bytes_per_world(config) + 3 * 4 * int(values)

    def step(
        self, x: Tensor, s: Tensor, action: Tensor, random: WorldRandom
    ) -> tuple[Tensor, Tensor]:
        """Return x and s after brushes, steps of the rule and `disturb`; differentiable.

        `action` has J rows of W columns for each world, [B, J, W] or [B, J W].
        """
        action = action.reshape(len(x), -1, self.config.brush_layout.width)
        x, s, *_ = self.disturb(self.brush_and_roll(Particles(x, s), action, random), random)
        return x, s

    def brush_and_roll(
        self, particles: Particles, action: Tensor, random: WorldRandom
    ) -> Particles:
        """Return worlds after the brushes and the rule's steps, before `disturb`."""
        config = self.config
        run = partial(
            run_rule, self.rule, config, random=random, detach_positions=False, cuda_graph="whole"
        )
        middle = self.middle(particles.x)
        particles, rate = apply_brushes(particles, action, middle, config, self.deficit.places)
        if rate is None:
            return run(particles, config.rule_steps)
        box = self.periodic_sides
        for _ in range(config.rule_steps):
            (x, s, *_), stepped = particles, run(particles, 1)
            x = x + rate * nearest_image(stepped.x - x, box)
            s = s + rate * (stepped.s - s)
            particles = stepped._replace(x=nearest_image(x, box), s=s)
        return particles

    def disturb(self, particles: Particles, random: WorldRandom) -> Particles:
        """Return worlds after disturbances, which end a step; by default there are none."""
        return particles

    def episode_context(self, start: Start, loss: Tensor, random: WorldRandom) -> Any:
        """Return the losses of the grown pictures, and how much they rise if these are grey."""
        grey = sum(self.losses(start.x, torch.zeros_like(start.s)).values(), torch.zeros_like(loss))
        # The loss of a picture that did not grow may not rise at all.
        return StartLosses(loss, (grey - loss).maximum(MIN_GREY_RISE * loss))

    def lost_fraction(self, loss: Tensor, context: Any) -> Tensor:
        """Return lost fractions of pictures, [B]: 0 as good as at the start, 1 as bad as grey."""
        fraction: Tensor = (loss - context.intact_loss) / context.rise
        return fraction

    def middle(self, x: Tensor) -> Tensor:
        """Return the origin of the places: particles' mean position minus the target's, [B, 2]."""
        return world_mean(x) - self._target_middle

    def observe(self, particles: Particles, loss: Tensor, context: Any) -> Tensor:
        """Return observations [B, O] in the form of `config.observe`: grid, moments or picture."""
        if self.config.observe == "picture":
            return coarse(self.observed_picture(particles), self.config.picture_size)
        if self.config.observe == "grid":
            observed = self.deficit(particles, self.middle(particles.x)).flatten(1)
        else:
            observed = self.moments(particles)
        return observed.clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)

    def observed_picture(self, particles: Particles) -> Tensor:
        """Return pictures, [B, R, R, 4], or with `observe_error` also target minus it, [.., 8]."""
        picture = self.task.picture(particles.x, particles.s)
        if not self.config.observe_error:
            return picture
        return torch.cat((picture, self.task.target_picture - picture), dim=-1)

    def moments(self, particles: Particles) -> Tensor:
        """Return `moments_of` x, means of s, x s, y s (x, y from the mean), [B, 5 + 3 C]."""
        x, s, *_ = particles
        away = x - world_mean(x)[:, None]
        values = torch.cat((s, away[..., :1] * s, away[..., 1:] * s), dim=-1)
        return torch.cat((moments_of(x), world_mean(values)), dim=-1)


def moments_of(x: Tensor) -> Tensor:
    """Return mean x, y and, relative to it, the means of x², x y, y², shape [B, 5]."""
    mean = world_mean(x)
    across, up = (x - mean[:, None]).unbind(dim=-1)
    seconds = torch.stack((across * across, across * up, up * up), dim=-1)
    return torch.cat((mean, world_mean(seconds)), dim=-1)


class GardenEnv(NPAEnv):
    """Base class of one garden as a Gymnasium environment; subclasses set `task_type`.

    The page of each subclass has the sections below, each after its own section of the same name.

    ## Observation space

    | `observe` | Observed | Unit |
    |---|---|---|
    | `"grid"` | deficit at each place of a grid, [6 P²] with P = `place_count` | dimensionless |
    | `"picture"` | a coarse picture, [4 G²] with G = `picture_size` | dimensionless |
    | `"moments"` | means over all particles, [5 + 3C] | lengths, dimensionless |

    The grid has P × P places, row by row from the bottom up, from −`place_reach` to `place_reach`
    along x and y from the picture's middle. Each place has six values: sums over the target's
    particles minus sums over the world's, both weighted as by a brush there. The sums are of 1, of
    x and y from the place in brush radii, and of red, green and blue. They are in units of the mean
    sum of 1 over the target's places; the first is multiplied by 2, the others by 4.

    The picture is red, green, blue, then density, each row by row from the bottom up; it spans
    [-1, 1] × [-1, 1] around the picture's middle. Colours are sums over particles, as the density
    is. `observe_error=True` adds four channels: the target's picture less this one.

    Moments are the means of x and y; then, relative to that mean, of x², x y, y², of each state, of
    x times each state, and of y times each state. All observations are clipped to ±8.

    ## Action space

    With `actions="grid"`, `Box(-1, 1, (P² W,), float32)`: a row of W columns for the brush at each
    place of the grid, row after row. With `action_shape="brushes"` the shape is [P², W]; `step`
    takes both, whatever `action_shape` is. All brushes act at once, their effects add up, and then
    the rule makes `rule_steps` steps. Zeros have no effect.

    | Columns | Action a | An action of 1 is | Effect at the brush's weight w |
    |---|---|---|---|
    | 2, of `"push"` | displacement | `push_length` | x ← x + w `push_length` a |
    | 1, of `"wipe"` | fraction to wipe | all of the state | s ← s − w a s |
    | 1 a channel, of `"inject"` | change of the state | `state_scale` | s ← s + w `state_scale` a |
    | 1, of `"rate"` | speed of the rule | twice as fast | steps of the rule count 1 + w a times |

    `tools` chooses the columns; the default is only `"push"`. `"inject"` has one column for each
    of `inject_channels`. w = (1 − r²)² at r brush radii from the brush, and 0 outside. The wiped
    fraction is clipped to [0, 1], rates to [0, 2], actions to [-1, 1]. An action that is not finite
    raises `NPAError` and does not change the world. `env.unwrapped.task.step(x, s, action, random)`
    is differentiable, except that the moment correction of
    [perception](../mathematics.md#perception) counts as constant.

    With `actions="free"` there are J = `brush_count` brushes of 2 + W columns each, J (2 + W)
    numbers. The first two columns are a brush's position, along x and y [length units].

    With `actions="discrete"`, `MultiDiscrete` with four choices for each of J brushes: its place on
    the grid along x and along y; its tool (nothing, a push in one of eight directions, wipe, each
    channel up or down, rate 0, rate 2, as far as `tools` has them); and its strength, one of
    `strength_count`.

    ## Version history

    - v0: first version. Actions of preliminary versions were rows, as with
      `action_shape="brushes"`; worlds, rewards and returns are the same.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss` | reset, step | the current loss L of the picture |
    | `loss_density`, `loss_colour` | reset, step | the terms of the loss |
    | `reward_density`, `reward_colour` | step | decrease of each term in this step |
    | `success`, `diverged` | step | whether the world succeeded or diverged in it, bool |
    | `reason` | last step | why the episode ended, see above; None for other worlds |

    ## Vectorized environment

    As in [every environment](Morphogenesis2D.md#vectorized-environment).
    """
