"""Neural Particle Automata: differentiable SPH particle worlds.

Names are imported when they are first used, so that importing the package starts neither torch nor
Warp, and the command line answers at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from npa_envs._checkout import extend_path as _extend_path

if TYPE_CHECKING:
    from npa_envs.dynamics import rollout, step
    from npa_envs.errors import MissingDependencyError, NPAError
    from npa_envs.rule import NPARule
    from npa_envs.rule_io import load_rule, save_rule, shipped_rules
    from npa_envs.sph import PerceptionFields, perceive, perception_fields

_extend_path(__path__, __file__)

__version__ = "0.1.0"

__all__ = [
    "MissingDependencyError",
    "NPAError",
    "NPARule",
    "PerceptionFields",
    "load_rule",
    "perceive",
    "perception_fields",
    "rollout",
    "save_rule",
    "shipped_rules",
    "step",
]

_HOMES = {
    "npa_envs.dynamics": ("rollout", "step"),
    "npa_envs.errors": ("MissingDependencyError", "NPAError"),
    "npa_envs.rule": ("NPARule",),
    "npa_envs.rule_io": ("load_rule", "save_rule", "shipped_rules"),
    "npa_envs.sph": ("PerceptionFields", "perceive", "perception_fields"),
}


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            value = getattr(import_module(module), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
