"""What is taken from Stable-Baselines3, with an error that names the cure where it is missing."""

from __future__ import annotations

from npa_envs.errors import MissingDependencyError

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
except ImportError as error:
    raise MissingDependencyError(
        "this form of PPO needs Stable-Baselines3: pip install 'npa-envs[sb3]'"
    ) from error

__all__ = ["PPO", "ActorCriticPolicy", "BaseCallback", "VecEnv", "VecEnvWrapper"]
