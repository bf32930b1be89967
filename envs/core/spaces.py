"""Spaces of environments, and arrays in and out: NumPy or torch outside, float32 tensors inside."""

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


def to_output(tensor: Tensor, output: str) -> Any:
    """Return a tensor as it is handed out.

    Args:
        tensor: Anything on the device.
        output: "torch" or "numpy".
    """
    return tensor if output == "torch" else tensor.cpu().numpy()


def action_tensor(
    name: str, action: Any, wanted: tuple[int, ...], space: str, letters: str = ""
) -> Tensor:
    """Return an action as a float32 tensor, on the device where it came from.

    Args:
        name: What the caller calls it.
        action: An array or tensor.
        wanted: Its shape.
        space: Where the caller can look up what it has to be.
        letters: The shape in letters, and " = ".

    Raises:
        NPAError: It is no array of numbers, or has another shape.
    """
    came = ""
    if not isinstance(action, Tensor):
        try:
            if np.iscomplexobj(action):
                raise TypeError("complex numbers")
            # Torch cannot read what may not be written.
            action = torch.from_numpy(np.require(action, np.float32, ("C", "W")))
        except (TypeError, ValueError):
            came = type(action).__name__
    if not came and (tuple(action.shape) != wanted or action.dtype.is_complex):
        came = f"{tuple(action.shape)} of {action.dtype}"
    elif not came and (action.layout != torch.strided or action.is_meta):
        came = f"a tensor that is {action.layout} on {action.device}"
    if came:
        raise NPAError(
            f"{name} must be real numbers of shape {letters}{wanted}, got {came}: see {space}"
        )
    checked: Tensor = action.detach().to(torch.float32)
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
