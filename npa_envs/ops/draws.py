"""Random numbers of batched worlds as torch operators; no draw depends on another world."""

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
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import launch, scalar_type

WORD_COUNT = 2**32
"""Number of values of one 32-bit output of the generator."""


@custom_op("npa::draw")
def draw(
    keys: Tensor,
    episodes: Tensor,
    steps: Tensor,
    number: int,
    kind: str,
    count: int,
    dtype: torch.dtype,
    bound: int,
) -> Tensor:
    """Return random numbers of each world, [B, count]; `number` is the draw's index in its step.

    Kinds are "uniform" in [0, 1), with 24 or 53 random bits; standard "normal", always finite;
    "bernoulli", ones with a probability of bound / `WORD_COUNT`; and "integers" in [0, bound).
    """
    values = keys.new_empty(keys.shape[0], count, dtype=dtype)
    if values.numel() == 0:
        return values
    arguments: tuple[Any, ...] = number, keys, episodes, steps, values
    if kind == "bernoulli":
        kernel, per_thread, arguments = draw_bernoulli, BITS_PER_THREAD, (bound, *arguments)
    elif kind == "integers":
        kernel, per_thread, arguments = draw_integers, INTEGERS_PER_THREAD, (bound, *arguments)
    else:
        kernels = draw_kernels(scalar_type(dtype))
        kernel = kernels.draw_uniform if kind == "uniform" else kernels.draw_normal
        per_thread = kernels.per_thread
    launch(kernel, (values.shape[0], -(-count // per_thread)), keys.device, *arguments)
    return values
