"""The table of Gymnasium environments; importing `npa_envs` registers them.

Entry points are strings: torch and Warp are not imported before an environment is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium


class Registration(NamedTuple):
    """A row of the table: one environment."""

    id: str
    """Id for `gym.make`."""

    module: str
    """Module of its classes."""

    name: str
    """Name of its classes, without the suffixes `Env` and `VectorEnv`."""

    max_episode_steps: int
    """Steps after which an episode is truncated."""

    keywords: Mapping[str, Any] = MappingProxyType({})
    """Keywords of the classes that differ from their defaults."""

    @property
    def entry_point(self) -> str:
        """Entry point of the environment of one world."""
        return f"{self.module}:{self.name}Env"

    @property
    def vector_entry_point(self) -> str:
        """Entry point of the batched environment."""
        return f"{self.module}:{self.name}VectorEnv"


def _row(name: str, steps: int, size: str = "", **keywords: Any) -> Registration:
    """Return the row of an environment, or of a variant of another size."""
    module = f"npa_envs.envs.{MODULES.get(name, name.lower())}"
    return Registration(f"npa/{name}{size}-v0", module, name, steps, MappingProxyType(keywords))


MODULES = {"PointClassification": "point_classification"}
"""Modules whose names are not those of their classes in lower case."""

ENVIRONMENTS = (
    _row("Morphogenesis2D", 256),
    _row("Regeneration2D", 128),
    _row("Texture", 128),
    _row("PointClassification", 64),
    _row("Morphogenesis3D", 128),
    _row("Pictures2D", 256),
)
"""Environments with an action for each particle. A change of behaviour is a new version of the
id."""

GARDENS = (_row("Gardener2D", 32), _row("Shepherd2D", 32))
"""Environments in which a trained rule runs the particles and actions control a few brushes."""

CODED = (_row("Shapeshifter2D", 64),)
"""Environments in which a rule of many pictures runs the particles and actions are codes."""

_GUSTS = {"push_length": 0.1, "gust_chance": 0.5, "gust_radius": 0.6, "blight_chance": 0.25}

SMALL = (
    _row("Gardener2D", 32, "Small", particle_count=256, **_GUSTS),
    _row("Shepherd2D", 32, "Small", particle_count=256),
)
"""Gardens with few particles; their settings never change under the same version."""


GARDEN_IDS = tuple(
    row.id for row in (*GARDENS, *SMALL) if row.name in {garden.name for garden in GARDENS}
)
"""Ids of gardens, of any size."""


_STATES: Mapping[str, Any] = {"state_dim": 4, "state_scale": 0.1}

_FEW: Mapping[str, Any] = {"particle_count": 64, **_STATES, "eps": 0.2}
"""Keywords of all small worlds."""

_SMALL_PICTURE: Mapping[str, Any] = {**_FEW, "colour_weight": 20.0}

SIZES = (
    _row("Morphogenesis2D", 32, "Small", **_SMALL_PICTURE, target="ring", seed_radius=0.4),
    _row(
        "Regeneration2D", 24, "Small", **_SMALL_PICTURE, eps0=0.2, target="heart", rule="picture",
        damage="wipe", damage_size=0.4, resolution=32,
    ),
    _row(
        "Texture", 24, "Small", particle_count=96, **_STATES, eps=0.3, eps0=0.3, target="stripes",
        resolution=32,
    ),
    _row(
        "PointClassification", 16, "Small", particle_count=64, state_dim=12, state_scale=0.1,
        eps=0.5, eps0=0.5, update_prob=1.0, score="cross_entropy",
    ),
    _row("Morphogenesis2D", 512, "Large", particle_count=4096, resolution=128),
    _row("Regeneration2D", 256, "Large", particle_count=4096, resolution=128),
    _row("Texture", 256, "Large", particle_count=4096, resolution=128),
    _row("PointClassification", 64, "Large", particle_count=2048),
    _row("Morphogenesis3D", 256, "Large", particle_count=4096),
)  # fmt: skip
"""Variants with few particles, in which PPO learns within minutes on a laptop, and with many, for a
GPU. Settings never change under the same version."""

ALL = (*ENVIRONMENTS, *GARDENS, *CODED, *SMALL, *SIZES)
"""All rows that are registered with Gymnasium."""


class SpeciesRegistration(NamedTuple):
    """A variant of a task of several species, for PettingZoo and for batches."""

    id: str
    """Id for `pettingzoo.make` and `npa_envs.envs.multispecies_v0.batched`."""

    task: str
    """A name from `npa_envs.envs.multi.TASKS`."""

    keywords: Mapping[str, Any]
    """Fields of the task's configuration."""

    @property
    def max_episode_steps(self) -> int:
        """Steps after which an episode is truncated."""
        steps: int = self.keywords["max_cycles"]
        return steps


SPECIES = {
    "npa/Mixing-v0": "mixing",
    "npa/Segregation-v0": "segregation",
    "npa/CoMorphogenesis-v0": "co_morphogenesis",
    "npa/Invasion-v0": "invasion",
    "npa/Symbiosis-v0": "symbiosis",
}
"""Ids for `pettingzoo.make` -> tasks of several species."""


_PERCEIVED: Mapping[str, Any] = {"perception": "per_species", "max_cycles": 32}
_SPECIES: Mapping[str, Mapping[str, Any]] = {
    "Small": {**_FEW, "species_count": 2, "eps0": 0.2, **_PERCEIVED},
    "Large": {"particle_count": 4096, "max_cycles": 256},
}
_PICTURES: Mapping[str, Mapping[str, Any]] = {
    "Small": {
        **_SPECIES["Small"], "colour_weight": 20.0, "resolution": 32, "seed_radius": 0.3,
    },
    "Large": {**_SPECIES["Large"], "resolution": 128},
}  # fmt: skip
_INVASIONS: Mapping[str, Mapping[str, Any]] = {
    "Small": {
        "particle_counts": (64, 32), **_STATES, "eps": 0.2, **_PERCEIVED, "colour_weight": 20.0,
        "seed_radius": 0.4, "target": "ring", "opponent": "random",
    },
    "Large": {
        "particle_counts": (3072, 1024), "max_cycles": 256, "resolution": 128,
        "opponent": "random",
    },
}  # fmt: skip
_TARGETS: Mapping[str, Mapping[str, Any]] = {
    "CoMorphogenesisSmall": {"targets": ("heart", "ring")},
    "SymbiosisSmall": {"target": "flower"},
}

SPECIES_SIZES = tuple(
    SpeciesRegistration(
        f"npa/{name}{size}-v0",
        SPECIES[f"npa/{name}-v0"],
        MappingProxyType({**keywords[size], **_TARGETS.get(f"{name}{size}", {})}),
    )
    for size in ("Small", "Large")
    for name, keywords in (
        ("Mixing", _SPECIES),
        ("Segregation", _SPECIES),
        ("CoMorphogenesis", _PICTURES),
        ("Symbiosis", _PICTURES),
        ("Invasion", _INVASIONS),
    )
)
"""Variants of the tasks of several species. The opponent of an invasion is fixed."""


def register_environments() -> None:
    """Register the table with Gymnasium; ids that are registered already are skipped."""
    for environment in ALL:
        if environment.id not in gymnasium.registry:
            gymnasium.register(
                environment.id,
                entry_point=environment.entry_point,
                vector_entry_point=environment.vector_entry_point,
                max_episode_steps=environment.max_episode_steps,
                kwargs=dict(environment.keywords),
            )
