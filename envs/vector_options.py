"""What environments, batched ones above all, are given when made and reset, checked."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError, suggest
from npa_envs.tasks.checks import is_whole
from npa_envs.world.randomness import WorldRandom

AUTORESET_MODES = {
    "same-step": AutoresetMode.SAME_STEP,
    "next-step": AutoresetMode.NEXT_STEP,
    "disabled": AutoresetMode.DISABLED,
}
"""What happens to worlds whose episodes are over."""


def checked_count(name: str, value: Any) -> int:
    """Return a number of things, a whole number of at least 1.

    Args:
        name: What the caller calls it.
        value: The number.

    Raises:
        NPAError: It is not.
    """
    if isinstance(value, np.integer):
        value = int(value)
    if not is_whole(value) or value < 1:
        raise NPAError(
            f"{name} must be a whole number of at least 1, got {value!r}: for example {name}=8"
        )
    return int(value)


def autoreset_mode(given: str | AutoresetMode) -> AutoresetMode:
    """Return Gymnasium's mode for a word or for itself.

    Args:
        given: One of `AUTORESET_MODES`, the value of one of Gymnasium's modes, or such a mode.

    Raises:
        NPAError: There is no such mode.
    """
    if isinstance(given, AutoresetMode):
        return given
    by_name = AUTORESET_MODES | {mode.value: mode for mode in AutoresetMode}
    if not isinstance(given, str) or given not in by_name:
        raise NPAError(
            f"autoreset_mode must be a known word, got {given!r}: "
            f"{suggest(str(given), AUTORESET_MODES)}"
        )
    return by_name[given]


def worlds_to_reset(options: dict[str, Any] | None, world_count: int) -> NDArray[np.int64]:
    """Return which worlds `reset` was asked to reset: those of the mask, or all.

    Args:
        options: What `reset` was given.
        world_count: Worlds B.

    Raises:
        NPAError: The mask is no bool array of shape [B], or chooses no world.
    """
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        raise NPAError(
            f"options must be a dict or None, got {type(options).__name__}: "
            "for example options={'reset_mask': mask}"
        )
    for name in options:
        if name != "reset_mask":
            raise NPAError(f"unknown reset option {name!r}: {suggest(str(name), ['reset_mask'])}")
    mask = options.get("reset_mask")
    if mask is None:
        return np.arange(world_count)
    given = mask.cpu().numpy() if isinstance(mask, Tensor) else np.asarray(mask)
    if given.dtype != bool or given.shape != (world_count,):
        raise NPAError(
            f"reset_mask must be bool of shape [B] = ({world_count},), got {given.dtype} "
            f"{given.shape}: True for each world to reset"
        )
    if not given.any():
        raise NPAError("reset_mask must choose at least one world, got none: skip the reset")
    return np.flatnonzero(given)


def world_keys(
    seed: int | Sequence[int] | None, world_count: int, np_random: np.random.Generator
) -> Tensor:
    """Return the key of each world's randomness, int64, shape [B].

    Args:
        seed: Seed of the first world, each of the others has one more; or a seed for each; None
            draws the keys.
        world_count: Worlds B.
        np_random: What keys are drawn from.

    Raises:
        NPAError: Another number of seeds than of worlds, or a seed is negative.
    """
    if seed is None:
        drawn = np_random.integers(2**64, size=world_count, dtype=np.uint64)
        return torch.from_numpy(drawn.view(np.int64))
    if isinstance(seed, int | np.integer):
        seed = [int(seed) + k for k in range(world_count)]
    cure = f"one whole number, or one for each of {world_count} worlds: give seed=0"
    try:
        seeds = [operator.index(number) for number in seed]
    except TypeError as error:
        raise NPAError(f"seed must be {cure}, got {seed!r}") from error
    if len(seeds) != world_count:
        raise NPAError(f"seed must be {cure}, got {len(seeds)}")
    return WorldRandom(seeds).keys
