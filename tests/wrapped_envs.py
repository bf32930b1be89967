"""Small environments for tests of wrappers, and a deterministic policy for them."""

import gymnasium as gym
import numpy as np
import torch

import npa_envs  # noqa: F401 (registers the environments)

SMALL = {"particle_count": 64, "eps": 0.3, "resolution": 16}
STEPS = 8
ACTIONS = 18


def single(name="npa/Morphogenesis2D-v0", **keywords):
    rule = {"rule": "picture"} if "Regeneration" in name else {}
    return gym.make(name, **{"max_episode_steps": STEPS, **SMALL, **rule, **keywords})


def batched(count=3, **keywords):
    return gym.make_vec(
        "npa/Morphogenesis2D-v0",
        num_envs=count,
        vectorization_mode="vector_entry_point",
        **{"max_episode_steps": STEPS, **SMALL, **keywords},
    )


def policy(observation):
    """Any deterministic function of each particle's observation."""
    if isinstance(observation, torch.Tensor):
        return torch.clip(3.0 * observation[..., -ACTIONS:] + 0.1, -1.0, 1.0)
    return np.clip(3.0 * observation[..., -ACTIONS:] + 0.1, -1.0, 1.0)
