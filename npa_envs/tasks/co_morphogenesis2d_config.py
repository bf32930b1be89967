"""What 2D morphogenesis of several species can be told."""

from __future__ import annotations

from dataclasses import dataclass

from npa_envs.errors import NPAError
from npa_envs.tasks.checks import check_non_negative
from npa_envs.tasks.morphogenesis2d_config import Morphogenesis2DConfig


@dataclass(frozen=True, kw_only=True)
class CoMorphogenesis2DConfig:
    """Several pictures that grow in one world, each by a rule of its own."""

    species: tuple[Morphogenesis2DConfig, ...] = (
        Morphogenesis2DConfig(),
        Morphogenesis2DConfig(target="heart"),
    )
    """What each species grows, and of how many particles. All have the same eps, update_prob and
    state_dim."""

    distance: float = 0.0
    """Distance between the centres of neighbouring seeds, which lie in a row [length units]."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: There are fewer than two species, they do not agree, or the distance is wrong.
        """
        species = self.species if isinstance(self.species, tuple | list) else ()
        if len(species) < 2 or not all(isinstance(s, Morphogenesis2DConfig) for s in species):
            came = ", ".join(type(config).__name__ for config in species) or "nothing"
            raise NPAError(
                f"species must hold two Morphogenesis2DConfig or more, got {came}: one for each "
                "species"
            )
        for name in ("eps", "update_prob", "state_dim"):
            values = [getattr(config, name) for config in species]
            if len(set(values)) > 1:
                raise NPAError(f"species must agree in {name}, got {values}: change one of them")
        check_non_negative(self, "distance")

    @property
    def counts(self) -> tuple[int, ...]:
        """Particles of each species."""
        return tuple(config.particle_count for config in self.species)

    @property
    def centres(self) -> tuple[float, ...]:
        """First coordinate of each seed's centre [length units]; their mean is 0."""
        middle = 0.5 * (len(self.species) - 1)
        return tuple(self.distance * (k - middle) for k in range(len(self.species)))
