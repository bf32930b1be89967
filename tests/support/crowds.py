"""Environments of several species for tests: small configurations, particle positions, actions."""

import functools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from npa_envs.envs import multispecies_v0
from npa_envs.envs.multispecies_v0 import MultiSpeciesEnv

TASKS = ("mixing", "segregation", "co_morphogenesis", "invasion", "symbiosis")
PICTURES = ("co_morphogenesis", "invasion", "symbiosis")


def small(task: str, **keywords: Any) -> dict[str, Any]:
    fields: dict[str, Any] = {"eps": 0.3, "max_cycles": 6, "render_size": 24}
    if "particle_counts" not in keywords:
        fields["particle_count"] = 41
    if task in PICTURES:
        fields["resolution"] = 16
    return {"task": task} | fields | keywords


def few(task: str, **keywords: Any) -> dict[str, Any]:
    """Keywords of a world of nine particles, each of which is an agent."""
    if "particle_counts" not in keywords:
        keywords = {"particle_count": 9} | keywords
    return small(task, **keywords)


def still(env: Any) -> dict[str, Any]:
    return {a: np.zeros(env.action_spaces[a].shape, np.float32) for a in env.agents}


def drawn(env: Any, generator: np.random.Generator) -> dict[str, Any]:
    return {
        a: generator.uniform(-1, 1, env.action_spaces[a].shape).astype(np.float32)
        for a in env.agents
    }


def make(task: str = "mixing", **keywords: Any) -> MultiSpeciesEnv:
    return multispecies_v0.parallel_env(**small(task, **keywords))


def module_of(module: Any, **keywords: Any) -> SimpleNamespace:
    """Return a module's two factories bound to one task, for PettingZoo's own tests."""
    del keywords["max_cycles"]
    return SimpleNamespace(
        parallel_env=functools.partial(module.parallel_env, **keywords),
        env=functools.partial(module.env, **keywords),
    )


def placed(points: Any, task: str = "mixing", **keywords: Any) -> MultiSpeciesEnv:
    """A world with blank particles at some points, in which every action takes effect."""
    env = make(task, **{"update_prob": 1.0, **keywords})
    env.reset(seed=0)
    env.place_particles(points, np.zeros((len(points), 16)))
    return env


def pair(task: str = "mixing", **keywords: Any) -> MultiSpeciesEnv:
    """One particle of each of two species, half a radius apart."""
    return placed([[0.0, 0.0], [0.15, 0.0]], task, particle_counts=(1, 1), **keywords)


def apart(env: MultiSpeciesEnv) -> dict[str, Any]:
    """Actions by which species 1 goes half a radius to the right."""
    actions = still(env)
    actions["species_1"][:, 0] = 1.0
    return actions


def pair_entropy(share: float) -> float:
    """Entropy of two species with shares `share` and the rest, in units of ln 2."""
    rest = 1.0 - share
    return -(share * math.log(share) + rest * math.log(rest)) / math.log(2.0)


# A neighbour at half the radius weighs (1 − 1/4)³ of what a particle weighs for itself.
HALF_WAY = pair_entropy(1.0 / (1.0 + 0.75**3))
