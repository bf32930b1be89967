"""The texture task: particles in a periodic box arrange and colour themselves like a target."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from npa_envs.checks import (
    check_field,
    check_flag,
    check_non_negative,
    check_positive,
    check_seed,
    check_text,
)
from npa_envs.errors import NPAError
from npa_envs.ops import periodic_splat
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.base import ParticleTask, TaskConfig, contributions_to_loss, distances_moved
from npa_envs.tasks.damage import random_particle
from npa_envs.tasks.losses.texture import (
    DEFAULT_LOSS,
    LossOptions,
    TextureLoss,
    check_loss_name,
    is_joint,
    make_texture_loss,
)
from npa_envs.tasks.seeds import uniform_box
from npa_envs.tasks.targets.textures import TextureTarget, load_texture
from npa_envs.tasks.train_config import Common, TrainConfig, presets_of, tiny_run
from npa_envs.world.brushes import wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness


@dataclass(frozen=True, kw_only=True)
class TextureConfig(TaskConfig):
    """Particles all over a periodic box arrange themselves to a texture (arXiv 2601.16096).

    The defaults are the paper's, but for the loss, which needs no download. Lengths are in length
    units.
    """

    target: Common[str] = "cells"
    """The texture: a built-in name, or the path of a PNG, JPEG or WebP file."""

    target_tiles: bool = False
    """Whether opposite edges of a picture file fit together; those of built-in textures do."""

    loss: Common[str] = DEFAULT_LOSS
    """Loss between textures: a name of `TEXTURE_LOSSES` such as "patch_ot" or the paper's
    "vgg_ot", or the sum of some, such as "patch_ot+joint_swd"."""

    loss_seed: int = 0
    """Seed of the random directions, filters and positions that the loss uses."""

    vgg_weights: str = ""
    """File of VGG16's weights for "vgg_ot"; empty: torch's usual folder of downloads."""

    eps: Common[float] = 0.2
    """Perception radius ε [length units]; the rule is trained at it, so it is also its ε0."""

    see_across: bool = False
    """Raise ε to twice the median gap between neighbouring objects of the target, at most to 0.3,
    so that particles of one object perceive the next."""

    alpha: float = 0.5
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    box_size: float = 2.0
    """Side of the periodic box around the origin, which the target fills [length units]."""

    damage_radius: float = 0.1
    """Radius of the disk whose state is wiped in worlds from the pool [length units]; 0: none."""

    sigma: float = 0.7
    """Standard deviation of a particle's splat, the Gaussian spot that draws it, in distances
    between particles (dimensionless)."""

    colour_weight: float = 1.0
    """Weight of the texture loss of the colour image (dimensionless)."""

    density_weight: float = 1.0
    """Weight of the texture loss of the density image (dimensionless)."""

    motion_weight: float = 0.1
    """Weight of the path length Σ|Δx| of a rollout (per length unit)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_text(self, "target", "a built-in texture or a path")
        check_flag(self, "target_tiles", "see_across")
        check_loss_name(self.loss)
        check_seed(self, "loss_seed")
        is_text = isinstance(self.vgg_weights, str)
        check_field(self, "vgg_weights", is_text, "be a path as a string")
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=12)
        check_positive(self, float, "alpha", "box_size", "sigma")
        check_non_negative(
            self, "damage_radius", "colour_weight", "density_weight", "motion_weight"
        )
        rule = f"be at least 2 eps = {2.0 * self.eps:g}"
        hint = "enlarge the box or perceive at a smaller eps"
        check_field(self, "box_size", self.box_size >= 2.0 * self.eps, rule, hint)


MAX_EPS = 0.3
"""Largest ε that `see_across` sets [length units]."""

DENSITY_FLOOR = 1e-6
"""Added to densities, so that their power has a finite slope at 0."""

DENSITY_POWER = 0.1
"""Power to which compared densities are raised: it separates empty from covered."""

JOINT_POWER = 0.5
"""Power to which densities are raised where they are compared together with colours."""

JITTER = 0.35
"""Largest displacement of points from their lattice in `Texture.drawing`, in lattice spacings."""

DRAWING_COUNT = 16
"""Number of pictures by `Texture.drawing` that `Texture.drawable` averages."""


class Texture(ParticleTask[TextureConfig]):
    """The texture task of arXiv 2601.16096, by any of `TEXTURE_LOSSES`."""

    has_texture_metric = True
    _resized_with = ("target",)

    def __init__(
        self,
        config: TextureConfig | None = None,
        *,
        target: TextureTarget | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        config = config or TextureConfig()
        if target is None:
            target = load_texture(
                config.target, resolution=config.resolution, tiles=config.target_tiles
            )
        if target.picture.shape != (config.resolution, config.resolution, 4):
            raise NPAError(
                f"target must have {config.resolution} x {config.resolution} pixels as "
                f"config.resolution says, got {tuple(target.picture.shape)}: load it at that size"
            )
        target = replace(target, picture=target.picture.to(device))
        if config.see_across:
            across = min(2.0 * target.gap * config.box_size, MAX_EPS, 0.5 * config.box_size)
            config = replace(config, see_across=False, eps=max(config.eps, across))
        self.config = config
        """The configuration; its ε may be raised by `see_across`."""
        self.target = target
        """The target texture."""
        self._target_picture = target.picture
        self.metric_name = config.loss
        weights = config.colour_weight, config.density_weight
        self.weights = (1.0, 1.0) if is_joint(config.loss) else weights
        """Weights of the two `texture_losses`; 1 for a joint loss, which contains the weights."""
        # All particles together have the target's mean density.
        self._pixel_size = config.box_size * (target.coverage / config.particle_count) ** 0.5

    @property
    def box(self) -> tuple[float, float]:
        """Sides of the periodic box [length units]."""
        return (self.config.box_size, self.config.box_size)

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to state_dim, hidden_dim and eps0."""
        return {"alpha": self.config.alpha}

    def places(self, world_count: int, generator: Randomness, device: torch.device) -> Tensor:
        """Return positions uniform in the box."""
        count = self.config.particle_count
        return uniform_box(world_count, count, self.box, generator=generator, device=device)

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds whose states are set to 0 in a disk around one random particle of each."""
        if self.config.damage_radius == 0.0:
            return worlds
        x, s, *_ = worlds
        centre, radius = random_particle(x, generator), self.config.damage_radius
        return worlds._replace(s=wipe_state(x, s, centre=centre, radius=radius, box=self.box))

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's picture: red, green, blue (sums of splats), density, [B, R, R, 4]."""
        return self.splat(x, s[..., -3:] + COLOUR_OFFSET)

    def drawing(self, number: int, *, shifted: bool = True) -> Tensor:
        """Return the target drawn by splats on a jittered lattice, as particles could draw it.

        The picture has shape [1, R, R, 4]. `number` is the seed of the jitter. If `shifted`, it is
        also translated at random across the periodic box.
        """
        side, resolution = self.config.box_size, self.config.resolution
        generator = torch.Generator().manual_seed(number)
        count = max(1, round(side / self.pixel_size))
        axis = (torch.arange(count, dtype=torch.float64) + 0.5) / count
        points = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).flatten(0, 1)
        jitter = torch.rand(points.shape, generator=generator, dtype=torch.float64) - 0.5
        points = (points + 2.0 * JITTER * jitter / count) % 1.0
        column, row = (points * resolution).long().clamp_max(resolution - 1).unbind(1)
        pixels = self.target_picture.double().cpu()[row, column]
        kept = torch.rand(len(pixels), generator=generator, dtype=torch.float64) < pixels[:, 3]
        shift = shifted * torch.rand(2, generator=generator, dtype=torch.float64)
        x = ((points[kept] + shift) % 1.0 - 0.5) * side
        colour = pixels[kept, :3] / pixels[kept, 3:]
        return self.splat(x[None].to(self.target_picture), colour[None].to(self.target_picture))

    @cached_property
    def drawable(self) -> Tensor:
        """The target as sharp as splats can draw it, shape [R, R, 4]: a mean over `drawing`s."""
        drawn = [self.drawing(number, shifted=False) for number in range(DRAWING_COUNT)]
        return torch.cat(drawn).mean(0)

    def texture_losses(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each world's loss of the colour image and of the density image, shape [B] each.

        If the loss is joint, it compares both at once, and the second is 0. Worlds are translated
        so that their first particle is in the middle: losses that sample some positions then sample
        others in each world and step.
        """
        return self.compare_pictures(self.picture(x - x[:, :1].detach(), s))

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's weighted sum of `texture_losses`, shape [B]."""
        return self.weighted(*self.texture_losses(x, s))

    def particle_contributions(self, x: Tensor, s: Tensor) -> Tensor:
        """Return N times each particle's contribution to its world's `metric`, shape [B, N].

        `contributions_to_loss` computes it, with factors on particles' splats.
        """
        x, s = x.detach(), s.detach()
        x = x - x[:, :1]
        blank = s.new_zeros(*s.shape[:2], 3).requires_grad_()
        with torch.enable_grad():
            picture = self.picture(x, s).requires_grad_()
            loss = self.weighted(*self.compare_pictures(picture))
            (slope,) = torch.autograd.grad(loss.sum(), picture)
            # The picture is linear in the colours: its gradient sums over a particle's splat.
            drawn = self.splat(x, blank)
            (pulled,) = torch.autograd.grad(drawn, blank, slope, retain_graph=True)
            by_density = torch.zeros_like(slope)
            by_density[..., 0] = slope[..., 3]
            (density,) = torch.autograd.grad(drawn, blank, by_density)
        red, green, blue = ((s[..., -3:] + COLOUR_OFFSET) * pulled).unbind(dim=-1)
        return contributions_to_loss(loss.detach(), red + green + blue + density[..., 0])

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the batch's weighted texture loss, [], and its terms "colour", "density", []."""
        losses = self.texture_losses(worlds.x, worlds.s)
        colour, density = (term.mean() for term in losses)
        return self.weighted(colour, density), {"colour": colour, "density": density}

    def penalties(self, worlds: Particles) -> dict[str, tuple[float, Tensor]]:
        """Return the penalties of path lengths, "motion", and of states, "overflow"."""
        motion = self.config.motion_weight, distances_moved(worlds).mean()
        return {"motion": motion, **super().penalties(worlds)}

    def splat(self, x: Tensor, colour: Tensor) -> Tensor:
        """Return the pictures [B, R, R, 4] of particles at x [B, N, 2] in colours [B, N, 3]."""
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

    def compare_pictures(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses of pictures' [B, R, R, 4] colours and of their densities, [B] each."""
        compare_colours, compare_densities = self._losses
        channels = picture.movedim(-1, 1)
        if compare_densities is None:
            joint = compare_colours(self.joint_image(channels))
            return joint, torch.zeros_like(joint)
        # World by world: a power rounds otherwise at the end of a tensor.
        density = torch.stack([density_image(world) for world in channels[:, 3:]])
        return compare_colours(colour_image(channels)), compare_densities(density)

    def joint_image(self, channels: Tensor) -> Tensor:
        """Return what joint losses compare: colours and density^0.5, times the weights' roots.

        `channels` of pictures and the result have shape [..., 4, R, R].
        """
        density = (channels[..., 3:, :, :] + DENSITY_FLOOR) ** JOINT_POWER
        colour_scale = self.config.colour_weight**0.5
        density_scale = self.config.density_weight**0.5
        return torch.cat((colour_scale * colour_image(channels), density_scale * density), dim=-3)

    def weighted(self, colour: Tensor, density: Tensor) -> Tensor:
        """Return the sum of both `texture_losses`, each times its weight."""
        colour_weight, density_weight = self.weights
        return colour_weight * colour + density_weight * density

    @cached_property
    def _losses(self) -> tuple[TextureLoss, TextureLoss | None]:
        # Made at the first use: pictures can be drawn without weights.
        config = self.config
        options = LossOptions(self.target.tiles, config.loss_seed, config.vgg_weights)
        if is_joint(config.loss):
            drawable = self.joint_image(self.drawable.movedim(-1, 0))
            return make_texture_loss(config.loss, drawable, options), None
        target = self.target_picture.movedim(-1, 0)
        return (
            make_texture_loss(config.loss, colour_image(target), options),
            make_texture_loss(config.loss, density_image(target[3:]), options),
        )


def colour_image(channels: Tensor) -> Tensor:
    """Return the colours that losses compare, [..., 3, R, R], from a picture's `channels`.

    Where splats overlap, they are means over these.
    """
    sums, density = channels[..., :3, :, :], channels[..., 3:, :, :]
    return sums / density.clamp_min(1.0)


def density_image(density: Tensor) -> Tensor:
    """Return the densities that losses compare: (density + 1e-6)^0.1 (dimensionless)."""
    return (density + DENSITY_FLOOR) ** DENSITY_POWER


# Found by experiment: docs/textures.md. What is learned with 2048 particles holds for more.
_BEST = TrainConfig(
    task=TextureConfig(
        target="hearts", particle_count=2048, see_across=True, loss="patch_ot+joint_swd",
        motion_weight=0.02,
    ),
    iterations=8000, repeats=1, world_count=4, pool_size=64, steps=(24, 32), optimiser="muon",
    learning_rate=3e-3, weight_decay=0.1, schedule="cosine", max_age_range=(64, 8192),
    damage_share=0.5,
)  # fmt: skip

TEXTURE_PRESETS = presets_of(
    "texture",
    paper=TrainConfig(
        task=TextureConfig(loss="vgg_ot"), iterations=12_000, repeats=1, steps=(16, 32),
        learning_rate=1e-4, weight_decay=0.1, milestones=(3_000, 6_000, 9_000),
    ),
    best=_BEST,
    # Three minutes on two cores.
    fast=replace(
        _BEST,
        task=replace(_BEST.task, target="dots", particle_count=1024, hidden_dim=64, resolution=64),
        iterations=600, world_count=2, pool_size=32, picture_interval=100, checkpoint_interval=200,
        tensorboard=False,
    ),
    tiny=tiny_run(
        task=TextureConfig(
            target="dots", particle_count=256, hidden_dim=32, eps=0.3, resolution=24
        ),
        steps=(8, 16), seed_interval=4,
    ),
)  # fmt: skip
"""Textures: `paper` (arXiv 2601.16096, needs VGG16's weights), `best` (any texture, one run of
minutes on a GPU), `fast` (`best` in small, on a CPU), `tiny`."""
