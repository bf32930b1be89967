"""Configurations of RLlib for environments by their ids."""

from __future__ import annotations

from typing import Any

import gymnasium

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.core.vector import checked_count
from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest
from npa_envs.registration import ENVIRONMENTS, register_environments
from npa_envs.wrappers.particle_rows import ParticleRows

try:
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    from ray.tune.registry import register_env
except ImportError as error:
    raise MissingDependencyError(
        f"training with RLlib needs Ray ({error}): pip install 'npa-envs[rllib]'"
    ) from error

EVERYONE = "everyone"
"""Name of the policy that all species share, where they do."""

MAKERS = {
    name: (module.parallel_env, task)
    for module in (multispecies_v0, particles_v0)
    for name, task in module.ENVIRONMENTS.items()
}
"""Functions that make environments, and their tasks, by the ids of PettingZoo's registry."""


class _Maker:
    """Makes the environment of an id from keywords, as RLlib asks for it."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, keywords: dict[str, Any]) -> ParallelPettingZooEnv:
        make, task = MAKERS[self.name]
        return ParallelPettingZooEnv(make(task, **dict(keywords)))


class _Mapping:
    """Names the policy of an agent."""

    def __init__(self, policies: dict[str, str]) -> None:
        self.policies = policies

    def __call__(self, agent: str, *_: Any, **__: Any) -> str:
        return self.policies[agent]


class _RowMaker:
    """Makes worlds of an id whose particles are so many rows, as RLlib asks for it."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, keywords: dict[str, Any]) -> ParticleRows:
        # In a process of RLlib's this module may be all that was imported.
        register_environments()
        fields = {"autoreset_mode": "next-step", **keywords}
        row_count = fields.pop("num_envs")
        particle_count = fields["particle_count"]
        worlds = gymnasium.make_vec(
            self.name,
            num_envs=row_count // particle_count,
            vectorization_mode="vector_entry_point",
            **fields,
        )
        return ParticleRows(worlds)


def rllib_config(name: str, *, shared: bool = False, **keywords: Any) -> PPOConfig:
    """Register an environment with RLlib, and return a configuration of PPO for it.

    Every species has a policy of its own, `species_0` and so on, which all of its particles share
    where these are the agents, as in `npa/MixingParticles-v0`. Everything else is RLlib's default,
    to be changed as always: `rllib_config(...).training(...)`.

    Args:
        name: An id of PettingZoo's registry.
        shared: All agents have one policy, "everyone".
        keywords: Of `parallel_env`.

    Raises:
        NPAError: There is no such id, or a keyword is wrong.
    """
    if name not in MAKERS:
        raise NPAError(f"name must be a known id, got {shown(name)}: {suggest(name, MAKERS)}")
    make, task = MAKERS[name]
    env = make(task, **keywords)
    _, infos = env.reset(seed=0)
    env.close()
    policies = {
        agent: EVERYONE if shared else f"species_{info['species']}" for agent, info in infos.items()
    }
    register_env(name, _Maker(name))
    config: PPOConfig = (
        PPOConfig()
        .environment(name, env_config=keywords)
        .multi_agent(policies=set(policies.values()), policy_mapping_fn=_Mapping(policies))
    )
    return config


def rllib_rows_config(
    name: str, *, particle_count: int, world_count: int = 4, **keywords: Any
) -> PPOConfig:
    """Register an environment of one species with RLlib, and return a configuration of PPO for it.

    Particles are the rows of a vector environment, and one policy is shared by all of them. Each
    environment runner steps `world_count` worlds as one batch. Everything else is RLlib's default,
    to be changed as always: `rllib_rows_config(...).training(...)`. RLlib keeps an object of its
    own for each row, so hundreds of rows suit it better than many thousands.

    Args:
        name: An id of Gymnasium's registry.
        particle_count: Particles N of a world.
        world_count: Worlds B of an environment runner.
        keywords: Of `gymnasium.make_vec`, for example `max_episode_steps`.

    Raises:
        NPAError: There is no such id, or a keyword is wrong.
    """
    ids = [environment.id for environment in ENVIRONMENTS]
    if name not in ids:
        raise NPAError(f"name must be a known id, got {shown(name)}: {suggest(name, ids)}")
    rows = checked_count("world_count", world_count) * checked_count(
        "particle_count", particle_count
    )
    fields = {"particle_count": particle_count, **keywords}
    make = _RowMaker(name)
    make({"num_envs": particle_count, **fields}).close()
    register_env(name, make)
    config: PPOConfig = (
        PPOConfig()
        .environment(name, env_config=fields)
        .env_runners(
            gym_env_vectorize_mode=gymnasium.VectorizeMode.VECTOR_ENTRY_POINT,
            num_envs_per_env_runner=rows,
        )
    )
    return config
