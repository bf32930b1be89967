"""Observation and action spaces, by the numbers of a world."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from npa_envs.envs.core.task import Start
from npa_envs.errors import NPAError
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


# Arrays in and out: NumPy or torch on the outside, float32 tensors on the device inside.


def to_output(tensor: Tensor, output: str) -> Any:
    """Return a tensor as it is handed out.

    Args:
        tensor: Anything on the device.
        output: "torch" or "numpy".
    """
    return tensor if output == "torch" else tensor.cpu().numpy()


def checked_action(action: Any, shape: tuple[int, ...], batched: bool) -> Tensor:
    """Return an action as a float32 tensor of shape [B, N, A], on the device where it came from.

    Args:
        action: An array or tensor.
        shape: B, N and A.
        batched: Whether the caller gives the first dimension.

    Raises:
        NPAError: It is no array of numbers, or has another shape.
    """
    wanted = shape if batched else shape[1:]
    letters = "[B, N, A]" if batched else "[N, A]"
    if not isinstance(action, Tensor):
        try:
            if np.iscomplexobj(action):
                raise TypeError("complex numbers")
            # Torch cannot read what may not be written.
            action = torch.from_numpy(np.require(action, np.float32, ("C", "W")))
        except (TypeError, ValueError) as error:
            raise NPAError(
                f"action must be an array of numbers of shape {letters} = {wanted}, "
                f"got {type(action).__name__}: see env.action_space"
            ) from error
    if tuple(action.shape) != wanted:
        raise NPAError(
            f"action must have shape {letters} = {wanted}, got {tuple(action.shape)}: "
            "see env.action_space"
        )
    if action.dtype.is_complex:
        raise NPAError(f"action must be an array of numbers that are real, got {action.dtype}")
    if action.layout != torch.strided or action.device.type == "meta":
        raise NPAError(
            f"action must be a dense array of numbers, got {action.layout} on {action.device}: "
            "convert it with action.to_dense()"
        )
    checked: Tensor = action.detach().to(torch.float32).view(shape)
    return checked


def number_tensor(name: str, value: Any) -> Tensor:
    """Return real numbers of any library as a dense tensor.

    Args:
        name: What the caller calls them.
        value: The numbers.

    Raises:
        NPAError: They are none.
    """
    try:
        tensor = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise NPAError(f"{name} must be an array of numbers, got {type(value).__name__}") from error
    if tensor.dtype.is_complex or tensor.layout != torch.strided or tensor.is_meta:
        raise NPAError(
            f"{name} must be a dense array of real numbers, got {tensor.dtype}, {tensor.layout} on "
            f"{tensor.device}"
        )
    return tensor


def checked_particles(
    x: Any, s: Any, world_count: int, particle_count: int, physics: Physics, device: torch.device
) -> Start:
    """Return particles to be put into worlds, float32 on their device.

    Args:
        x: Positions [length units], shape [M, N, D].
        s: States, dimensionless, shape [M, N, C].
        world_count: Worlds M.
        particle_count: Particles N.
        physics: The worlds' constants.
        device: Where the worlds live.

    Raises:
        NPAError: A shape is another one, or a number is not finite or beyond its limit.
    """
    given = []
    shapes = (
        ("x", x, physics.space_dim, physics.position_limit, "position_limit"),
        ("s", s, physics.state_dim, physics.state_limit, "observation_limit"),
    )
    for name, value, width, limit, limit_name in shapes:
        tensor = number_tensor(name, value).to(device, torch.float32)
        wanted = (world_count, particle_count, width)
        if tuple(tensor.shape) != wanted:
            raise NPAError(
                f"{name} must have shape {wanted} (worlds, particles, entries), "
                f"got {tuple(tensor.shape)}: see env.unwrapped.particles()"
            )
        if not bool((tensor.abs() <= limit).all()):
            raise NPAError(
                f"{name} must be finite and within {limit_name} = {limit:g}, got numbers up to "
                f"{float(tensor.abs().max())}: clip it, or make the environment with a larger limit"
            )
        given.append(tensor)
    return Start(*given)
