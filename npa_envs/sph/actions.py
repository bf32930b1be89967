"""Applying actions to worlds: what a step of an environment does to its particles, in place."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.update import CHANNEL_SHARE, update_kernels
from npa_envs.sph.bridge import launch, scalar_type
from npa_envs.sph.cells import LARGEST_INDEX
from npa_envs.sph.checks import check_world


def apply_actions(
    action: Tensor,
    x: Tensor,
    s: Tensor,
    *,
    mask: Tensor | None,
    noise: Tensor | None,
    reach: float,
    dt: float,
    state_scale: float,
    moving: bool,
    box: Sequence[float] | None,
    position_limit: float,
    state_limit: float,
    enabled: Tensor | None,
    diverged: Tensor,
) -> None:
    """Move and change particles by their actions, in place; no gradient, nothing waits.

    With the mask m: x ← wrap(x + noise + m dt reach a_x / max(1, |a_x|)) and
    s ← s + m dt state_scale clip(a_s, -1, 1), each computed in float64 and rounded once. A value
    that is not a number becomes 0 and one beyond its limit is moved to it; both mark the world as
    diverged.

    Args:
        action: Actions [a_x (D) ; a_s (C)], dimensionless, shape [B, N, A]; a_s alone where
            particles do not move.
        x: Positions [length units], finite, shape [B, N, D]; changed.
        s: States, dimensionless, finite, shape [B, N, C]; changed.
        mask: Which particles act, uint8, shape [B, N]; None: all of them.
        noise: What is added to every position first [length units], shape [B, N, D], or None.
        reach: Largest displacement alpha eps in a unit of time [length units].
        dt: Time step, dimensionless.
        state_scale: Largest change of a state in a unit of time, dimensionless.
        moving: Actions begin with a_x; otherwise there is none and only noise moves particles.
        box: Sides of the periodic box, into which positions are wrapped, or None.
        position_limit: Largest coordinate's size [length units].
        state_limit: Largest state's size, dimensionless.
        enabled: Whether anything happens at all, uint8, shape [1]; None: it does.
        diverged: Set to 1 where a world diverged and left as it is elsewhere, uint8, shape [B].

    Raises:
        NPAError: A shape, dtype or device does not fit, or a tensor to be changed or read is not
            contiguous.
    """
    check_world(x, s)
    world_count, particle_count, space_dim = x.shape
    state_dim = s.shape[2]
    action_dim = state_dim + (space_dim if moving else 0)
    worlds = (world_count, particle_count)
    for name, tensor, shape, dtype in (
        ("x", x, x.shape, x.dtype),
        ("s", s, s.shape, x.dtype),
        ("action", action, (*worlds, action_dim), x.dtype),
        ("mask", mask, worlds, torch.uint8),
        ("noise", noise, x.shape, x.dtype),
        ("enabled", enabled, (1,), torch.uint8),
        ("diverged", diverged, (world_count,), torch.uint8),
    ):
        if tensor is not None:
            _check_fit(name, tensor, tuple(shape), dtype, x.device)
    if action.numel() >= LARGEST_INDEX:
        raise NPAError(
            f"actions must stay below {LARGEST_INDEX} numbers in one batch, got {action.numel()}: "
            f"split the batch"
        )
    # Adjacent channels are then read and written at once: their places are aligned in memory.
    aligned = state_dim % CHANNEL_SHARE == 0 and (space_dim % 2 == 0 or not moving)
    aligned = aligned and s.data_ptr() % 16 == 0 and action.data_ptr() % 16 == 0
    launch(
        update_kernels(space_dim, scalar_type(x.dtype)).apply_actions,
        world_count * particle_count * -(-state_dim // CHANNEL_SHARE),
        x.device,
        particle_count,
        reach * dt,
        state_scale * dt,
        int(box is not None),
        tuple(box) if box is not None else (1.0,) * space_dim,
        int(moving),
        position_limit,
        state_limit,
        int(mask is not None),
        None if mask is None else mask.view(-1),
        int(noise is not None),
        None if noise is None else noise.view(-1, space_dim),
        int(enabled is not None),
        enabled,
        state_dim,
        int(aligned),
        action.view(-1),
        x.view(-1, space_dim),
        s.view(-1),
        diverged,
    )


def _check_fit(
    name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> None:
    if tuple(tensor.shape) != shape or tensor.dtype != dtype or tensor.device != device:
        raise NPAError(
            f"{name} must be {dtype} of shape {shape} on {device}, got {tensor.dtype} of shape "
            f"{tuple(tensor.shape)} on {tensor.device}: convert or reshape it"
        )
    if not tensor.is_contiguous():
        raise NPAError(
            f"{name} must be contiguous, got strides {tensor.stride()}: "
            f"make it so with {name}.contiguous()"
        )
