"""Textures: particles all over a periodic box arrange and colour themselves like a target."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import periodic_splat, world_mean
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.damage import erase_state, random_particle
from npa_envs.tasks.rules import untrained_rule
from npa_envs.tasks.seeds import uniform_box
from npa_envs.tasks.texture_config import TextureConfig
from npa_envs.tasks.texture_losses import LossOptions, TextureLoss, make_texture_loss
from npa_envs.tasks.textures import TextureTarget, load_texture
from npa_envs.world.randomness import Randomness

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
