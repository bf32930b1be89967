"""Observation and action spaces, by the numbers of a world."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from npa_envs.world.actions import Physics


def observation_space(physics: Physics, particle_count: int) -> Box:
    """Return the space of a world's observations: float32, shape [N, P], ± the perception limit.

    Args:
        physics: The world's constants.
        particle_count: Particles N.
    """
    limit = physics.perception_limit
    return Box(-limit, limit, (particle_count, physics.perception_dim), np.float32)


def action_space(physics: Physics, particle_count: int) -> Box:
    """Return the space of a world's actions: float32, shape [N, A], in [-1, 1].

    Args:
        physics: The world's constants.
        particle_count: Particles N.
    """
    return Box(-1.0, 1.0, (particle_count, physics.action_dim), np.float32)
