"""Neural Particle Automata: differentiable SPH particle worlds."""

from npa_envs._checkout import extend_path as _extend_path
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
