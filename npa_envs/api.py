"""The names that `npa_envs` offers; `npa_envs.__getattr__` imports this on first use."""

from npa_envs.dynamics import rollout, step
from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.randomness import WorldRandom
from npa_envs.rule import NPARule
from npa_envs.rule_io import load_rule, save_rule, shipped_rules
from npa_envs.sph import PerceptionFields, perceive, perception_fields, world_mean

__all__ = [
    "MissingDependencyError",
    "NPAError",
    "NPARule",
    "PerceptionFields",
    "WorldRandom",
    "load_rule",
    "perceive",
    "perception_fields",
    "rollout",
    "save_rule",
    "shipped_rules",
    "step",
    "world_mean",
]
