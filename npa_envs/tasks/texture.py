"""What the texture task can be told: the target, the world, the rule's size, the loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import periodic_splat, world_mean
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.base import untrained_rule
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive, is_whole
from npa_envs.tasks.damage import erase_state, random_particle
from npa_envs.tasks.losses.texture import (
    DEFAULT_LOSS,
    LossOptions,
    TextureLoss,
    check_loss_name,
    make_texture_loss,
)
from npa_envs.tasks.seeds import uniform_box
from npa_envs.tasks.targets.textures import TextureTarget, load_texture
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.world.randomness import Randomness


@dataclass(frozen=True, kw_only=True)
class TextureConfig:
    """Particles all over a periodic box arrange themselves to a texture (arXiv 2601.16096).

    The defaults are the paper's, but for the loss, which needs no download. Lengths are in length
    units.
    """

    target: str = "cells"
    """The texture: a built-in name, or the path of a PNG, JPEG or WebP file."""

    target_tiles: bool = False
    """Whether the opposite edges of a picture file fit together; built-in textures tile."""

    loss: str = DEFAULT_LOSS
    """How textures are compared: "patch_swd", "filter_swd", or the paper's "vgg_ot"."""

    loss_seed: int = 0
    """What the loss draws its directions, filters and positions from, once."""

    vgg_weights: str = ""
    """File of VGG16's weights for "vgg_ot"; empty: torch's usual folder of downloads."""

    particle_count: int = 4096
    """Particles in a world, N."""

    state_dim: int = 16
    """State channels of a particle, C; the last three are its colour (less 0.5)."""

    hidden_dim: int = 128
    """Width of the rule's hidden layer."""

    eps: float = 0.2
    """Perception radius ε [length units]; the rule is trained at it, so it is also its ε0."""

    alpha: float = 0.5
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    update_prob: float = 0.5
    """Probability p that a particle is updated in a step (dimensionless)."""

    box_size: float = 2.0
    """Side of the periodic box around the origin, which the target fills [length units]."""

    damage_radius: float = 0.1
    """Radius of the disk whose state is erased in worlds from the pool [length units]; 0: none."""

    resolution: int = 128
    """Pixels on each side of the pictures that the loss compares, R."""

    sigma: float = 0.7
    """Standard deviation of a particle's splat, in distances between particles (dimensionless)."""

    colour_weight: float = 1.0
    """Weight of the texture loss of the colour image (dimensionless)."""

    density_weight: float = 1.0
    """Weight of the texture loss of the density image (dimensionless)."""

    motion_weight: float = 0.1
    """Weight of the path length Σ|Δx| of a rollout (per length unit)."""

    overflow_weight: float = 100.0
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        if not isinstance(self.target, str) or not self.target:
            raise NPAError(
                f"target must be a built-in texture or a path, got {self.target!r}: "
                "for example target='cells'"
            )
        check_loss_name(self.loss)
        if not is_whole(self.loss_seed) or not 0 <= self.loss_seed < 2**63:
            raise NPAError(
                f"loss_seed must be a whole number of at least 0 and below 2**63, got "
                f"{self.loss_seed!r}: for example loss_seed=0"
            )
        if not isinstance(self.vgg_weights, str):
            raise NPAError(f"vgg_weights must be a path as a string, got {self.vgg_weights!r}")
        check_positive(self, int, "particle_count", "hidden_dim")
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=12)
        check_positive(self, float, "eps", "alpha", "box_size", "sigma")
        check_fraction(self, "update_prob")
        check_non_negative(
            self,
            "damage_radius",
            "colour_weight",
            "density_weight",
            "motion_weight",
            "overflow_weight",
        )
        if self.box_size < 2.0 * self.eps:
            raise NPAError(
                f"box_size must be at least 2 eps = {2.0 * self.eps:g}, got {self.box_size}: "
                "enlarge the box or perceive at a smaller eps"
            )

    def with_particle_count(self, particle_count: int) -> TextureConfig:
        """Return the same task with another number of particles."""
        return replace(self, particle_count=particle_count)


# Textures: particles all over a periodic box arrange and colour themselves like a target.


DENSITY_FLOOR = 1e-6
"""Density that empty places count as, so that the power has a slope there."""

DENSITY_POWER = 0.1
"""Power that densities are compared in: what is empty differs most from what is not."""


class Texture:
    """The texture task of arXiv 2601.16096, with its loss; satisfies `PictureTask`.

    Args:
        config: Target, world, rule size and loss.
        target: The target, where it is at hand already; by default `config.target` is loaded.
        device: Where the target is kept and worlds are compared with it.

    Raises:
        NPAError: The target cannot be loaded.
    """

    def __init__(
        self,
        config: TextureConfig | None = None,
        *,
        target: TextureTarget | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config = config or TextureConfig()
        if target is None:
            target = load_texture(
                config.target,
                resolution=config.resolution,
                tiles=config.target_tiles,
                device=device,
            )
        if target.picture.shape != (config.resolution, config.resolution, 4):
            raise NPAError(
                f"target must have {config.resolution} x {config.resolution} pixels as "
                f"config.resolution says, got {tuple(target.picture.shape)}: load it at that size"
            )
        self.target = target
        """What worlds are to look like."""
        self.target_picture = target.picture.to(device)
        """Its picture: colour sums and density, dimensionless, shape [R, R, 4]."""
        self.pixel_size: float = config.box_size * (target.coverage / config.particle_count) ** 0.5
        """Side of the square that a particle fills [length units]: all together have the target's
        mean density."""

    @property
    def eps(self) -> float:
        """Perception radius [length units]."""
        return self.config.eps

    @property
    def box(self) -> tuple[float, float]:
        """Sides of the periodic box [length units]."""
        return (self.config.box_size, self.config.box_size)

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step, dimensionless."""
        return self.config.update_prob

    @property
    def metric_name(self) -> str:
        """The texture loss that worlds are measured by."""
        return self.config.loss

    @property
    def aligned(self) -> bool:
        """A texture may lie anywhere: pixels are not compared one by one."""
        return False

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
        """Return fresh worlds: particles uniform in the box, all states zero.

        Args:
            world_count: Worlds B.
            generator: Source of the positions, on `device`.
            device: Where the worlds are made.

        Returns:
            Positions [length units], shape [B, N, 2]; states, dimensionless, shape [B, N, C].
        """
        count = self.config.particle_count
        x = uniform_box(world_count, count, self.box, generator=generator, device=device)
        return x, x.new_zeros(world_count, count, self.config.state_dim)

    def damage(self, x: Tensor, s: Tensor, generator: Randomness) -> tuple[Tensor, Tensor]:
        """Return the worlds with the states in a disk around one random particle set to zero."""
        if self.config.damage_radius == 0.0:
            return x, s
        side = self.config.box_size
        away = x - random_particle(x, generator)[:, None]
        away = away - side * (away / side).round()
        centre = torch.zeros_like(away[:, 0])
        return x, erase_state(away, s, centre=centre, radius=self.config.damage_radius)

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the picture of each world: colour sums and density, shape [B, R, R, 4].

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
        """
        return self._splat(x, s[..., -3:] + COLOUR_OFFSET)

    def texture_losses(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each world's loss of the colour image and of the density image, shape [B] each.

        Losses that look at some places only see each world as its first particle does, in the
        middle: which places these are then differs from world to world and from step to step.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].

        Raises:
            NPAError: The loss needs weights that are missing.
        """
        return self._compare(self.picture(x - x[:, :1].detach(), s))

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's texture loss, colour and density weighted, shape [B]."""
        return self._weighted(*self.texture_losses(x, s))

    def particle_shares(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's share of its world's texture loss, times N; [B, N].

        To first order, the loss changes by some amount with what a particle adds to the picture.
        Its share is the loss plus N times the amount by which it does worse there than the mean of
        all; so the mean of the shares is `metric`, up to rounding.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
        """
        x, s = x.detach(), s.detach()
        x = x - x[:, :1]
        blank = s.new_zeros(*s.shape[:2], 3).requires_grad_()
        with torch.enable_grad():
            picture = self.picture(x, s).requires_grad_()
            loss = self._weighted(*self._compare(picture))
            (slope,) = torch.autograd.grad(loss.sum(), picture)
            # The picture is linear in the colours: its pull-back sums over a particle's patch.
            drawn = self._splat(x, blank)
            (pulled,) = torch.autograd.grad(drawn, blank, slope, retain_graph=True)
            by_density = torch.zeros_like(slope)
            by_density[..., 0] = slope[..., 3]
            (density,) = torch.autograd.grad(drawn, blank, by_density)
        red, green, blue = ((s[..., -3:] + COLOUR_OFFSET) * pulled).unbind(dim=-1)
        amounts = (red + green + blue + density[..., 0])[..., None]
        worse = amounts - world_mean(amounts)[:, None]
        return loss.detach()[:, None] + x.shape[1] * worse[..., 0]

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the training loss and its named parts, unweighted.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
            path_length: How far each particle travelled in the rollout [length units], [B, N].

        Raises:
            NPAError: The shapes do not fit each other, or the loss needs weights that are missing.
        """
        if path_length.shape != x.shape[:2]:
            raise NPAError(
                f"path_length must have shape {tuple(x.shape[:2])}, got {tuple(path_length.shape)}"
            )
        config = self.config
        colour, density = (term.mean() for term in self.texture_losses(x, s))
        parts = {
            "colour": colour,
            "density": density,
            "motion": path_length.mean(),
            "overflow": (s - s.clamp(-1.0, 1.0)).abs().mean(),
        }
        total = (
            self._weighted(colour, density)
            + config.motion_weight * parts["motion"]
            + config.overflow_weight * parts["overflow"]
        )
        return total, parts

    def _splat(self, x: Tensor, colour: Tensor) -> Tensor:
        half = 0.5 * self.config.box_size
        return periodic_splat(
            x,
            colour,
            resolution=self.config.resolution,
            pixel_size=self.pixel_size,
            sigma=self.config.sigma,
            lo=-half,
            hi=half,
        )

    def _compare(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        compare_colours, compare_densities = self._losses
        channels = picture.movedim(-1, 1)
        # One by one: the end of a tensor, which lies elsewhere in other batches, rounds otherwise.
        density = torch.stack([density_image(world) for world in channels[:, 3:]])
        return compare_colours(colour_image(channels)), compare_densities(density)

    def _weighted(self, colour: Tensor, density: Tensor) -> Tensor:
        return self.config.colour_weight * colour + self.config.density_weight * density

    @cached_property
    def _losses(self) -> tuple[TextureLoss, TextureLoss]:
        # Made when first asked for: pictures can be drawn without weights.
        config = self.config
        options = LossOptions(self.target.tiles, config.loss_seed, config.vgg_weights)
        target = self.target_picture.movedim(-1, 0)
        return (
            make_texture_loss(config.loss, colour_image(target), options),
            make_texture_loss(config.loss, density_image(target[3:]), options),
        )


def colour_image(channels: Tensor) -> Tensor:
    """Return colours as they are compared, and shown: where particles overlap, their mean.

    Args:
        channels: Colour sums and density, dimensionless, shape [..., 4, R, R].

    Returns:
        Red, green and blue, shape [..., 3, R, R]; black where nothing is.
    """
    sums, density = channels[..., :3, :, :], channels[..., 3:, :, :]
    return sums / density.clamp_min(1.0)


def density_image(density: Tensor) -> Tensor:
    """Return densities as they are compared: (D + 1e-6) to the power of 0.1 (dimensionless)."""
    return (density + DENSITY_FLOOR) ** DENSITY_POWER


# Presets of textures.


_OUT = Path("runs/texture")

_PAPER_TEXTURE: TrainConfig[TextureConfig] = TrainConfig(
    task=TextureConfig(loss="vgg_ot"),
    iterations=12_000,
    repeats=1,
    steps=(16, 32),
    learning_rate=1e-4,
    weight_decay=0.1,
    milestones=(3_000, 6_000, 9_000),
    out=_OUT,
)

TEXTURE_PRESETS: Mapping[str, TrainConfig[TextureConfig]] = {
    "paper": _PAPER_TEXTURE,
    # Dots of both colours after some three minutes on one core.
    "fast": TrainConfig(
        task=TextureConfig(
            target="dots", particle_count=1024, hidden_dim=64, resolution=64, damage_radius=0.2
        ),
        iterations=1200,
        repeats=1,
        world_count=2,
        pool_size=32,
        steps=(12, 24),
        learning_rate=2e-3,
        milestones=(800, 1050),
        seed_interval=4,
        out=_OUT,
        picture_interval=100,
        checkpoint_interval=200,
        tensorboard=False,
    ),
    "tiny": TrainConfig(
        task=TextureConfig(
            target="dots", particle_count=256, hidden_dim=32, eps=0.3, resolution=24
        ),
        iterations=60,
        repeats=1,
        world_count=2,
        pool_size=8,
        steps=(8, 16),
        learning_rate=5e-3,
        milestones=(45,),
        seed_interval=4,
        out=_OUT,
        log_interval=1,
        picture_interval=20,
        checkpoint_interval=20,
        tensorboard=False,
    ),
}
"""Textures: `paper` (arXiv 2601.16096, needs VGG16's weights), `fast` (on one core), `tiny`."""
