"""Random numbers of batched worlds; a world's numbers do not depend on the other worlds."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from npa_envs.kernels.portable.random_numbers import GOLDEN, draw_kernel, draw_masks, mix_keys
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


TORCH_BLOCK = 256
"""Threads of a block of torch's kernels that draw random numbers."""


def _mask_layout(device: torch.device, count: int) -> tuple[int, int]:
    """Return the threads of torch's kernel for `count` numbers, and how often each draws four."""
    properties = torch.cuda.get_device_properties(device)
    resident = properties.max_threads_per_multi_processor // TORCH_BLOCK
    blocks = min(-(-count // TORCH_BLOCK), properties.multi_processor_count * resident)
    threads = blocks * TORCH_BLOCK
    return threads, -(-count // (4 * threads))


def torch_masks(masks: Tensor, probability: float, seed: int, offset: int) -> None:
    """Overwrite masks [T, K], uint8, as T calls of `bernoulli_` on CUDA, in one launch.

    Seed and offset are those of the generator, to whose offset T `mask_increment` have to be added.
    """
    rows, count = masks.shape
    threads, calls = _mask_layout(masks.device, count)
    numbers = seed % 2**64, offset, 4 * calls, threads, probability
    launch(draw_masks, (rows, calls * threads), masks.device, *numbers, masks)


@functools.lru_cache(maxsize=256)
def mask_increment(device: torch.device, count: int) -> int | None:
    """Return what a call of `bernoulli_` for `count` numbers adds to a CUDA generator's offset.

    None: this version of torch draws other numbers than `torch_masks`. That is tried once.
    """
    generator = torch.Generator(device).manual_seed(2**40 + 1)
    masks = torch.empty(2, 2, count, dtype=torch.uint8, device=device)
    torch_masks(masks[0], 0.3, generator.initial_seed(), 0)
    for mask in masks[1]:
        mask.bernoulli_(0.3, generator=generator)
    increment = 4 * _mask_layout(device, count)[1]
    same = generator.get_offset() == 2 * increment and bool((masks[0] == masks[1]).all())
    return increment if same else None
