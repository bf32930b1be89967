"""Species as agents, the way PettingZoo has it: `parallel_env`, `env` and `raw_env`; and `batched`.

Importing this module registers `npa/Mixing-v0` and its like with PettingZoo (1.27 or newer).
"""

from __future__ import annotations

from typing import Any

from npa_envs.envs.multi.parallel import MultiSpeciesEnv
from npa_envs.envs.multi.pettingzoo import aec_env, clipped, register
from npa_envs.envs.multi.tasks.table import ENVIRONMENTS
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv


def parallel_env(task: str = "mixing", species_count: int = 2, **config: Any) -> MultiSpeciesEnv:
    """Return an environment in which all species act at once.

    Args:
        task: "mixing", "segregation", "co_morphogenesis", "invasion" or "symbiosis".
        species_count: Species K: agents `species_0` to `species_{K-1}`.
        config: Fields of the task's configuration; docs/environments/MultiSpecies.md lists them.

    Raises:
        NPAError: A name is unknown, or a value wrong.
    """
    return MultiSpeciesEnv(task, species_count=species_count, **config)


def batched(
    task: str = "mixing",
    species_count: int = 2,
    *,
    world_count: int = 1,
    autoreset_mode: str = "same-step",
    **config: Any,
) -> MultiSpeciesVectorEnv:
    """Return many worlds, stepped together on one device; world k is `parallel_env` by itself.

    Args:
        task: As for `parallel_env`.
        species_count: As for `parallel_env`.
        world_count: Worlds B.
        autoreset_mode: "same-step" or "disabled".
        config: As for `parallel_env`; device="cuda", output="torch" keep all arrays on a GPU.

    Raises:
        NPAError: As `parallel_env`, or the worlds do not fit into memory.
    """
    return MultiSpeciesVectorEnv(
        task,
        species_count=species_count,
        world_count=world_count,
        autoreset_mode=autoreset_mode,
        **config,
    )


def raw_env(task: str = "mixing", species_count: int = 2, **config: Any) -> Any:
    """Return an environment in which species act in turn, and the world after the last of them.

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
