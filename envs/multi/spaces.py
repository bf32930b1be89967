"""Spaces of agents that own particles, and of the world as a whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from npa_envs.errors import DivergedError, NPAError
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


# Actions of several agents, checked and laid one after the other.


def joined_actions(
    actions: Any, agents: Sequence[str], shapes: Sequence[tuple[int, ...]], device: torch.device
) -> Tensor:
    """Return the actions of all live agents as rows, float32, shape [N, A] or [B, N, A].

    Args:
        actions: An array or tensor for each live agent.
        agents: Live agents, in the order of their particles.
        shapes: Shape of each one's action, [B, N_k, A], [N_k, A] or [A].
        device: Where the world lives.

    Raises:
        NPAError: There is an action too few or too many, or one has another shape or is no array
            of numbers.
        DivergedError: A number is not finite.
    """
    if not isinstance(actions, Mapping):
        raise NPAError(
            f"actions must be a dict with an action for each live agent, got "
            f"{type(actions).__name__}: see env.agents"
        )
    missing = [agent for agent in agents if agent not in actions]
    if missing:
        raise NPAError(
            f"actions must have one for each live agent, got none for {_names(missing)}: "
            "zeros leave an agent's particles as they are"
        )
    live = set(agents)
    extra = [str(agent) for agent in actions if agent not in live]
    if extra:
        raise NPAError(
            f"actions must be of live agents only, got one for {_names(extra)}: agents that ended "
            "get no more actions until reset; see env.agents"
        )
    rows = [
        _checked(agent, actions[agent], shape) for agent, shape in zip(agents, shapes, strict=True)
    ]
    # What has one row only has no dimension for it.
    blocks = [row if row.ndim > 1 else row[None] for row in rows]
    joined = torch.cat([block.to(device) for block in blocks], dim=-2)
    if not bool(torch.isfinite(joined).all()):
        bad = next(k for k, row in enumerate(rows) if not bool(torch.isfinite(row).all()))
        wrong = rows[bad][~torch.isfinite(rows[bad])]
        raise DivergedError(
            f"actions[{agents[bad]!r}] must be finite, got {wrong[0].item()} ({wrong.numel()} such "
            "numbers): check the policy; the world is as it was"
        )
    return joined


def _checked(agent: str, action: Any, wanted: tuple[int, ...]) -> Tensor:
    try:
        if not isinstance(action, Tensor):
            if np.iscomplexobj(action):
                raise TypeError("complex numbers")
            # Torch cannot read what may not be written.
            action = torch.from_numpy(np.require(action, np.float32, ("C", "W")))
    except (TypeError, ValueError) as error:
        raise NPAError(_rule(agent, wanted, type(action).__name__)) from error
    if tuple(action.shape) != wanted or action.dtype.is_complex:
        raise NPAError(_rule(agent, wanted, f"{tuple(action.shape)} of {action.dtype}"))
    if action.layout != torch.strided or action.is_meta:
        raise NPAError(_rule(agent, wanted, f"a tensor that is {action.layout} on {action.device}"))
    checked: Tensor = action.detach().to(torch.float32)
    return checked


def _rule(agent: str, wanted: tuple[int, ...], came: str) -> str:
    return (
        f"actions[{agent!r}] must be real numbers of shape {wanted}, got {came}: "
        f"see env.action_space({agent!r})"
    )


def _names(agents: Sequence[str]) -> str:
    shown = ", ".join(agents[:3])
    return shown if len(agents) <= 3 else f"{shown} and {len(agents) - 3} more"
