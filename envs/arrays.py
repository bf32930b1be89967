"""Arrays in and out: NumPy or torch on the outside, float32 tensors on the device inside."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from npa_envs.errors import NPAError


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
            action = torch.from_numpy(np.ascontiguousarray(action, dtype=np.float32))
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
        raise NPAError(f"action must be real, got {action.dtype}: see env.action_space")
    checked: Tensor = action.detach().to(torch.float32).view(shape)
    return checked
