"""The task of 2D morphogenesis: a disk of particles with zero states grows into a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn import functional

from npa_envs.checks import (
    are_texts,
    check_field,
    check_flag,
    check_non_negative,
    check_positive,
    check_text,
)
from npa_envs.errors import NPAError
from npa_envs.ops import splat, world_mean
from npa_envs.ops.pictures.splat import picture_losses
from npa_envs.ops.world_mean import scalar_world_mean
from npa_envs.rule.picture_codes import replace_code
from npa_envs.rule.rule import COLOUR_OFFSET, LIFE, NPARule
from npa_envs.tasks.base import GrowthConfig, GrowthTask
from npa_envs.tasks.seeds import spread_points
from npa_envs.tasks.targets.images import MAX_POINT_COUNT
from npa_envs.tasks.targets.picture_points import PointTarget, load_target
from npa_envs.tasks.train_config import Common, TrainConfig, fast_run, presets_of, tiny_run
from npa_envs.world.division import living
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, uniform_draws

MAX_CODE = 1024
"""Maximum of `Morphogenesis2DConfig.code_dim`."""


@dataclass(frozen=True, kw_only=True)
class Morphogenesis2DConfig(GrowthConfig):
    """2D morphogenesis: a disk of particles with zero states grows into a picture.

    The defaults are the paper's (arXiv 2601.16096). Lengths are in length units: the target's
    picture spans [-1, 1] x [-1, 1].
    """

    target: Common[str] = "gecko"
    """What to grow: a built-in name, an emoji, or the path of a PNG, JPEG or WebP file."""

    targets: Common[tuple[str, ...]] = ()
    """Several things to grow by one rule, in place of `target`: as that, or folders of pictures."""

    code_dim: int = 8
    """With `targets`: length of the code that tells particles which of them to grow, in as many
    more state channels in front of the others."""

    encoder: bool = False
    """A network that is trained with the rule computes codes from pictures, so that new pictures
    have one too. If False, each target's code is a parameter."""

    switch_share: float = 0.1
    """With `targets`: probability that a damaged world from the pool gets another one of them."""

    target_point_count: int = 4096
    """Number of opaque pixels to which the target is scaled, about; usually `particle_count`."""

    keep_background: bool = False
    """Grow the picture's whole rectangle, white where it is transparent: for photographs."""

    damage_radius: float = 0.1
    """Radius of the disk whose state is wiped in worlds from the pool [length units]; 0: none. With
    `division`, each particle dies with probability one half instead."""

    resolution: Common[int] = 256
    """Pixels on each side of the picture that the loss compares, R."""

    sigma: float = 1.0
    """Standard deviation of a particle's splat, the Gaussian spot that draws it, in pixels of the
    target (dimensionless)."""

    splat_weight: float = 2.0
    """Weight of the splat loss, the difference of pictures (dimensionless)."""

    colour_weight: float = 5.0
    """Weight of the splat loss's colour term relative to the density term (dimensionless)."""

    drift_weight: float = 0.0
    """Weight of the distance of worlds' centroids from the origin (per length unit)."""

    equivariant: bool = False
    """The rule is rotation-equivariant, and each world is compared with the target at its best
    angle, or, where `angles` is 0, without rotation."""

    chiral: bool = True
    """An equivariant rule distinguishes left from right. If False, mirrored worlds are compared
    with the target as well, where angles are tried."""

    seed_axis: float = 0.5
    """Initial worlds of an equivariant rule have an axis: the first state rises linearly across the
    disk, from minus this to this (dimensionless), along a random direction of each world, or along
    x where `angles` is 0. 0: no axis."""

    seed_across: float = 0.0
    """The same for the second state, at right angles to that direction (dimensionless). 0: none."""

    division: bool = False
    """A world starts with one particle. Particles divide and die; at most `particle_count` live."""

    angles: int = 16
    """Evenly spaced angles at which an equivariant rule's worlds are compared first; four
    refinements of four angles each follow, down to 1/39 of the first step. 0: no search; all
    initial worlds point the same way, and worlds are compared upright."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_text(self, "target", "a built-in name, an emoji or a path")
        check_positive(self, int, "target_point_count", at_most=MAX_POINT_COUNT)
        check_positive(self, float, "sigma")
        check_non_negative(self, "splat_weight", "colour_weight", "drift_weight")
        check_non_negative(self, "seed_axis", "seed_across")
        check_flag(self, "equivariant", "chiral", "encoder", "division", "keep_background")
        rule, hint = "be a tuple of names, emoji, files or folders", "targets=('gecko', 'heart')"
        check_field(self, "targets", are_texts(self.targets), rule, f"for example {hint}")
        check_positive(self, int, "code_dim", at_most=MAX_CODE)
        check_non_negative(self, "switch_share", at_most=1.0)
        check_positive(self, int, "angles", at_least=0)
        few = 0 < self.angles < 4
        check_field(self, "angles", not few, "be 0 or at least 4", "the usual 16 do")
        upright = self.seed_across > 0.0 or (self.chiral and self.seed_axis > 0.0)
        if self.equivariant and self.angles == 0 and not upright:
            raise NPAError(
                "angles=0 needs initial worlds that have a direction, got "
                f"seed_axis={self.seed_axis}, seed_across={self.seed_across} and chiral="
                f"{self.chiral}: set seed_across=0.5, or angles=16"
            )
        if self.division and (self.equivariant or self.targets):
            raise NPAError(
                "division goes neither with equivariant, because one particle has no axis, nor "
                "with targets: leave them out"
            )

    def with_particle_count(self, particle_count: int) -> Morphogenesis2DConfig:
        """Return the same task with another number of particles, and of the target's points."""
        return replace(self, particle_count=particle_count, target_point_count=particle_count)


FINER_COUNT = 4
"""Number of angles around the best one that each refinement of `best_turn` tries."""

FINER_STEP = 0.4
"""Spacing of these angles, as a fraction of that of the angles before."""

FINER_TIMES = 4
"""Number of refinements of `best_turn`."""

SURVIVING = 0.5
"""Probability that a particle survives damage, in worlds whose particles divide."""

WOUND_CHANGE = 0.1
"""A pixel is part of a wound if damage changes its colours and density by more than this in sum."""

WIDEST_WOUND = 0.35
"""Fraction of the pixels beyond which a change of a picture has no place and counts as no wound."""

FAR_AWAY = 1e3
"""Coordinate to which dead particles are moved, out of every picture [length units]."""

UNOWNED = 0.05
"""Density added to each pixel in `particle_contributions`: its part of the pixel's error is divided
evenly among all particles."""


class Morphogenesis2D(GrowthTask[Morphogenesis2DConfig]):
    """The task of growing a picture of arXiv 2601.16096, section 4.1, with its loss."""

    metric_name = "splat loss"
    grows_picture = True
    _code: Tensor | None = None

    def __init__(
        self,
        config: Morphogenesis2DConfig | None = None,
        *,
        target: PointTarget | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config or Morphogenesis2DConfig()
        if target is None:
            target = load_target(
                self.config.target,
                point_count=self.config.target_point_count,
                keep_background=self.config.keep_background,
            )
        self.target = target.to(device)
        """The target picture as points."""
        points, colours = self.target.points, self.target.colours
        self._target_mean = points.mean(dim=0)
        # Of the circle around the mean that contains the target at every angle.
        self._radius = max(1.0, float((points - self._target_mean).norm(dim=1).max()))
        self._pixel_size = self.target.pixel_size
        self._target_picture = self._splat(points[None], colours[None])[0]

    def for_rule(self, rule: NPARule) -> Self:
        """Return a copy of the task whose states begin with the rule's code of the target.

        It is the stored code of the target's name, or else the encoder's code of its picture. For a
        rule without codes it is the task itself.
        """
        codes = rule.codes
        if codes is None:
            return self
        if codes.encoder is None or self.target.name in codes.names:
            code = codes[self.target.name]
        else:
            code = codes.encode(self.target_picture[None].to(codes.table))[0]
        return self._copy_with(_code=code.detach())

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return initial worlds: a disk of particles with zero states.

        With `division` one particle lives, at the origin. With `equivariant` the first two states
        rise along an axis (`seed_axis`, `seed_across`).
        """
        x, s, *_ = super().seed(world_count, generator=generator, device=device)
        config = self.config
        if config.division:
            s[:, 0, LIFE] = 1.0
            return Particles(torch.zeros_like(x), s)
        if config.equivariant and max(config.seed_axis, config.seed_across) > 0.0:
            drawn = uniform_draws(generator, (len(x), 1), x)
            angle = 2.0 * math.pi * (drawn if config.angles > 0 else torch.zeros_like(drawn))
            cos, sin = angle.cos(), angle.sin()
            along = x[..., 0] * cos + x[..., 1] * sin
            across = x[..., 1] * cos - x[..., 0] * sin
            s[..., 0] = config.seed_axis * along / config.seed_radius
            if config.seed_across > 0.0:
                s[..., 1] = config.seed_across * across / config.seed_radius
        if self._code is not None:
            blank = s.new_zeros(*s.shape[:2], len(self._code))
            s = self.with_target_code(torch.cat((blank, s), dim=-1))
        return Particles(x, s)

    def with_target_code(self, s: Tensor) -> Tensor:
        """Return states with the target's code in their first channels; without codes, `s`."""
        return s if self._code is None else replace_code(s, self._code)

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds after random damage.

        With `division` each particle dies with probability one half, but never all of a world.
        """
        if not (self.config.division and self.config.damage_radius > 0.0):
            return super().damage(worlds, generator)
        # Survivors are grown particles, among which newly divided ones must find their role.
        x, s, *_ = worlds
        survive = uniform_draws(generator, x.shape[:2], x) < SURVIVING
        survivors = torch.where(survive[..., None], s, 0.0)
        survivors = torch.where(living(survivors).any(dim=1)[:, None, None], survivors, s)
        others = self._copy_with(config=replace(self.config, damage_radius=0.0))
        return others.damage(worlds._replace(s=survivors), generator)

    def picture(self, x: Tensor, s: Tensor, *, centred: bool = True) -> Tensor:
        """Return each world's picture: red, green, blue (sums over splats), density, [B, R, R, 4].

        If `centred`, each world's mean is moved to the target's, and worlds of an equivariant rule
        are rotated by `best_turn`, as for the loss.
        """
        colour = s[..., -3:] + COLOUR_OFFSET
        if centred:
            x = self._aligned(x, s)
        if not self.config.division:
            return self._splat(x, colour)
        x, life = torch.where(living(s)[..., None], x, FAR_AWAY), s[..., LIFE : LIFE + 1]
        picture = self._splat(x, colour * life)
        if not life.requires_grad:
            return picture
        # Splats have no weights: for its gradient, the density is the first state as a colour.
        density = self._splat(x, life.expand_as(colour))[..., :1]
        return torch.cat((picture[..., :3], density), dim=-1)

    def splat_errors(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each pixel's density error and colour error, dimensionless, shape [B, R, R] each.

        Both are |d| + d² of the difference d between the centred picture and the target's. The
        colour error is averaged over red, green and blue, and multiplied by exp(−density error), a
        factor without gradient. They are the same, bit for bit, in every batch.
        """
        size = (self.picture(x, s) - self.target_picture.to(x)).abs()
        # Added one by one: the order of torch's own sums is not promised.
        red, green, blue, density = (size + size * size).unbind(dim=-1)
        return density, (red + green + blue) / 3.0 * torch.exp(-density.detach())

    def pixel_errors(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each pixel's splat loss, whose mean is `metric`, dimensionless, [B, R, R]."""
        density, colour = self.splat_errors(x, s)
        return density + self.config.colour_weight * colour

    def pixels_near(
        self, worlds: Particles, distance: Callable[[Tensor], Tensor], margin: float
    ) -> Tensor:
        """Return at which pixels of `pixel_errors` there is a point nearer than `margin`, bool.

        `distance` maps points [B, M, D] in the worlds to distances [B, M] [length units].
        """
        side = self.config.resolution
        at = torch.linspace(-1.0, 1.0, side, device=worlds.x.device, dtype=worlds.x.dtype)
        grid = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).flatten(0, 1)
        return (distance(self._in_worlds(grid, worlds)) < margin).view(-1, side, side)

    def spread_places(self, count: int, worlds: Particles) -> Tensor:
        """Return places in each world, spread over its body, [length units], [B, count, D]."""
        return self._in_worlds(spread_points(self.target.points, count), worlds)

    def _in_worlds(self, points: Tensor, worlds: Particles) -> Tensor:
        """Return where points [M, 2] of the target lie in worlds that match it, [B, M, 2]."""
        x, s, *_ = worlds
        points = (points - self._target_mean).to(x).expand(len(x), -1, -1)
        if self._tries_angles:
            points = turned(points, self.best_turn(x, s).mT)
        return points + world_mean(x)[:, None]

    def splat_losses(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each world's density loss and colour loss, means of `splat_errors`, [B] each."""
        with_gradient = torch.is_grad_enabled() and (x.requires_grad or s.requires_grad)
        if with_gradient or self.config.division or self.goal_count > 0:
            density, colour = self.splat_errors(x, s)
            return scalar_world_mean(density), scalar_world_mean(colour)
        return self._picture_losses(turned(x, self.best_turn(x, s)) if self._tries_angles else x, s)

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's splat loss: density loss + colour_weight × colour loss, shape [B]."""
        density, colour = self.splat_losses(x, s)
        return density + self.config.colour_weight * colour

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the batch's weighted splat loss, [], and its terms "density" and "colour", []."""
        config, x, s = self.config, worlds.x, worlds.s
        if self._wounds is None:
            density, colour = (term.mean() for term in self.splat_losses(x, s))
            total = config.splat_weight * (density + config.colour_weight * colour)
            return total, {"density": density, "colour": colour}
        each, (wounds, weight) = self.splat_errors(x, s), self._wounds
        density, colour = (scalar_world_mean(errors).mean() for errors in each)
        wound = local_means(each[0] + config.colour_weight * each[1], wounds).mean()
        total = density + config.colour_weight * colour + weight * wound
        return config.splat_weight * total, {"density": density, "colour": colour, "wound": wound}

    @torch.no_grad()
    def wounds_between(self, before: Particles, after: Particles) -> Tensor | None:
        """Return which pixels of each world's picture a damage has changed, uint8, [B, R, R].

        Pixels around them are included, by a square of ε / 2. Pictures are centred as worlds were
        before. A world whose picture changed nearly everywhere has no such pixels.
        """
        if self._tries_angles:
            return None
        shift = (self._target_mean.to(before.x) - world_mean(before.x))[:, None]
        old, new = (self.picture(w.x + shift, w.s, centred=False) for w in (before, after))
        changed = ((new - old).abs().sum(dim=-1) > WOUND_CHANGE).to(old.dtype)
        margin = round(self.eps * self.config.resolution / 8.0)
        near = functional.max_pool2d(changed[:, None], 2 * margin + 1, 1, margin)[:, 0]
        return (near * (near.mean((1, 2), keepdim=True) < WIDEST_WOUND)).to(torch.uint8)

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to state_dim, hidden_dim and eps0."""
        config = self.config
        known: dict[str, Any] = {"divides": True} if config.division else {}
        if config.equivariant:
            known |= {"equivariant": True, "chiral": config.chiral}
        return super().rule_shape | known

    def bounded(self, x: Tensor) -> Tensor:
        """Return what `penalties` keep in [-1, 1]: positions, or distances from 0 [B, N, 1].

        The latter are of worlds that are compared at their best angle. Their unit is the radius of
        the circle that contains the target at every angle.
        """
        if not self._tries_angles:
            return x
        return x.square().sum(dim=-1, keepdim=True).add(1e-12).sqrt() / self._radius

    def penalties(self, worlds: Particles) -> dict[str, tuple[float, Tensor]]:
        """Return the penalties of `GrowthTask` and, if weighted, "drift" from the origin."""
        terms = super().penalties(worlds)
        if self.config.drift_weight > 0.0:
            drift = world_mean(worlds.x).square().sum(dim=-1).add(1e-12).sqrt().mean()
            terms["drift"] = self.config.drift_weight, drift
        return terms

    def particle_contributions(self, x: Tensor, s: Tensor) -> Tensor:
        """Return N times each particle's contribution to its world's splat loss, shape [B, N].

        A pixel's error is divided among the particles that cover it, by their splats there; the
        error of uncovered pixels is divided evenly among all. The mean over the particles is
        `metric`, up to rounding.
        """
        with torch.no_grad():
            errors = self.pixel_errors(x, s)
        blank = x.new_zeros(*x.shape[:2], 3).requires_grad_()
        with torch.enable_grad():
            picture = self._splat(self._aligned(x.detach(), s), blank)
            owned = errors / (picture[..., 3].detach() + UNOWNED)
            # The picture is linear in the colours: its gradient sums over a particle's splat.
            (pulled,) = torch.autograd.grad(picture[..., 0], blank, owned)
        pixel_count = self.config.resolution**2
        unowned = scalar_world_mean(UNOWNED * owned)
        return pulled[..., 0] * (x.shape[1] / pixel_count) + unowned[:, None]

    @torch.no_grad()
    def best_turn(self, x: Tensor, s: Tensor) -> Tensor:
        """Return matrices [B, 2, 2] of the rotations that bring worlds closest to the target.

        Evenly spaced angles are tried, then finer ones near the best. Worlds of a rule that is not
        chiral are mirrored as well. If `angles` is 0, matrices are the identity.
        """
        config = self.config
        if config.angles == 0:
            return torch.eye(2, device=x.device, dtype=x.dtype).expand(len(x), 2, 2)
        step = 2.0 * math.pi / config.angles
        angle = torch.arange(config.angles, device=x.device, dtype=x.dtype) * step
        hand = torch.ones_like(angle)
        if not config.chiral:
            angle, hand = angle.repeat(2), torch.cat((hand, -hand))
        angle, hand = (values.expand(len(x), -1) for values in (angle, hand))
        finer = torch.arange(FINER_COUNT, device=x.device, dtype=x.dtype) - 0.5 * (FINER_COUNT - 1)
        for refinement in range(FINER_TIMES + 1):
            if refinement > 0:
                step *= FINER_STEP
                angle, hand = angle + finer * step, hand.expand(-1, FINER_COUNT)
            # Every world at every angle is a world of one batch.
            copies = x[:, None].expand(-1, angle.shape[1], -1, -1).flatten(0, 1)
            colours = s[:, None, :, -3:].expand(-1, angle.shape[1], -1, -1).flatten(0, 1)
            rotated = turned(copies, turns(angle, hand).flatten(0, 1))
            density, colour = self._picture_losses(rotated, colours)
            losses = (density + self.config.colour_weight * colour).view_as(angle)
            best = losses.argmin(dim=1, keepdim=True)
            angle, hand = angle.gather(1, best), hand.gather(1, best)
        return turns(angle, hand)[:, 0]

    def _picture_losses(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each world's density loss and colour loss without rotation, shape [B] each."""
        return picture_losses(
            x,
            s,
            self.target_picture,
            goal=self._target_mean,
            shift=COLOUR_OFFSET,
            pixel_size=self.pixel_size,
            sigma=self.config.sigma,
        )

    @property
    def _tries_angles(self) -> bool:
        """Whether worlds are compared with the target at their best angles."""
        return self.config.equivariant and self.config.angles > 0

    def _aligned(self, x: Tensor, s: Tensor) -> Tensor:
        """Return positions moved to the target's mean, and rotated by `best_turn` for the loss."""
        if self._tries_angles:
            x = turned(x, self.best_turn(x, s))
        return x - world_mean(x)[:, None] + self._target_mean.to(x)

    def _splat(self, x: Tensor, colour: Tensor) -> Tensor:
        """Return the pictures [B, R, R, 4] of particles in colours [B, N, 3]."""
        return splat(
            x,
            colour,
            resolution=self.config.resolution,
            pixel_size=self.pixel_size,
            sigma=self.config.sigma,
        )


def local_means(errors: Tensor, places: Tensor) -> Tensor:
    """Return each world's mean of errors [B, ...] over pixels where `places` is 1, else 0, [B].

    It is 0 for a world without such pixels.
    """
    places = places.to(errors.dtype)
    share = scalar_world_mean(places).clamp_min(1.0 / places[0].numel())
    return scalar_world_mean(errors * places) / share


def turns(angle: Tensor, hand: Tensor) -> Tensor:
    """Return matrices [..., 2, 2] of rotations by angles [...] in radians.

    Where `hand` [...] is -1 and not 1, the matrix mirrors first.
    """
    cos, sin = angle.cos(), angle.sin()
    return torch.stack((cos, -sin * hand, sin, cos * hand), dim=-1).view(*angle.shape, 2, 2)


def turned(x: Tensor, turn: Tensor) -> Tensor:
    """Return positions [B, N, 2] rotated around the origin by matrices [B, 2, 2]."""
    (a, b), (c, d) = (row.unbind(dim=-1) for row in turn.to(x)[:, None].unbind(dim=-2))
    u, v = x.unbind(dim=-1)
    # Written out: the order of torch's own batched products may depend on the batch.
    return torch.stack((a * u + b * v, c * u + d * v), dim=-1)


Morphogenesis2DTrainConfig = TrainConfig[Morphogenesis2DConfig]
"""A training run of 2D morphogenesis."""

_STABILITY: Mapping[str, Any] = {
    "escape_weight": 10.0, "bound_weight": 10.0, "drift_weight": 1.0, "clump_radius": 0.2,
    "cut_gap": 0.1,
}  # fmt: skip
"""Settings of the task for long stability and for healing clumps and cuts (docs/stability.md)."""

SPECIES_RUN: Mapping[str, Any] = {
    "optimiser": "adamw", "seed_interval": 1, "max_age_range": (0, 0), "damage_share": 1.0,
    "stillness_weight": 0.0,
}  # fmt: skip
"""Settings of a run of several species: AdamW, an initial world in every batch, which are half of
batches of two worlds, and no stillness loss (docs/species.md)."""

# Found by experiment on pictures that nobody tuned for: docs/recipes.md.
_BEST: TrainConfig[Morphogenesis2DConfig] = TrainConfig(
    task=Morphogenesis2DConfig(
        escape_share=2e-4, damage_radius=0.2, cut_share=0.8, cut_anywhere=True, **_STABILITY,
    ),
    repeats=1, iterations=15_000, pool_size=64, steps=(48, 80), optimiser="muon",
    learning_rate=3e-3, weight_decay=0.1, schedule="cosine", max_age_range=(16, 16_384),
    damage_and_keep_share=0.7, damage_share=0.125, stillness_min_age=1024, stillness_weight=2.0,
    stillness_power=4.0, dead_zone=1e-3, initial_rule="heart-first", wound_chance=0.2,
    wound_weight=0.5,
)  # fmt: skip

MORPHOGENESIS2D_PRESETS = presets_of(
    "morphogenesis2d", paper=TrainConfig(task=Morphogenesis2DConfig()), best=_BEST,
    # A wider network and a radius that holds 1.7 times the neighbours: thin lines.
    detail=replace(_BEST, task=replace(_BEST.task, hidden_dim=512, eps=0.13), iterations=12_000),
    # A few particles that see far; of two worlds one is young, one grown and at rest:
    # docs/recipes.md.
    fast=fast_run(
        task=Morphogenesis2DConfig(
            target_point_count=512, particle_count=512, eps=0.2, seed_radius=0.4, resolution=64,
            escape_share=1e-3, **_STABILITY,
        ),
        iterations=2400, pool_size=32, steps=(16, 32), optimiser="muon", learning_rate=5e-3,
        schedule="cosine", max_age_range=(24, 256), damage_share=0.5, stillness_min_age=64,
        stillness_weight=2.0, picture_interval=200,
    ),
    tiny=tiny_run(
        task=Morphogenesis2DConfig(
            target="ring", target_point_count=128, particle_count=128, hidden_dim=32, eps=0.3,
            resolution=32,
        ),
        iterations=40, steps=(8, 16), milestones=(30,),
    ),
)  # fmt: skip
"""2D morphogenesis: `paper` (arXiv 2601.16096), `best` (any picture, one run of minutes on a GPU),
`detail` (`best` with thin lines, at twice the cost of a step), `fast` (minutes on one core), `tiny` (tests)."""
