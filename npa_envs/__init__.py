"""Neural Particle Automata: differentiable SPH particle worlds.

Names are imported when they are first used, so that importing the package starts neither torch nor
Warp, and the command line answers at once.
"""

from typing import TYPE_CHECKING, Any

from npa_envs._checkout import extend_path as _extend_path

if TYPE_CHECKING:
    from npa_envs.api import (
        MissingDependencyError,
        NPAError,
        NPARule,
        PerceptionFields,
        load_rule,
        perceive,
        perception_fields,
        rollout,
        save_rule,
        shipped_rules,
        step,
    )

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


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from npa_envs import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
