"""Whole rollouts of small worlds in one launch on CUDA, without gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from npa_envs.kernels.cuda.whole_rollout import (
    SHARED_BYTES,
    WorldVariant,
    channel_blocks,
    whole_rollout,
    world_size,
)
from npa_envs.ops.backend import multiprocessor_count
from npa_envs.ops.launch import aligned, launch
from npa_envs.ops.physics import INVERSES, Physics

SORT_INTERVAL = 16
"""Steps after which particles are sorted again, so that neighbours stay close in memory."""

VARIANTS: dict[int, tuple[tuple[int, int, int, float], ...]] = {
    64: ((2, 1, 8, 8.0), (1, 1, 16, math.inf)),
    128: ((4, 2, 1, 0.5), (4, 1, 4, 4.0), (2, 1, 8, math.inf)),
    256: ((8, 2, 1, 0.5), (8, 1, 2, 2.0), (4, 1, 4, math.inf)),
    512: ((8, 2, 1, 0.5), (16, 1, 1, 1.0), (8, 1, 2, math.inf)),
}
"""By the size of worlds: warps and blocks of a world, worlds of a block; and up to how many worlds
per multiprocessor. Few worlds get more warps each; a world has the same bits in all variants."""


def world_variant(
    world_count: int, particle_count: int, state_dim: int, hidden_dim: int, multiprocessors: int
) -> WorldVariant:
    """Return the kernel's variant for worlds of these sizes, which `fits_block` allows."""
    size, blocks = world_size(particle_count), channel_blocks(state_dim)
    chosen = []
    for warps, cluster, groups, share in VARIANTS[size]:
        variant = WorldVariant(size, warps, cluster, groups, blocks)
        if variant.memory(hidden_dim) <= SHARED_BYTES:
            chosen.append(variant)
        if world_count <= share * multiprocessors:
            break
    return chosen[-1]


def run_whole_rollout(
    x: Tensor,
    s: Tensor,
    physics: Physics,
    weights: Sequence[Tensor],
    steps: int,
    masks: Tensor | None,
    noise: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Return positions and states after `steps` steps; for calls that `backend.choose` allows.

    `weights` are W1 [H, P], b1 [H] and W2 [A, H]. `masks` (uint8, [T, B, N]) has each step's active
    particles, None for all; `noise` [T, B, N, D] is added to positions.
    """
    x, s = aligned(x), s.contiguous()
    world_count, particle_count, _ = x.shape
    multiprocessors = multiprocessor_count(x.device)
    hidden_weight, hidden_bias, output_weight = (weight.contiguous() for weight in weights)
    hidden_dim, state_dim = len(hidden_bias), physics.state_dim
    variant = world_variant(world_count, particle_count, state_dim, hidden_dim, multiprocessors)
    terms, scale = physics.terms, physics.scale()
    numbers = (
        1.0 / physics.eps,
        physics.max_displacement * physics.dt,
        physics.dt,
        7.5 / physics.eps * scale,
        30.0 / math.pi / physics.eps**3 * scale**3 / particle_count,
        *(physics.box or (1.0, 1.0)),
    )
    choices = (
        steps,
        SORT_INTERVAL,
        INVERSES.index(terms.correction),
        int(physics.boundary == "reflecting"),
        2 * state_dim if terms.state_gradient else -1,
        2 * state_dim * (1 + terms.state_gradient) if terms.density_gradient else -1,
    )
    tensors = hidden_weight, hidden_bias, output_weight, masks, noise, x, s
    results = torch.empty_like(x), torch.empty_like(s)
    blocks = variant.cluster * min(world_count, multiprocessors // variant.cluster)
    threads, arguments = variant.threads, (numbers, choices, *tensors, *results)
    launch(whole_rollout(variant), blocks * threads, x.device, *arguments, block_dim=threads)
    return results
