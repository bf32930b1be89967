"""The one table of Gymnasium environments; importing `npa_envs` registers them.

Entry points are strings: nothing of torch or Warp is imported before an environment is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium


class Registration(NamedTuple):
    """One environment."""

    id: str
    """What `gym.make` takes."""

    module: str
    """Module of the classes."""

    name: str
    """The single environment's class is this with `Env` behind it, the batched with `VectorEnv`."""

    max_episode_steps: int
    """Steps after which an episode is truncated."""

    keywords: Mapping[str, Any] = MappingProxyType({})
    """Keywords of the classes, where they are not the usual ones."""

    @property
    def entry_point(self) -> str:
        """Where the single environment is."""
        return f"{self.module}:{self.name}Env"

    @property
    def vector_entry_point(self) -> str:
        """Where the batched environment is."""
        return f"{self.module}:{self.name}VectorEnv"


ENVIRONMENTS = (
    Registration("npa/Morphogenesis2D-v0", "npa_envs.envs.morphogenesis2d", "Morphogenesis2D", 256),
    Registration("npa/Regeneration2D-v0", "npa_envs.envs.regeneration2d", "Regeneration2D", 128),
    Registration("npa/Texture-v0", "npa_envs.envs.texture", "Texture", 128),
    Registration(
        "npa/PointClassification-v0",
        "npa_envs.envs.point_classification",
        "PointClassification",
        64,
    ),
    Registration("npa/Morphogenesis3D-v0", "npa_envs.envs.morphogenesis3d", "Morphogenesis3D", 128),
    Registration("npa/Pictures2D-v0", "npa_envs.envs.pictures2d", "Pictures2D", 256),
)
"""Where an action has a row for each particle. A change of behaviour is a new version of the id."""

GARDENS = (
    Registration("npa/Gardener2D-v0", "npa_envs.envs.gardener2d", "Gardener2D", 32),
    Registration("npa/Shepherd2D-v0", "npa_envs.envs.shepherd2d", "Shepherd2D", 32),
)
"""Where a trained rule runs the particles, and an action says what few brushes do."""

CODED = (
    Registration("npa/Shapeshifter2D-v0", "npa_envs.envs.shapeshifter2d", "Shapeshifter2D", 64),
)
"""Where a trained rule of many pictures runs the particles, and an action is a code."""

SMALL = (
    Registration(
        "npa/Gardener2DSmall-v0",
        "npa_envs.envs.gardener2d",
        "Gardener2D",
        32,
        MappingProxyType(
            {
                "particle_count": 256,
                "push_length": 0.1,
                "gust_chance": 0.5,
                "gust_radius": 0.6,
                "blight_chance": 0.25,
            }
        ),
    ),
    Registration(
        "npa/Shepherd2DSmall-v0",
        "npa_envs.envs.shepherd2d",
        "Shepherd2D",
        32,
        MappingProxyType({"particle_count": 256}),
    ),
)
"""Gardens with few particles and few numbers to act by, never changed under the same version."""


GARDEN_IDS = tuple(
    row.id for row in (*GARDENS, *SMALL) if row.name in {garden.name for garden in GARDENS}
)
"""Ids of gardens, of any size."""


_FEW: Mapping[str, Any] = {"particle_count": 64, "state_dim": 4, "state_scale": 0.1, "eps": 0.2}
"""What small worlds have in common."""

_SMALL_PICTURE: Mapping[str, Any] = {**_FEW, "colour_weight": 20.0}

_SMALL_SPECIES: Mapping[str, Any] = {
    **_FEW,
    "species_count": 2,
    "eps0": 0.2,
    "perception": "per_species",
    "max_cycles": 32,
}

_SMALL_INVASION: Mapping[str, Any] = {
    "particle_counts": (64, 32),
    "state_dim": 4,
    "state_scale": 0.1,
    "eps": 0.2,
    "perception": "per_species",
    "max_cycles": 32,
    "colour_weight": 20.0,
    "seed_radius": 0.4,
    "target": "ring",
    "opponent": "random",
}

_SMALL_PICTURE_OF_SPECIES: Mapping[str, Any] = {
    **_SMALL_SPECIES,
    "colour_weight": 20.0,
    "resolution": 32,
    "seed_radius": 0.3,
}


_LARGE_SPECIES: Mapping[str, Any] = {"particle_count": 4096, "max_cycles": 256}

_LARGE_PICTURE_OF_SPECIES: Mapping[str, Any] = {**_LARGE_SPECIES, "resolution": 128}

_LARGE_INVASION: Mapping[str, Any] = {
    "particle_counts": (3072, 1024),
    "max_cycles": 256,
    "resolution": 128,
    "opponent": "random",
}


def _form(name: str, size: str, steps: int, **keywords: Any) -> Registration:
    """Return a form of one of `ENVIRONMENTS` with other keywords."""
    usual = next(row for row in ENVIRONMENTS if row.name == name)
    form_id = usual.id.replace("-v0", f"{size}-v0")
    return Registration(form_id, usual.module, name, steps, MappingProxyType(keywords))


SIZES = (
    _form(
        "Morphogenesis2D",
        "Small",
        32,
        **{**_SMALL_PICTURE, "target": "ring", "seed_radius": 0.4},
    ),
    _form(
        "Regeneration2D",
        "Small",
        24,
        **_SMALL_PICTURE,
        eps0=0.2,
        target="heart",
        rule="picture",
        damage="wipe",
        damage_size=0.4,
        resolution=32,
    ),
    _form(
        "Texture",
        "Small",
        24,
        **{**_FEW, "particle_count": 96, "eps": 0.3},
        eps0=0.3,
        target="stripes",
        resolution=32,
    ),
    _form(
        "PointClassification",
        "Small",
        16,
        **{**_FEW, "state_dim": 12, "eps": 0.5},
        eps0=0.5,
        update_prob=1.0,
        score="cross_entropy",
    ),
    _form("Morphogenesis2D", "Large", 512, particle_count=4096, resolution=128),
    _form("Regeneration2D", "Large", 256, particle_count=4096, resolution=128),
    _form("Texture", "Large", 256, particle_count=4096, resolution=128),
    _form("PointClassification", "Large", 64, particle_count=2048),
    _form("Morphogenesis3D", "Large", 256, particle_count=4096),
)
"""Worlds of few particles, in which PPO learns within minutes on a laptop, and of many, for a GPU.
Settings are never changed under the same version."""

ALL = (*ENVIRONMENTS, *GARDENS, *CODED, *SMALL, *SIZES)
"""All that Gymnasium knows."""


class SpeciesRegistration(NamedTuple):
    """One size of a task of several species, for PettingZoo and for batches."""

    id: str
    """What `pettingzoo.make` and `npa_envs.envs.multispecies_v0.batched` take."""

    task: str
    """A name from `npa_envs.envs.multi.TASKS`."""

    keywords: Mapping[str, Any]
    """Fields of the task's configuration."""

    @property
    def max_episode_steps(self) -> int:
        """Steps after which an episode is cut off."""
        steps: int = self.keywords["max_cycles"]
        return steps


SPECIES = {
    "npa/Mixing-v0": "mixing",
    "npa/Segregation-v0": "segregation",
    "npa/CoMorphogenesis-v0": "co_morphogenesis",
    "npa/Invasion-v0": "invasion",
    "npa/Symbiosis-v0": "symbiosis",
}
"""Tasks of several species by the ids that `pettingzoo.make` takes."""


def _of_species(size: str, name: str, keywords: Mapping[str, Any]) -> SpeciesRegistration:
    usual = f"npa/{name}-v0"
    form_id = usual.replace("-v0", f"{size}-v0")
    return SpeciesRegistration(form_id, SPECIES[usual], MappingProxyType(dict(keywords)))


SPECIES_SIZES = (
    _of_species("Small", "Mixing", _SMALL_SPECIES),
    _of_species("Small", "Segregation", _SMALL_SPECIES),
    _of_species(
        "Small", "CoMorphogenesis", {**_SMALL_PICTURE_OF_SPECIES, "targets": ("heart", "ring")}
    ),
    _of_species("Small", "Symbiosis", {**_SMALL_PICTURE_OF_SPECIES, "target": "flower"}),
    _of_species("Small", "Invasion", _SMALL_INVASION),
    _of_species("Large", "Mixing", _LARGE_SPECIES),
    _of_species("Large", "Segregation", _LARGE_SPECIES),
    _of_species("Large", "CoMorphogenesis", _LARGE_PICTURE_OF_SPECIES),
    _of_species("Large", "Symbiosis", _LARGE_PICTURE_OF_SPECIES),
    _of_species("Large", "Invasion", _LARGE_INVASION),
)
"""The same for tasks of several species. The opponent of an invasion is fixed."""


def register_environments() -> None:
    """Put the table into Gymnasium's registry; what is there already is left as it is."""
    for environment in ALL:
        if environment.id not in gymnasium.registry:
            gymnasium.register(
                environment.id,
                entry_point=environment.entry_point,
                vector_entry_point=environment.vector_entry_point,
                max_episode_steps=environment.max_episode_steps,
                kwargs=dict(environment.keywords),
            )
