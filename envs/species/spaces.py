"""Spaces of agents that own particles, and of the world as a whole."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.spaces import Box

from npa_envs.world.actions import Physics


def agent_spaces(
    physics: Physics, perception_dim: int, agents: Sequence[str], rows: Sequence[tuple[int, ...]]
) -> tuple[dict[str, Box], dict[str, Box]]:
    """Return the spaces of agents' observations and actions, float32.

    Args:
        physics: The world's constants.
        perception_dim: Numbers that a particle perceives.
        agents: Their names.
        rows: What comes before the last dimension of each one's arrays: [N_k], or nothing.
    """
    limit = physics.perception_limit
    observations: dict[str, Box] = {}
    actions: dict[str, Box] = {}
    for agent, ahead in zip(agents, rows, strict=True):
        seen, done = (*ahead, perception_dim), (*ahead, physics.action_dim)
        observations[agent] = Box(-limit, limit, seen, np.float32)
        actions[agent] = Box(-1.0, 1.0, done, np.float32)
    return observations, actions


def state_space(physics: Physics, particle_count: int) -> Box:
    """Return the space of [position ; state ; present] of all particles, [N, D + C + 1], float32.

    Args:
        physics: The world's constants.
        particle_count: Particles that an episode starts with, N.
    """
    places = [physics.position_limit] * physics.space_dim
    high = np.array([*places, *[physics.state_limit] * physics.state_dim, 1.0], np.float32)
    low = np.append(-high[:-1], np.float32(0.0))
    shape = (particle_count, 1)
    return Box(np.tile(low, shape), np.tile(high, shape), dtype=np.float32)
