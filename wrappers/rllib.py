"""Configurations of RLlib for environments by their ids."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from typing import Any

import gymnasium
from gymnasium.spaces import Box, flatten_space
from gymnasium.wrappers.vector import FlattenObservation, TransformAction

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.core.vector import checked_count
from npa_envs.errors import NPAError, importing, shown, suggest
from npa_envs.registration import ALL, SPECIES_SIZES, WORLD_IDS
from npa_envs.wrappers.base import AnyVectorEnv, ParticleRows, vector_env

with importing("Ray", "training with RLlib", "pip install 'npa-envs[rllib]'"):
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    from ray.tune.registry import register_env

MAKERS = {
    name: (module.parallel_env, task)
    for module in (multispecies_v0, particles_v0)
    for name, task in module.ENVIRONMENTS.items()
} | {size.id: (multispecies_v0.parallel_env, size.id) for size in SPECIES_SIZES}
"""Functions that make environments, and their tasks, by the ids of PettingZoo's registry."""

ROW_IDS = tuple(row.id for row in ALL)


def _make_rows(name: str, keywords: dict[str, Any]) -> AnyVectorEnv:
    """Make the vector environment called `name`, with `keywords["num_envs"]` rows, for RLlib."""
    fields = dict(keywords)
    row_count = fields.pop("num_envs")
    if name not in WORLD_IDS:
        return ParticleRows(_worlds(name, row_count // fields["particle_count"], fields))
    # RLlib's networks need flat observations and actions.
    worlds = _worlds(name, row_count, fields)
    space, flat = worlds.single_action_space, FlattenObservation(worlds)
    if not isinstance(space, Box):
        return flat
    return TransformAction(
        flat,
        lambda actions: actions.reshape(-1, *(space.shape or ())),
        single_action_space=flatten_space(space),
    )


def _worlds(name: str, count: int, fields: dict[str, Any]) -> AnyVectorEnv:
    return gymnasium.make_vec(
        name,
        num_envs=count,
        vectorization_mode="vector_entry_point",
        **{"autoreset_mode": "next-step", **fields},
    )


def rllib_config(name: str, *, shared: bool = False, **keywords: Any) -> PPOConfig:
    """Register an environment with RLlib, and return a configuration of PPO for it.

    Every species has its own policy, `species_0` and so on, which all of its particles share if
    particles are the agents, as in `npa/MixingParticles-v0`. If species are the agents,
    observations have two dimensions, for which RLlib has no network: give one yourself. Everything
    else is RLlib's default, which you can change: `rllib_config(...).training(...)`.

    Args:
        name: Id of an environment of several agents, such as `npa/MixingParticles-v0`.
        shared: Whether all agents have one policy, "everyone".
        keywords: Keywords of `parallel_env`.
    """
    _check_id(name, MAKERS, ROW_IDS, "rllib_rows_config")
    make, task = MAKERS[name]
    env = make(task, **keywords)
    _, infos = env.reset(seed=0)
    env.close()
    policies = {
        agent: f"species_{info['species']}" if not shared else "everyone"
        for agent, info in infos.items()
    }
    register_env(name, lambda fields: ParallelPettingZooEnv(make(task, **fields)))
    config: PPOConfig = PPOConfig().environment(name, env_config=keywords)
    config.multi_agent(
        policies=set(policies.values()), policy_mapping_fn=lambda agent, *_, **__: policies[agent]
    )
    return config


def rllib_rows_config(name: str, *, world_count: int = 4, **keywords: Any) -> PPOConfig:
    """Register a Gymnasium environment with RLlib, and return a configuration of PPO for it.

    Particles are the rows of a vector environment, and share one policy. In environments whose
    actions are brushes or codes the rows are worlds instead, with flattened observations and
    actions. Each environment runner steps `world_count` worlds as one batch. Everything else is
    RLlib's default, which you can change: `rllib_rows_config(...).training(...)`. RLlib has an
    object for each row, so hundreds of rows suit it better than many thousands.

    Args:
        name: Gymnasium's id of an environment.
        world_count: Worlds B of each environment runner.
        keywords: Keywords of `gymnasium.make_vec`, for example `particle_count`.
    """
    _check_id(name, ROW_IDS, MAKERS, "rllib_config")
    rows = checked_count("world_count", world_count)
    world = _worlds(name, 1, keywords)
    if name not in WORLD_IDS:
        keywords["particle_count"] = vector_env(world, "rllib_rows_config").config.particle_count
        rows *= keywords["particle_count"]
    world.close()
    register_env(name, partial(_make_rows, name))
    config: PPOConfig = PPOConfig().environment(name, env_config=keywords)
    mode = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    config.env_runners(gym_env_vectorize_mode=mode, num_envs_per_env_runner=rows)
    return config


def _check_id(name: str, known: Collection[str], others: Collection[str], function: str) -> None:
    """Check that an id is `known`; for one of `others` the error advises to call `function`."""
    if name not in known:
        hint = f"take {function} for it; " if name in others else ""
        raise NPAError(f"name must be a known id, got {shown(name)}: {hint}{suggest(name, known)}")
