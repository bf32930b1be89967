"""What 2D morphogenesis can be told: the target, the world, the rule's size, the loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import splat, world_mean
from npa_envs.ops.pictures.losses import picture_losses
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.base import untrained_rule
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive
from npa_envs.tasks.damage import hurt, stray_motion
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.targets.points import PointTarget, load_target
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.world.randomness import Randomness


@dataclass(frozen=True, kw_only=True)
class Morphogenesis2DConfig:
    """2D morphogenesis: a disk of blank particles grows into a picture (arXiv 2601.16096).

    The defaults are the paper's. Lengths are in length units: the target's picture spans
    [-1, 1] x [-1, 1].
    """

    target: str = "gecko"
    """What to grow: a built-in name, an emoji, or the path of a PNG, JPEG or WebP file."""

    target_point_count: int = 4096
    """About how many opaque pixels the target is resampled to; as many as there are particles."""

    particle_count: int = 4096
    """Particles in a world, N."""

    state_dim: int = 16
    """State channels of a particle, C; the last three are its colour (less 0.5)."""

    hidden_dim: int = 128
    """Width of the rule's hidden layer."""

    eps: float = 0.1
    """Perception radius ε [length units]; the rule is trained at it, so it is also its ε0."""

    alpha: float = 0.5
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    update_prob: float = 0.5
    """Probability p that a particle is updated in a step (dimensionless)."""

    seed_radius: float = 0.2
    """Radius of the disk that the particles start in [length units]."""

    damage_radius: float = 0.1
    """Radius of the disk whose state is erased in worlds from the pool [length units]; 0: none."""

    clump_radius: float = 0.0
    """Radius of the disk whose particles are pulled to one point, in a quarter of the worlds from
    the pool [length units]; 0: none."""

    cut_gap: float = 0.0
    """Width of the slit through a quarter of the worlds from the pool [length units]; 0: none."""

    flake_radius: float = 0.0
    """Radius up to which a disk of particles is torn off and thrown out, in a quarter of the worlds
    from the pool [length units]; 0: none."""

    stray_share: float = 0.0
    """Probability of each particle to be thrown out of worlds from the pool (dimensionless)."""

    resolution: int = 256
    """Pixels on each side of the picture that the loss compares, R."""

    sigma: float = 1.0
    """Standard deviation of a particle's splat, in pixels of the target (dimensionless)."""

    splat_weight: float = 2.0
    """Weight of the splat loss (dimensionless)."""

    colour_weight: float = 5.0
    """Weight of the colour term against the density term inside the splat loss (dimensionless)."""

    motion_weight: float = 0.01
    """Weight of the path length Σ|Δx| of a rollout (per length unit)."""

    overflow_weight: float = 100.0
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    bound_weight: float = 100.0
    """Weight of mean |x − clip(x, −1, 1)| (per length unit)."""

    stray_weight: float = 0.0
    """Weight of the mean path length of particles outside of [−1, 1] (per length unit)."""

    drift_weight: float = 0.0
    """Weight of the centroids' distance from the origin, where worlds begin (per length unit)."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        if not isinstance(self.target, str) or not self.target:
            raise NPAError(
                f"target must be a built-in name, an emoji or a path, got {self.target!r}: "
                "for example target='gecko'"
            )
        check_positive(self, int, "target_point_count", "particle_count", "hidden_dim")
        check_positive(self, float, "eps", "alpha", "seed_radius", "sigma")
        check_fraction(self, "update_prob")
        check_non_negative(
            self,
            "damage_radius",
            "clump_radius",
            "cut_gap",
            "flake_radius",
            "stray_share",
            "stray_weight",
            "drift_weight",
            "splat_weight",
            "colour_weight",
            "motion_weight",
            "overflow_weight",
            "bound_weight",
        )
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=8)

    def with_particle_count(self, particle_count: int) -> Morphogenesis2DConfig:
        """Return the same task with another number of particles, and of the target's points."""
        return replace(self, particle_count=particle_count, target_point_count=particle_count)


# 2D morphogenesis: a disk of blank particles grows into a picture, and heals.


UNOWNED = 0.05
"""Density that belongs to nobody when a pixel's error is shared out among particles."""


def _growth(difference: Tensor) -> Tensor:
    """|d| + d^2 of every pixel: linear near the goal, quadratic far from it."""
    size = difference.abs()
    return size + size * size


def _pixel_mean(errors: Tensor) -> Tensor:
    return world_mean(errors.flatten(1)[..., None])[:, 0]


Morphogenesis2DTrainConfig = TrainConfig[Morphogenesis2DConfig]
"""A training run of 2D morphogenesis."""


class Morphogenesis2D:
    """The task of arXiv 2601.16096, section 4.1, with its loss; satisfies `PictureTask`.

    Args:
        config: Target, world, rule size and loss weights.
        target: The target, where it is at hand already; by default `config.target` is loaded.
        device: Where the target's picture is kept and worlds are compared with it.

    Raises:
        NPAError: The target cannot be loaded.
    """

    def __init__(
        self,
        config: Morphogenesis2DConfig | None = None,
        *,
        target: PointTarget | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config or Morphogenesis2DConfig()
        if target is None:
            target = load_target(self.config.target, point_count=self.config.target_point_count)
        self.target = target.to(device)
        """What is to be grown."""
        self._target_mean = self.target.points.mean(dim=0)
        self.target_picture = self._splat(self.target.points[None], self.target.colours[None])[0]
        """Its picture: rgb sums and density, dimensionless, shape [R, R, 4]."""

    @property
    def eps(self) -> float:
        """Perception radius [length units]."""
        return self.config.eps

    @property
    def box(self) -> None:
        """Open space."""
        return None

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step, dimensionless."""
        return self.config.update_prob

    @property
    def metric_name(self) -> str:
        """The splat loss."""
        return "splat loss"

    @property
    def aligned(self) -> bool:
        """The picture is moved onto the target's place and compared pixel by pixel."""
        return True

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU; its weights are drawn from `generator`."""
        return untrained_rule(
            generator,
            state_dim=self.config.state_dim,
            hidden_dim=self.config.hidden_dim,
            eps0=self.config.eps,
            alpha=self.config.alpha,
        )

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> tuple[Tensor, Tensor]:
        """Return fresh worlds: particles uniform in a disk around the origin, all states zero.

        Args:
            world_count: Worlds B.
            generator: Source of the positions, on `device`.
            device: Where the worlds are made.

        Returns:
            Positions [length units], shape [B, N, 2]; states, dimensionless, shape [B, N, C].
        """
        count = self.config.particle_count
        x = uniform_ball(
            world_count, count, 2, self.config.seed_radius, generator=generator, device=device
        )
        return x, x.new_zeros(world_count, count, self.config.state_dim)

    def damage(self, x: Tensor, s: Tensor, generator: Randomness) -> tuple[Tensor, Tensor]:
        """Return the worlds with states in a disk erased, and some particles thrown out."""
        return hurt(x, s, self.config, generator=generator)

    def picture(self, x: Tensor, s: Tensor, *, centred: bool = True) -> Tensor:
        """Return the picture of each world.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
            centred: Move each world's mean to the target's, as the loss does.

        Returns:
            Colour sums and density, dimensionless, shape [B, R, R, 4].
        """
        return self._splat(self._centred(x) if centred else x, s[..., -3:] + COLOUR_OFFSET)

    def splat_errors(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each pixel's density error and colour error, dimensionless, shape [B, R, R] each.

        Both are |d| + d^2 between the centred picture and the target's, the second averaged over
        the colours. The colour error is weighted by exp(-(density error)), without gradient:
        colours count where there is something to colour. World k's errors are the same, bit for
        bit, in every batch.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
        """
        difference = self.picture(x, s) - self.target_picture.to(x)
        density = _growth(difference[..., 3])
        # Added one by one: the order of torch's own sums is not promised.
        red, green, blue = _growth(difference[..., :3]).unbind(dim=-1)
        colour = (red + green + blue) / 3.0
        return density, colour * torch.exp(-density.detach())

    def splat_losses(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each world's density loss and colour loss, dimensionless, shape [B] each.

        They are the means of `splat_errors` over the pixels; its arguments. Where no gradient is
        asked for, no picture is kept.
        """
        if not (torch.is_grad_enabled() and (x.requires_grad or s.requires_grad)):
            return picture_losses(
                x,
                s,
                self.target_picture,
                goal=self._target_mean,
                shift=COLOUR_OFFSET,
                pixel_size=self.target.pixel_size,
                sigma=self.config.sigma,
            )
        density, colour = self.splat_errors(x, s)
        return _pixel_mean(density), _pixel_mean(colour)

    def particle_shares(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's share of its world's splat loss, times N; [B, N].

        A pixel's error is shared out among the particles that cover it, by their weights there;
        what no particle covers is shared by all alike. The mean over the particles is `metric`, up
        to rounding.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
        """
        with torch.no_grad():
            density, colour = self.splat_errors(x, s)
            errors = density + self.config.colour_weight * colour
        blank = x.new_zeros(*x.shape[:2], 3).requires_grad_()
        with torch.enable_grad():
            picture = self._splat(self._centred(x.detach()), blank)
            owned = errors / (picture[..., 3].detach() + UNOWNED)
            # The picture is linear in the colours: its pull-back sums over a particle's patch.
            (pulled,) = torch.autograd.grad(picture[..., 0], blank, owned)
        pixel_count = self.config.resolution**2
        unowned = _pixel_mean(UNOWNED * owned)
        return pulled[..., 0] * (x.shape[1] / pixel_count) + unowned[:, None]

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's splat loss: density + colour_weight x colour, shape [B]."""
        density, colour = self.splat_losses(x, s)
        return density + self.config.colour_weight * colour

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the training loss and its named parts, unweighted.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
            path_length: How far each particle travelled in the rollout [length units], [B, N].

        Raises:
            NPAError: The shapes do not fit each other.
        """
        if path_length.shape != x.shape[:2]:
            raise NPAError(
                f"path_length must have shape {tuple(x.shape[:2])}, got {tuple(path_length.shape)}"
            )
        config = self.config
        density, colour = (term.mean() for term in self.splat_losses(x, s))
        parts = {
            "density": density,
            "colour": colour,
            "motion": path_length.mean(),
            "overflow": (s - s.clamp(-1.0, 1.0)).abs().mean(),
            "bound": (x - x.clamp(-1.0, 1.0)).abs().mean(),
        }
        total = (
            config.splat_weight * (density + config.colour_weight * colour)
            + config.motion_weight * parts["motion"]
            + config.overflow_weight * parts["overflow"]
            + config.bound_weight * parts["bound"]
        )
        if config.stray_weight > 0.0:
            parts["stray"] = stray_motion(x, path_length)
            total = total + config.stray_weight * parts["stray"]
        if config.drift_weight > 0.0:
            parts["drift"] = world_mean(x).square().sum(dim=-1).add(1e-12).sqrt().mean()
            total = total + config.drift_weight * parts["drift"]
        return total, parts

    def _centred(self, x: Tensor) -> Tensor:
        return x - world_mean(x)[:, None] + self._target_mean.to(x)

    def _splat(self, x: Tensor, colour: Tensor) -> Tensor:
        return splat(
            x,
            colour,
            resolution=self.config.resolution,
            pixel_size=self.target.pixel_size,
            sigma=self.config.sigma,
        )


# Presets of 2D morphogenesis.


_OUT = Path("runs/morphogenesis2d")

MORPHOGENESIS2D_PRESETS: Mapping[str, Morphogenesis2DTrainConfig] = {
    "paper": TrainConfig(task=Morphogenesis2DConfig(), out=_OUT),
    # A few particles that see far, in worlds that start from seeds often: a recognisable gecko
    # after about four minutes on one core (means of 4 worlds: splat loss 0.16 and PSNR 25 dB at
    # step 64, 0.22 and 23 dB at step 1024; with a seed in every sixth batch 0.21 and 0.43).
    "fast": TrainConfig(
        task=Morphogenesis2DConfig(
            target_point_count=512,
            particle_count=512,
            hidden_dim=64,
            eps=0.2,
            seed_radius=0.4,
            resolution=64,
        ),
        iterations=2400,
        repeats=1,
        world_count=2,
        pool_size=32,
        steps=(16, 32),
        learning_rate=2e-3,
        milestones=(1500, 2100),
        seed_interval=2,
        out=_OUT,
        picture_interval=200,
        checkpoint_interval=200,
        tensorboard=False,
    ),
    "tiny": TrainConfig(
        task=Morphogenesis2DConfig(
            target="ring",
            target_point_count=128,
            particle_count=128,
            hidden_dim=32,
            eps=0.3,
            resolution=32,
        ),
        iterations=40,
        repeats=1,
        world_count=2,
        pool_size=8,
        steps=(8, 16),
        learning_rate=5e-3,
        milestones=(30,),
        out=_OUT,
        log_interval=1,
        picture_interval=20,
        checkpoint_interval=20,
        tensorboard=False,
    ),
}
"""2D morphogenesis: `paper` (arXiv 2601.16096), `fast` (minutes on one core), `tiny` (tests)."""
