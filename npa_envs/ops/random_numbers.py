"""Random numbers of batched worlds; a world's numbers do not depend on the other worlds."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.kernels.portable.random_numbers import GOLDEN, draw_kernel, mix_keys
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import SCALARS, launch

WORD_COUNT = 2**32
"""Number of values of one 32-bit output of the generator."""


@custom_op("npa::mix_keys")
def _mix_keys(keys: Tensor, advance: int) -> Tensor:
    mixed = torch.empty_like(keys)
    launch(mix_keys, keys.shape[0], keys.device, advance, keys, mixed)
    return mixed


def mixed_keys(keys: Tensor, number: int) -> Tensor:
    """Return the 64 bits at index `number` of each key's SplitMix64 sequence, int64, shape [B]."""
    # The lowest 64 bits as a signed integer, as in torch.
    return _mix_keys(keys, ((number + 1) * GOLDEN + 2**63) % 2**64 - 2**63)


@custom_op("npa::draw", of_all=True)
def draw(
    keys: Tensor,
    episodes: Tensor,
    steps: Tensor,
    number: int,
    distribution: str,
    count: int,
    dtype: torch.dtype,
    bound: int,
) -> Tensor:
    """Return random numbers of each world, [B, count], from a counter-based generator.

    They depend only on the world's entries of `keys`, `episodes` and `steps`, shape [B], and on
    `number`, the index of a call in its step. Distributions are "uniform" in [0, 1), with 24 or
    53 random bits; standard "normal", always finite; "bernoulli", ones with a probability of
    bound / 2^32; "integers" in [0, bound).
    """
    values = keys.new_empty(keys.shape[0], count, dtype=dtype)
    if values.numel() == 0:
        return values
    kernel, per_thread = draw_kernel(distribution, SCALARS[dtype])
    size = values.shape[0], -(-count // per_thread)
    launch(kernel, size, keys.device, bound, number, keys, episodes, steps, values)
    return values
