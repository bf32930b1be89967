"""Small environments for tests of wrappers, and a deterministic policy for them."""

import numpy as np
import torch
from support import small_envs

STEPS = 8
ACTIONS = 18
SIZE = {"particle_count": 64, "max_episode_steps": STEPS}


def single(name="npa/Morphogenesis2D-v0", **keywords):
    return small_envs.make(name, **SIZE | keywords)


def batched(count=3, **keywords):
    return small_envs.make_vec("npa/Morphogenesis2D-v0", count, **SIZE | keywords)


def policy(observation):
    """Any deterministic function of each particle's observation."""
    if isinstance(observation, torch.Tensor):
        return torch.clip(3.0 * observation[..., -ACTIONS:] + 0.1, -1.0, 1.0)
    return np.clip(3.0 * observation[..., -ACTIONS:] + 0.1, -1.0, 1.0)
