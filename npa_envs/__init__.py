"""Neural Particle Automata: differentiable SPH particle worlds.

Importing it registers the Gymnasium environments `npa/...`. Names are imported when they are first
used, so that the import starts neither torch nor Warp, and the command line answers at once.
"""

from typing import TYPE_CHECKING, Any

from npa_envs._checkout import extend_path as _extend_path
from npa_envs._moved import keep_old_names as _keep_old_names
from npa_envs.registration import register_environments as _register_environments

if TYPE_CHECKING:
    from npa_envs.api import (
        DivergedError,
        MissingDependencyError,
        NPAError,
        NPARule,
        PerceptionFields,
        SpeciesFields,
        WorldRandom,
        describe_divergence,
        divergence,
        load_rule,
        perceive,
        perceive_species,
        perception_fields,
        rollout,
        rollout_species,
        save_rule,
        shipped_rules,
        species_fields,
        step,
        world_mean,
    )

_extend_path(__path__, __file__)
_keep_old_names()
_register_environments()

__version__ = "0.1.0"

__all__ = [
    "DivergedError",
    "MissingDependencyError",
    "NPAError",
    "NPARule",
    "PerceptionFields",
    "SpeciesFields",
    "WorldRandom",
    "describe_divergence",
    "divergence",
    "load_rule",
    "perceive",
    "perceive_species",
    "perception_fields",
    "rollout",
    "rollout_species",
    "save_rule",
    "shipped_rules",
    "species_fields",
    "step",
    "world_mean",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from npa_envs import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
