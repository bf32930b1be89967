"""The names that `npa_envs` offers; `npa_envs.__getattr__` imports this on first use."""

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
from npa_envs.world.rollout import rollout, step
from npa_envs.world.species import rollout_species

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
