"""Particles as agents, the way PettingZoo has it: `parallel_env`, `env` and `raw_env`.

Importing this module registers `npa/MixingParticles-v0` and its like with PettingZoo (1.27 or
newer).
"""

from __future__ import annotations

from typing import Any

from npa_envs.envs.multi.config import plain
from npa_envs.envs.multi.parallel import ParticlesEnv
from npa_envs.envs.multi.pettingzoo import aec_env, clipped, register

ENVIRONMENTS = {
    "npa/MixingParticles-v0": "mixing",
    "npa/SegregationParticles-v0": "segregation",
    "npa/CoMorphogenesisParticles-v0": "co_morphogenesis",
    "npa/InvasionParticles-v0": "invasion",
    "npa/SymbiosisParticles-v0": "symbiosis",
}
"""Tasks by the ids that `pettingzoo.make` takes."""

PARTICLE_COUNT = 64
"""Particles by default."""


def parallel_env(task: str = "mixing", species_count: int = 2, **config: Any) -> ParticlesEnv:
    """Return an environment in which all particles act at once.

    Args:
        task: "mixing", "segregation", "co_morphogenesis", "invasion" or "symbiosis".
        species_count: Species K; `info["species"]` tells each particle's.
        config: Fields of the task's configuration; `particle_count` is 64 unless given, and 512 at
            most.

    Raises:
        NPAError: A name is unknown, or a value wrong.
    """
    if not plain(config.get("particle_counts")):
        config.setdefault("particle_count", PARTICLE_COUNT)
    return ParticlesEnv(task, species_count=species_count, **config)


def raw_env(task: str = "mixing", species_count: int = 2, **config: Any) -> Any:
    """Return an environment in which particles act in turn, and the world after the last of them.

    Args:
        task: As for `parallel_env`.
        species_count: As for `parallel_env`.
        config: As for `parallel_env`.

    Raises:
        NPAError: As `parallel_env`.
    """
    return aec_env(parallel_env(task, species_count, **config))


def env(task: str = "mixing", species_count: int = 2, **config: Any) -> Any:
    """Return `raw_env` with actions clipped into their spaces.

    Args:
        task: As for `parallel_env`.
        species_count: As for `parallel_env`.
        config: As for `parallel_env`.

    Raises:
        NPAError: As `parallel_env`.
    """
    return clipped(raw_env(task, species_count, **config))


for _id, _task in ENVIRONMENTS.items():
    register(_id, __name__, {"task": _task})
