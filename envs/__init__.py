"""Environments over the engine, imported as `npa_envs.envs`.

`gym.make` and `gym.make_vec` take the ids of `npa_envs.registration`; the names here are for those
who write a task of their own (docs/own_environment.md). No kernels and no physics live here: tasks
say where worlds start and how far they are from the goal, `npa_envs.world.actions` moves the
particles.
"""

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import EnvTask, Start
from npa_envs.envs.core.vector import NPAVectorEnv

__all__ = ["EnvConfig", "EnvTask", "NPAEnv", "NPAVectorEnv", "Start"]
