"""Neural Particle Automata: differentiable SPH particle worlds.

Importing it registers the Gymnasium environments `npa/...`. Names are imported at their first use,
so that the import loads neither torch nor Warp and the command line starts fast.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING, Any

from npa_envs._module_search import extend_path as _extend_path
from npa_envs.registration import register_environments as _register_environments

if TYPE_CHECKING:
    from npa_envs.errors import DivergedError, MissingDependencyError, NPAError
    from npa_envs.ops import (
        PerceptionFields,
        SpeciesFields,
        perceive,
        perceive_species,
        perception_fields,
        species_fields,
        world_mean,
    )
    from npa_envs.rule.files import load_rule, save_rule, shipped_rules
    from npa_envs.rule.rule import NPARule
    from npa_envs.world.divergence import describe_divergence, divergence
    from npa_envs.world.randomness import WorldRandom
    from npa_envs.world.rollout import at_rest, rollout, step
    from npa_envs.world.species import rollout_species

_extend_path(__path__, __file__)
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
    "at_rest",
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

_MODULES = {
    "errors": {"DivergedError", "MissingDependencyError", "NPAError"},
    "rule.files": {"load_rule", "save_rule", "shipped_rules"},
    "rule.rule": {"NPARule"},
    "world.divergence": {"describe_divergence", "divergence"},
    "world.randomness": {"WorldRandom"},
    "world.rollout": {"at_rest", "rollout", "step"},
    "world.species": {"rollout_species"},
}
"""Modules of the public names; all others are in `npa_envs.ops`."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = next((path for path, names in _MODULES.items() if name in names), "ops")
    # Kept, so that only the first use searches.
    value = globals()[name] = getattr(_import_module(f"npa_envs.{module}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__"})
