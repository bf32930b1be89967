"""The table of Gymnasium environments; importing `npa_envs` registers them.

Entry points are strings: torch and Warp are not imported before an environment is made.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import gymnasium


class Registration:
    """An environment to register with Gymnasium, or a variant of another size.

    Args:
        name: Name of the environment: its classes are `nameEnv` and `nameVectorEnv`, in the module
            of the name in snake case.
        max_episode_steps: Steps after which an episode is truncated.
        size: "Small", "Large" or "", which the id has after the name.
        keywords: Keyword arguments of the classes.
    """

    def __init__(self, name: str, max_episode_steps: int, size: str = "", **keywords: Any) -> None:
        self.id = f"npa/{name}{size}-v0"
        self.name, self.size = name, size
        self.module = f"npa_envs.envs.{re.sub('(?<=[a-z])(?=[A-Z])', '_', name).lower()}"
        self.entry_point = f"{self.module}:{name}Env"
        self.vector_entry_point = f"{self.module}:{name}VectorEnv"
        self.max_episode_steps = max_episode_steps
        self.keywords = MappingProxyType(keywords)


ENVIRONMENTS = (
    Registration("Morphogenesis2D", 256),
    Registration("Regeneration2D", 128),
    Registration("Texture", 128),
    Registration("PointClassification", 64),
    Registration("Morphogenesis3D", 128),
    Registration("Pictures2D", 256),
)
"""Environments with an action for each particle. A change of behaviour is a new version of the
id."""

GARDENS = (Registration("Gardener2D", 32), Registration("Shepherd2D", 32))
"""Environments in which a trained rule runs the particles and actions control a few brushes."""

CODED = (Registration("Shapeshifter2D", 64),)
"""Environments in which a rule of many pictures runs the particles and actions are codes."""

SMALL = (
    Registration(
        "Gardener2D", 32, "Small", particle_count=256, push_length=0.1, gust_chance=0.5,
        gust_radius=0.6, blight_chance=0.25,
    ),
    Registration("Shepherd2D", 32, "Small", particle_count=256),
)  # fmt: skip
"""Gardens with few particles; their settings never change under the same version."""

GARDEN_IDS = tuple(garden.id for garden in (*GARDENS, *SMALL))
"""Ids of gardens, of any size."""

_STATES: Mapping[str, Any] = {"state_dim": 4, "state_scale": 0.1}

_FEW: Mapping[str, Any] = {"particle_count": 64, **_STATES, "eps": 0.2}
"""Keywords of all small worlds."""

_SMALL_PICTURE: Mapping[str, Any] = {**_FEW, "colour_weight": 20.0}

SIZES = (
    Registration("Morphogenesis2D", 32, "Small", **_SMALL_PICTURE, target="ring", seed_radius=0.4),
    Registration(
        "Regeneration2D", 24, "Small", **_SMALL_PICTURE, eps0=0.2, target="heart", rule="picture",
        damage="wipe", damage_size=0.4, resolution=32,
    ),
    Registration(
        "Texture", 24, "Small", particle_count=96, **_STATES, eps=0.3, eps0=0.3, target="stripes",
        resolution=32,
    ),
    Registration(
        "PointClassification", 16, "Small", particle_count=64, state_dim=12, state_scale=0.1,
        eps=0.5, eps0=0.5, update_prob=1.0, score="cross_entropy",
    ),
    Registration("Morphogenesis2D", 512, "Large", particle_count=4096, resolution=128),
    Registration("Regeneration2D", 256, "Large", particle_count=4096, resolution=128),
    Registration("Texture", 256, "Large", particle_count=4096, resolution=128),
    Registration("PointClassification", 64, "Large", particle_count=2048),
    Registration("Morphogenesis3D", 256, "Large", particle_count=4096),
)  # fmt: skip
"""Variants with few particles, in which PPO learns within minutes on a laptop, and with many, for a
GPU. Settings never change under the same version."""

_CENTRAL: Mapping[str, Mapping[str, Any]] = {
    "npa/Morphogenesis2DSmall-v0": {},
    "npa/PointClassificationSmall-v0": {"place_count": 1},
}

CENTRAL = tuple(
    Registration(
        row.name, row.max_episode_steps, "CentralSmall", **row.keywords, control="central",
        **_CENTRAL[row.id],
    )
    for row in SIZES
    if row.id in _CENTRAL
)  # fmt: skip
"""Small variants with one controller of few numbers in place of an action for each particle, which
learners take as they are. Settings never change under the same version."""

WORLD_IDS = frozenset((*GARDEN_IDS, *(row.id for row in (*CODED, *CENTRAL))))
"""Ids whose actions are of a whole world, not of particles."""

ALL = (*ENVIRONMENTS, *GARDENS, *CODED, *SMALL, *SIZES, *CENTRAL)
"""All entries that are registered with Gymnasium."""

SPECIES = {
    "npa/Mixing-v0": "mixing",
    "npa/Segregation-v0": "segregation",
    "npa/CoMorphogenesis-v0": "co_morphogenesis",
    "npa/Invasion-v0": "invasion",
    "npa/Symbiosis-v0": "symbiosis",
}
"""Ids for `pettingzoo.make` -> tasks of several species."""

_PERCEIVED: Mapping[str, Any] = {"perception": "per_species", "max_cycles": 32}
_SMALL_SPECIES: Mapping[str, Any] = {**_FEW, "species_count": 2, "eps0": 0.2, **_PERCEIVED}
_SMALL_PICTURES: Mapping[str, Any] = {
    **_SMALL_SPECIES, "colour_weight": 20.0, "resolution": 32, "seed_radius": 0.3,
}  # fmt: skip
_LARGE_SPECIES: Mapping[str, Any] = {"particle_count": 4096, "max_cycles": 256}


class SpeciesRegistration:
    """A small or large variant of a task of several species, for PettingZoo and for batches.

    Args:
        name: Name of the task in its ids, such as "Mixing".
        size: "Small" or "Large", which the id has after the name.
        keywords: Fields of the task's configuration.
    """

    def __init__(self, name: str, size: str, **keywords: Any) -> None:
        self.id = f"npa/{name}{size}-v0"
        self.task = SPECIES[f"npa/{name}-v0"]
        self.max_episode_steps: int = keywords["max_cycles"]
        self.keywords = MappingProxyType(keywords)


SPECIES_SIZES = (
    SpeciesRegistration("Mixing", "Small", **_SMALL_SPECIES),
    SpeciesRegistration("Segregation", "Small", **_SMALL_SPECIES),
    SpeciesRegistration("CoMorphogenesis", "Small", **_SMALL_PICTURES, targets=("heart", "ring")),
    SpeciesRegistration("Symbiosis", "Small", **_SMALL_PICTURES, target="flower"),
    SpeciesRegistration(
        "Invasion", "Small", particle_counts=(64, 32), **_STATES, eps=0.2, **_PERCEIVED,
        colour_weight=20.0, seed_radius=0.4, target="ring", opponent="random",
    ),
    SpeciesRegistration("Mixing", "Large", **_LARGE_SPECIES),
    SpeciesRegistration("Segregation", "Large", **_LARGE_SPECIES),
    SpeciesRegistration("CoMorphogenesis", "Large", **_LARGE_SPECIES, resolution=128),
    SpeciesRegistration("Symbiosis", "Large", **_LARGE_SPECIES, resolution=128),
    SpeciesRegistration(
        "Invasion", "Large", particle_counts=(3072, 1024), max_cycles=256, resolution=128,
        opponent="random",
    ),
)  # fmt: skip
"""Variants of the tasks of several species. The opponent of an invasion is fixed."""


def register_environments() -> None:
    """Register all environments with Gymnasium, except ids that are registered already."""
    for environment in ALL:
        if environment.id not in gymnasium.registry:
            gymnasium.register(
                environment.id,
                entry_point=environment.entry_point,
                vector_entry_point=environment.vector_entry_point,
                max_episode_steps=environment.max_episode_steps,
                kwargs=dict(environment.keywords),
            )
