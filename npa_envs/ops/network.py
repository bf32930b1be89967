"""The rule's network: fused operators on CUDA's tensor cores, their adjoint, and its weights."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.cuda.network import (
    SUM_WARPS,
    UNIT_GROUP,
    WARP_UNITS,
    arrangement_kernels,
    two_layer_kernel,
    weight_gradient_kernels,
)
from npa_envs.kernels.lanes_and_memory import WARP
from npa_envs.ops.backend import KernelRequest, choose, multiprocessor_count
from npa_envs.ops.custom_op import custom_op, once_differentiable
from npa_envs.ops.launch import aligned, launch


class ArrangedWeights(NamedTuple):
    """Weights W1 and W2 of a rule's network in the memory layout of the CUDA kernels."""

    forward: list[Tensor]
    """Fragments (tiles of tensor cores) of W1 and W2, float16, and factors of outputs, float32."""
    backward: list[Tensor]
    """The same of W1ᵀ and W2ᵀ, then fragments of both, bfloat16; empty without gradients."""


def _arrange_layers(first: Tensor, second: Tensor) -> list[Tensor]:
    """Return weights [H, width], [outputs, H] as scaled tiles, float16, and factors of outputs."""
    hidden, width = first.shape
    column_blocks, tiles = -(-width // 16), -(-second.shape[0] // 8)
    half = functools.partial(torch.empty, dtype=torch.float16, device=first.device)
    fragments = half(hidden * column_blocks * 32), half(hidden * tiles * 16)
    unit_unscale, output_unscale = first.new_empty(hidden), first.new_empty(8 * tiles)
    kernels = arrangement_kernels()
    device, threads = first.device, (hidden // 8, column_blocks, WARP)
    launch(kernels.arrange_hidden, threads, device, first, unit_unscale, fragments[0])
    threads, scales = (hidden // UNIT_GROUP, tiles, WARP), (unit_unscale, output_unscale)
    launch(kernels.arrange_output, threads, device, second, *scales, fragments[1])
    return [*fragments, output_unscale]


@custom_op("npa::arrange_weights")
def _arrange_weights(
    hidden_weight: Tensor, output_weight: Tensor, with_backward: bool
) -> list[Tensor]:
    arranged = _arrange_layers(hidden_weight, output_weight)
    if with_backward:
        arranged += _arrange_layers(output_weight.T, hidden_weight.T)
        # Left operands of products.
        for weight in (hidden_weight, output_weight.T):
            column_blocks = -(-weight.shape[1] // 16)
            size, device = weight.shape[0] * column_blocks * 32, weight.device
            arranged.append(torch.empty(size, dtype=torch.bfloat16, device=device))
            threads = weight.shape[0] // UNIT_GROUP, column_blocks, WARP
            launch(arrangement_kernels().arrange_left, threads, device, weight, arranged[-1])
    return arranged


def arrange_weights(hidden_weight: Tensor, output_weight: Tensor) -> ArrangedWeights | None:
    """Return a rule's weights in the layout of `run_network`; None if no CUDA kernel takes them.

    Where gradients are enabled they are also laid out for the backward pass, even if the weights
    require no gradient: once, instead of in every step whose perception requires one.
    """
    hidden, width = hidden_weight.shape
    request = KernelRequest(
        hidden_weight.device,
        hidden_weight.dtype,
        row_width=width,
        update_width=output_weight.shape[0],
        hidden_dim=hidden,
    )
    if choose("network", request).name != "cuda":
        return None
    weights = hidden_weight.detach().contiguous(), output_weight.detach().contiguous()
    arranged = _arrange_weights(*weights, torch.is_grad_enabled())
    return ArrangedWeights(arranged[:3], arranged[3:])


ROW_GROUP = 16
"""Rows of a fragment."""

LAYER_BLOCK = 64
"""Threads of a block of the forward pass: few, so that also few rows fill the device."""

BLOCKS_PER_PROCESSOR = 2
"""Blocks per multiprocessor that sum weight gradients in parallel, where there are many rows."""

FEW_ROWS = 160
"""Rows per multiprocessor up to which one block sums them: adding partial sums takes longer."""

MASK_UNITS = 128
"""Number of hidden units whose activity four threads store, in 32 bits each."""


@custom_op("npa::run_network")
def _run_network(
    rows: Tensor,
    arranged: list[Tensor],
    out_width: int,
    unit_count: int,
    mode: str,
    stored_bits: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Return a network's outputs [K, out_width] of rows [K, width], and which units are active.

    The latter are bits, one for each hidden unit, written if `mode` is "relu_store_mask". The
    backward pass, "apply_mask", reads them as `stored_bits`.
    """
    column_blocks, tiles = -(-int(rows.shape[1]) // 16), -(-out_width // 8)
    words = 4 * -(-unit_count // MASK_UNITS) if mode == "relu_store_mask" else 0
    bits = rows.new_empty(rows.shape[0], words, dtype=torch.int32)
    output = rows.new_empty(rows.shape[0], out_width)
    warps = -(-rows.shape[0] // ROW_GROUP)
    launch(
        two_layer_kernel(column_blocks, tiles, mode),
        -(-warps * WARP // LAYER_BLOCK) * LAYER_BLOCK,
        rows.device,
        unit_count,
        aligned(rows),
        *arranged[:3],
        bits if stored_bits is None else stored_bits,
        output,
        block_dim=LAYER_BLOCK,
    )
    return output, bits


@custom_op("npa::network_weight_gradients")
def _weight_gradients(
    rows: Tensor, update_bar: Tensor, bits: Tensor, arranged: list[Tensor], unit_count: int
) -> Tensor:
    count, width, out_width = rows.shape[0], int(rows.shape[1]), int(update_bar.shape[1])
    warps = next(n for n in (4, 3, 2, 1) if unit_count // WARP_UNITS % n == 0)
    unit_blocks = unit_count // WARP_UNITS // warps
    kernels = weight_gradient_kernels(
        -(-width // 16), -(-width // 8), -(-out_width // 8), warps, unit_blocks, int(bits.shape[1])
    )
    processors = multiprocessor_count(rows.device)
    blocks_each = 1 if count <= FEW_ROWS * processors else BLOCKS_PER_PROCESSOR
    most = max(blocks_each * processors // unit_blocks, 1)
    part_rows = max(-(-count // (most * ROW_GROUP)), 1) * ROW_GROUP
    part_count = -(-count // part_rows)
    partial_sums = rows.new_empty(part_count, unit_count * (width + out_width))
    launch(
        kernels.sum_weight_gradients,
        part_count * unit_blocks * warps * WARP,
        rows.device,
        unit_count,
        part_rows,
        aligned(rows),
        aligned(update_bar),
        bits,
        *arranged[3:],
        partial_sums,
        block_dim=warps * WARP,
    )
    total = rows.new_empty(partial_sums.shape[1])
    launch(
        kernels.add_parts,
        -(-total.shape[0] // WARP) * SUM_WARPS * WARP,
        rows.device,
        partial_sums,
        total,
        block_dim=SUM_WARPS * WARP,
    )
    return total


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor,
        weights: Tensor,
        out_width: int,
        unit_count: int,
        arranged: ArrangedWeights,
    ) -> Tensor:
        update: Tensor
        update, bits = _run_network(
            rows, arranged.forward, out_width, unit_count, "relu_store_mask", None
        )
        ctx.save_for_backward(rows, bits, *arranged.backward)
        ctx.unit_count = unit_count
        return update

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, update_bar: Tensor) -> tuple[Tensor | None, ...]:
        rows, bits, *arranged = ctx.saved_tensors
        unit_count, width = ctx.unit_count, rows.shape[1]
        rows_bar = weights_bar = None
        if ctx.needs_input_grad[0]:
            rows_bar, _ = _run_network(update_bar, arranged, width, unit_count, "apply_mask", bits)
        if ctx.needs_input_grad[1]:
            weights_bar = _weight_gradients(rows, update_bar, bits, arranged, unit_count)
        return rows_bar, weights_bar, None, None, None


def run_network(
    rows: Tensor, weights: Tensor, output_shape: tuple[int, ...], arranged: ArrangedWeights
) -> Tensor:
    """Return relu(rows W1ᵀ) W2ᵀ, K rows of A' outputs, as accurate as products in float32.

    A row's result depends only on that row and the weights, not on the other rows. `rows` are
    padded perception vectors, [K, row_width]. `weights` are W1 [H, row_width] and W2 [A', H] in one
    vector; `output_shape` is (A', H). `arranged` are the same weights by `arrange_weights`; if they
    were arranged without gradients, and these are needed, it is done again.
    """
    out_width, unit_count = output_shape
    needs_gradient = torch.is_grad_enabled() and (rows.requires_grad or weights.requires_grad)
    if needs_gradient and not arranged.backward:
        end = unit_count * rows.shape[1]
        hidden_weight = weights[:end].view(unit_count, -1)
        output_weight = weights[end:].view(out_width, unit_count)
        arranged = arrange_weights(hidden_weight, output_weight) or arranged
    if not needs_gradient:
        return _run_network(rows, arranged.forward, out_width, unit_count, "relu", None)[0]
    update: Tensor = _Network.apply(  # type: ignore[no-untyped-call]
        rows, weights, out_width, unit_count, arranged
    )
    return update
