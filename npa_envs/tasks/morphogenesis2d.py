"""2D morphogenesis: a disk of blank particles grows into a picture, and heals."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.rule import COLOUR_OFFSET, NPARule
from npa_envs.sph import splat
from npa_envs.tasks.damage import erase_state, random_particle
from npa_envs.tasks.morphogenesis2d_config import Morphogenesis2DConfig
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.targets import PointTarget, load_target


def _growth(difference: Tensor) -> Tensor:
    """|d| + d^2 of every pixel: linear near the goal, quadratic far from it."""
    size = difference.abs()
    return size + size * size


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

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU; its weights are drawn from `generator`."""
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
            return NPARule(
                2,
                self.config.state_dim,
                self.config.hidden_dim,
                eps0=self.config.eps,
                alpha=self.config.alpha,
            )

    def seed(
        self, world_count: int, *, generator: torch.Generator, device: str | torch.device = "cpu"
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

    def damage(self, x: Tensor, s: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the worlds with the states in a disk around one random particle set to zero."""
        if self.config.damage_radius == 0.0:
            return x, s
        centre = random_particle(x, generator)
        return x, erase_state(x, s, centre=centre, radius=self.config.damage_radius)

    def picture(self, x: Tensor, s: Tensor, *, centred: bool = True) -> Tensor:
        """Return the picture of each world.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
            centred: Move each world's mean to the target's, as the loss does.

        Returns:
            Colour sums and density, dimensionless, shape [B, R, R, 4].
        """
        if centred:
            x = x - x.mean(dim=1, keepdim=True) + self.target.points.mean(dim=0).to(x)
        return self._splat(x, s[..., -3:] + COLOUR_OFFSET)

    def splat_losses(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return each world's density loss and colour loss, dimensionless, shape [B] each.

        Both are means over pixels (and colours) of |d| + d^2 between the centred picture and the
        target's. The colour loss weighs a pixel by exp(-(its density loss)), without gradient:
        colours count where there is something to colour.
        """
        difference = self.picture(x, s) - self.target_picture.to(x)
        density = _growth(difference[..., 3])
        colour = _growth(difference[..., :3]).mean(dim=-1) * torch.exp(-density.detach())
        return density.mean(dim=(1, 2)), colour.mean(dim=(1, 2))

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
        return total, parts

    def _splat(self, x: Tensor, colour: Tensor) -> Tensor:
        return splat(
            x,
            colour,
            resolution=self.config.resolution,
            pixel_size=self.target.pixel_size,
            sigma=self.config.sigma,
        )
