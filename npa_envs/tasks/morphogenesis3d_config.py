"""What 3D morphogenesis can be told: target and views, the world, the rule's size, the loss."""

from __future__ import annotations

from dataclasses import dataclass, replace

from npa_envs.errors import NPAError
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive, is_whole


@dataclass(frozen=True, kw_only=True)
class Morphogenesis3DConfig:
    """3D morphogenesis: a ball of blank particles grows into a thing seen from all sides.

    The defaults are the paper's (arXiv 2601.16096) where it is known. Lengths are in length units:
    the target lies within 0.85 of the origin.
    """

    target: str = "mushroom"
    """What to grow: a built-in mesh, a mesh file, or a folder as NeRF-synthetic scenes are."""

    particle_count: int = 16384
    """Particles in a world, N."""

    state_dim: int = 16
    """State channels of a particle, C; the paper also has 24."""

    hidden_dim: int = 256
    """Width of the rule's hidden layer."""

    readout_hidden_dim: int = 256
    """Width of the hidden layer of the read-out, which makes Gaussians of states."""

    eps: float = 0.1
    """Perception radius ε [length units]; the rule is trained at it, so it is also its ε0."""

    alpha: float = 1.0
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    update_prob: float = 0.5
    """Probability p that a particle is updated in a step (dimensionless)."""

    seed_radius: float = 1.0
    """Radius of the ball that the particles start in [length units]."""

    damage_radius: float = 0.0
    """Radius of the ball whose state is erased in worlds from the pool [length units]; 0: none."""

    clump_radius: float = 0.0
    """Radius of the ball whose particles are pulled to one point, in a quarter of the worlds from
    the pool [length units]; 0: none."""

    cut_gap: float = 0.0
    """Width of the slit through a quarter of the worlds from the pool [length units]; 0: none."""

    flake_radius: float = 0.0
    """Radius up to which a ball of particles is torn off and thrown out, in a quarter of the worlds
    from the pool [length units]; 0: none."""

    stray_share: float = 0.0
    """Probability of each particle to be thrown out of worlds from the pool (dimensionless)."""

    resolution: int = 192
    """Pixels on each side of a view, R."""

    training_views: int = 48
    """Views of the target to train with, at most."""

    held_out_views: int = 12
    """Views of the target to measure by, at most; none of them is trained with."""

    views_per_iteration: int = 4
    """Training views that a loss looks at: others in each iteration."""

    view_seed: int = 0
    """What views and backgrounds are drawn from, iteration by iteration."""

    sigma: float = 0.02
    """Standard deviation of a round particle [length units]."""

    anisotropy: float = 0.1
    """Bound of |log(standard deviation / sigma)| along each axis of a particle (dimensionless)."""

    opacity: float = 0.15
    """Opacity of a particle whose read-out is 0, in (0, 1)."""

    blur_sigma: float = 20.0
    """Standard deviation of the blur that targets begin with [pixels]; 0: none."""

    blur_iterations: int = 1000
    """Iterations in which the blur goes, evenly; the paper's share is a twentieth of all."""

    view_weight: float = 2.0
    """Weight of the loss of the views (dimensionless)."""

    ssim_weight: float = 0.2
    """Weight of 1 − MS-SSIM beside the mean absolute difference of views (dimensionless)."""

    isotropy_weight: float = 0.5
    """Weight of mean |log(standard deviation / sigma)| (dimensionless)."""

    motion_weight: float = 0.01
    """Weight of the path length Σ|Δx| of a rollout (per length unit)."""

    overflow_weight: float = 10.0
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    bound_weight: float = 10.0
    """Weight of mean |x − clip(x, −1, 1)| (per length unit)."""

    stray_weight: float = 0.0
    """Weight of the mean path length of particles outside of [−1, 1] (per length unit)."""

    renderer: str = "own"
    """What draws views: "own" kernels, or "gsplat" (CUDA, with `cuda_graph` off)."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        if not isinstance(self.target, str) or not self.target:
            raise NPAError(
                f"target must be a built-in mesh, a mesh file or a folder of views, got "
                f"{self.target!r}: for example target='mushroom'"
            )
        check_positive(self, int, "particle_count", "hidden_dim", "readout_hidden_dim")
        check_positive(self, int, "training_views", "held_out_views", "views_per_iteration")
        check_positive(self, int, "blur_iterations")
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=8)
        check_positive(self, float, "eps", "alpha", "seed_radius", "sigma")
        check_fraction(self, "update_prob", "opacity")
        check_non_negative(
            self,
            "damage_radius",
            "clump_radius",
            "cut_gap",
            "flake_radius",
            "stray_share",
            "stray_weight",
            "anisotropy",
            "blur_sigma",
            "view_weight",
            "ssim_weight",
            "isotropy_weight",
            "motion_weight",
            "overflow_weight",
            "bound_weight",
        )
        if self.opacity == 1.0:
            raise NPAError("opacity must lie below 1, got 1: for example opacity=0.99")
        if not is_whole(self.view_seed) or not 0 <= self.view_seed < 2**31:
            raise NPAError(
                f"view_seed must be a whole number of at least 0 and below 2**31, got "
                f"{self.view_seed!r}: for example view_seed=0"
            )
        # Here and not above: renderers bring the kernels along, which a list of presets needs not.
        if self.renderer not in ("own", "gsplat"):
            raise NPAError(f"renderer must be 'own' or 'gsplat', got {self.renderer!r}")

    def with_particle_count(self, particle_count: int) -> Morphogenesis3DConfig:
        """Return the same task with another number of particles."""
        return replace(self, particle_count=particle_count)
