"""2D morphogenesis: a disk of blank particles grows into a picture, and heals."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import splat, world_mean
from npa_envs.ops.pictures.losses import picture_losses
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.morphogenesis2d_config import Morphogenesis2DConfig
from npa_envs.tasks.pool_damage import hurt
from npa_envs.tasks.rules import untrained_rule
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.strays import stray_motion
from npa_envs.tasks.targets import PointTarget, load_target
from npa_envs.world.randomness import Randomness

UNOWNED = 0.05
"""Density that belongs to nobody when a pixel's error is shared out among particles."""


def _growth(difference: Tensor) -> Tensor:
    """|d| + d^2 of every pixel: linear near the goal, quadratic far from it."""
    size = difference.abs()
    return size + size * size


def _pixel_mean(errors: Tensor) -> Tensor:
    return world_mean(errors.flatten(1)[..., None])[:, 0]


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
