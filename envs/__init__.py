"""Environments over the engine, imported as `npa_envs.envs`.

`gym.make` and `gym.make_vec` take the ids of `npa_envs.registration`; these names are for tasks of
your own (docs/own_environment.md). Tasks say where worlds start and how far they are from the goal;
`npa_envs.world.environment_steps` moves the particles.
"""

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import EnvTask, Start
from npa_envs.envs.core.vector import NPAVectorEnv

__all__ = ["EnvConfig", "EnvTask", "NPAEnv", "NPAVectorEnv", "Start"]
