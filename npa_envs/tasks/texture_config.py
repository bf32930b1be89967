"""What the texture task can be told: the target, the world, the rule's size, the loss."""

from __future__ import annotations

from dataclasses import dataclass, replace

from npa_envs.errors import NPAError
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive, is_whole
from npa_envs.tasks.texture_losses import DEFAULT_LOSS, check_loss_name


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
