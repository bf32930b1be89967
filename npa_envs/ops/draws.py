"""Random numbers of batched worlds as opaque torch operators; no draw depends on another world."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.kernels.portable.draws import (
    BITS_PER_THREAD,
    INTEGERS_PER_THREAD,
    draw_bernoulli,
    draw_integers,
    draw_kernels,
)
from npa_envs.ops.launch import launch, scalar_type
from npa_envs.ops.opaque import opaque

WORD_COUNT = 2**32
"""Values of a word of the generator."""


def _launch_draw(
    kernel: Any, per_thread: int, values: Tensor, keys: Tensor, *arguments: Any
) -> Tensor:
    if values.numel() > 0:
        blocks = -(-values.shape[1] // per_thread)
        launch(kernel, (values.shape[0], blocks), keys.device, *arguments, values)
    return values


@opaque("npa::draw_uniform")
def uniform_draw(
    keys: Tensor, episodes: Tensor, steps: Tensor, draw: int, count: int, dtype: torch.dtype
) -> Tensor:
    """Return numbers uniform in [0, 1), shape [B, count].

    Args:
        keys: Key of each world, int64, shape [B].
        episodes: Episode of each world, int32, shape [B].
        steps: Step of each world within its episode, int32, shape [B].
        draw: Number of the draw within the step.
        count: Numbers to draw for each world.
        dtype: `torch.float32` (24 random bits) or `torch.float64` (53).
    """
    kernels = draw_kernels(scalar_type(dtype))
    values = keys.new_empty(keys.shape[0], count, dtype=dtype)
    return _launch_draw(
        kernels.draw_uniform, kernels.per_thread, values, keys, draw, keys, episodes, steps
    )


@opaque("npa::draw_normal")
def normal_draw(
    keys: Tensor, episodes: Tensor, steps: Tensor, draw: int, count: int, dtype: torch.dtype
) -> Tensor:
    """Return standard normal numbers, always finite, shape [B, count]; see `uniform_draw`."""
    kernels = draw_kernels(scalar_type(dtype))
    values = keys.new_empty(keys.shape[0], count, dtype=dtype)
    return _launch_draw(
        kernels.draw_normal, kernels.per_thread, values, keys, draw, keys, episodes, steps
    )


@uniform_draw.register_fake
@normal_draw.register_fake
def _(
    keys: Tensor, episodes: Tensor, steps: Tensor, draw: int, count: int, dtype: torch.dtype
) -> Tensor:
    return keys.new_empty(keys.shape[0], count, dtype=dtype)


@opaque("npa::draw_bernoulli")
def bernoulli_draw(
    keys: Tensor, episodes: Tensor, steps: Tensor, draw: int, count: int, probability: float
) -> Tensor:
    """Return ones with a probability, to 2^-32, and zeros, uint8, shape [B, count]."""
    values = keys.new_empty(keys.shape[0], count, dtype=torch.uint8)
    threshold = round(probability * WORD_COUNT)
    return _launch_draw(
        draw_bernoulli, BITS_PER_THREAD, values, keys, threshold, draw, keys, episodes, steps
    )


@bernoulli_draw.register_fake
def _(
    keys: Tensor, episodes: Tensor, steps: Tensor, draw: int, count: int, probability: float
) -> Tensor:
    return keys.new_empty(keys.shape[0], count, dtype=torch.uint8)


@opaque("npa::draw_integers")
def integer_draw(
    keys: Tensor, episodes: Tensor, steps: Tensor, draw: int, count: int, high: int
) -> Tensor:
    """Return integers uniform in [0, high), int64, shape [B, count]; see `uniform_draw`."""
    values = keys.new_empty(keys.shape[0], count)
    return _launch_draw(
        draw_integers, INTEGERS_PER_THREAD, values, keys, high, draw, keys, episodes, steps
    )


@integer_draw.register_fake
def _(keys: Tensor, episodes: Tensor, steps: Tensor, draw: int, count: int, high: int) -> Tensor:
    return keys.new_empty(keys.shape[0], count)
