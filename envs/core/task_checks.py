"""What tasks return, checked: an own task's mistake would be a wrong reward without a word."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from npa_envs.envs.core.task import EnvTask, Start
from npa_envs.errors import NPAError, shown
from npa_envs.world.cuda_graph import recording_lock


def starter(task: EnvTask[Any]) -> str:
    """Return the name of the method that a task says with where worlds start."""
    own = (
        name for name in ("start", "fresh") if getattr(type(task), name) != getattr(EnvTask, name)
    )
    return next(own, "seed")


def check_start(task: EnvTask[Any], start: Start, world_count: int, shapes: Any) -> None:
    """Check the starts of some worlds, without waiting for the device.

    Args:
        task: Whose they are.
        start: What it returned.
        world_count: Worlds B.
        shapes: Shapes of positions and of states, of B worlds and more.
    """
    name = starter(task)
    if not isinstance(start, Start):
        raise NPAError(
            f"{type(task).__name__}.{name} must return a Start, got a {type(start).__name__}: "
            "return npa_envs.envs.Start(x, s)"
        )
    for part, value, shape in zip(("positions", "states"), start, shapes, strict=False):
        _check_tensor(task, name, part, value, (world_count, *shape[1:]), torch.float32)
    for part, value, dtype in (
        ("success_loss", start.success_loss, torch.float32),
        ("goal", start.goal, torch.int64),
    ):
        if value is not None:
            _check_tensor(task, name, part, value, (world_count,), dtype)


def checked_losses(
    task: EnvTask[Any], losses: Any, world_count: int, names: tuple[str, ...]
) -> list[Tensor]:
    """Return the parts of worlds' losses, shape [B] each, without waiting for the device."""
    name = f"{type(task).__name__}.losses"
    if not isinstance(losses, Mapping) or not losses or not all(type(n) is str for n in losses):
        came = list(losses) if isinstance(losses, Mapping) else type(losses).__name__
        raise NPAError(
            f"{name} must return the parts of each world's loss by name, at least one, got {came}: "
            "for example {'distance': distance}, of shape [B]"
        )
    if names and tuple(losses) != names:
        raise NPAError(
            f"{name} must return the same parts in the same order in each call, got "
            f"{list(losses)} after {list(names)}: return zeros for a part that does not count"
        )
    for part, value in losses.items():
        _check_tensor(task, "losses", f"part {shown(part)}", value, (world_count,), torch.float32)
    return list(losses.values())


def checked_shares(task: EnvTask[Any], shares: Any, shape: tuple[int, int]) -> Tensor:
    """Return the particles' shares of worlds' losses, shape [B, N]."""
    _check_tensor(task, "particle_losses", "shares", shares, shape, torch.float32)
    checked: Tensor = shares
    return checked


def _check_tensor(
    task: EnvTask[Any],
    method: str,
    part: str,
    value: Any,
    shape: tuple[int, ...],
    dtype: torch.dtype,
) -> None:
    device = task.device
    if not isinstance(value, Tensor):
        came = f"a {type(value).__name__}"
    elif tuple(value.shape) != shape or value.dtype != dtype or value.device.type != device.type:
        came = f"{value.dtype} of shape {tuple(value.shape)} on {value.device}"
    else:
        return
    raise NPAError(
        f"{part} of {type(task).__name__}.{method} must be a {dtype} tensor of shape {shape} on "
        f"{device}, got {came}: reshape or convert it there"
    )


def check_finite(task: EnvTask[Any], method: str, parts: Mapping[str, Tensor]) -> None:
    """Check that numbers of worlds are finite; waits for the device."""
    for part, value in parts.items():
        bad = ~torch.isfinite(value.flatten(1) if value.ndim > 1 else value[:, None]).all(dim=1)
        if bool(bad.any()):
            worlds = bad.nonzero()[:, 0].tolist()
            raise NPAError(
                f"{part} of {type(task).__name__}.{method} must be finite, got NaN or infinite "
                f"numbers in {len(worlds)} of {len(bad)} worlds, first in world {worlds[0]}: "
                "divide and take roots of positive numbers only"
            )


class GlobalDraws:
    """The states of the global generators of random numbers: a task must not draw from them."""

    def __init__(self, task: EnvTask[Any]) -> None:
        self._task = task
        self._before = self._states()

    def check(self, method: str) -> None:
        """Check that none of them has moved since, by the method of the task."""
        now = self._states()
        moved = [name for name, state in self._before.items() if state != now[name]]
        if moved:
            raise NPAError(
                f"{type(self._task).__name__}.{method} must not draw from global generators, which "
                f"reset(seed=...) does not seed, got draws from {' and '.join(moved)}: draw from "
                "the WorldRandom that seed is given, for example random.uniform(...)"
            )

    def _states(self) -> dict[str, Any]:
        _, key, *rest = np.random.get_state()
        states: dict[str, Any] = {
            "torch's": torch.get_rng_state().numpy().tobytes(),
            "NumPy's": (np.asarray(key).tobytes(), *rest),
            "Python's": random.getstate(),
        }
        if self._task.device.type == "cuda":
            # A capture of another thread puts another generator in its place for a moment.
            with recording_lock:
                state = torch.cuda.get_rng_state(self._task.device)
            states["torch's on CUDA"] = state.numpy().tobytes()
        return states
