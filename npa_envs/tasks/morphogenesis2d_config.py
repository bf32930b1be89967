"""What 2D morphogenesis can be told: the target, the world, the rule's size, the loss."""

from __future__ import annotations

from dataclasses import dataclass, replace

from npa_envs.errors import NPAError
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive


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
