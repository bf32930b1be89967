"""What the classification of point clouds can be told: data, variation, world, rule's size."""

from __future__ import annotations

from dataclasses import dataclass, replace

from npa_envs.errors import NPAError
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive, is_whole


@dataclass(frozen=True, kw_only=True)
class PointClassificationConfig:
    """Particles that stay where they are agree on what their cloud shows (arXiv 2601.16096).

    The defaults are the paper's, but for the data, which are small. Lengths are in length units;
    a cloud fills about [0, 1]².
    """

    data: str = "digits"
    """The pictures: "digits" (scikit-learn), "mnist" (torchvision), or a folder of IDX files."""

    data_folder: str = "data"
    """Where torchvision keeps "mnist"."""

    class_count: int = 10
    """Classes that there are."""

    sample_seed: int = 0
    """What the places are drawn from that farthest points are chosen among, once."""

    rotation: float = 0.0
    """Fresh clouds are turned by up to this, either way [degrees]."""

    stretch: float = 0.0
    """Fresh clouds are stretched and sheared by up to this share (dimensionless)."""

    jitter: float = 0.0
    """Standard deviation of what is added to fresh clouds' coordinates [length units]."""

    mutated_share: float = 0.0
    """Share of the worlds from the pool that become other clouds, with their states as they are,
    where the run has `damage`."""

    particle_count: int = 512
    """Particles in a world, N: points of a cloud."""

    state_dim: int = 16
    """State channels of a particle, C."""

    hidden_dim: int = 256
    """Width of the rule's hidden layer."""

    readout_hidden_dim: int = 256
    """Width of the hidden layer of the read-out, from states to one number for each class."""

    eps: float = 0.1
    """Perception radius ε [length units]; the rule is trained at it, so it is also its ε0."""

    update_prob: float = 0.5
    """Probability p that a particle is updated in a step (dimensionless)."""

    overflow_weight: float = 1.0
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    resolution: int = 128
    """Pixels on each side of pictures, R."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        for name in ("data", "data_folder"):
            value = getattr(self, name)
            if not isinstance(value, str) or not value:
                raise NPAError(
                    f"{name} must be a name or a path, got {value!r}: for example {name}='digits'"
                )
        if not is_whole(self.sample_seed) or not 0 <= self.sample_seed < 2**63:
            raise NPAError(
                f"sample_seed must be a whole number of at least 0 and below 2**63, got "
                f"{self.sample_seed!r}: for example sample_seed=0"
            )
        check_positive(self, int, "particle_count", "state_dim", "hidden_dim", "readout_hidden_dim")
        check_positive(self, int, "class_count", "resolution", at_least=2)
        check_positive(self, float, "eps")
        check_fraction(self, "update_prob")
        check_non_negative(self, "rotation", "stretch", "jitter", "mutated_share")
        check_non_negative(self, "overflow_weight")
        for name in ("stretch", "mutated_share"):
            if getattr(self, name) > 1.0:
                raise NPAError(f"{name} must be at most 1, got {getattr(self, name)}: try 0.1")

    def with_particle_count(self, particle_count: int) -> PointClassificationConfig:
        """Return the same task with another number of particles: clouds are sampled anew."""
        return replace(self, particle_count=particle_count)
