"""The rule's network as fused operators on CUDA's tensor cores, with their adjoint."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.kernels.cuda.network import WARP_UNITS, two_layer_kernel, weight_gradient_kernels
from npa_envs.kernels.cuda.warps import WARP
from npa_envs.sph.arranged import ArrangedWeights, arrange
from npa_envs.sph.bridge import launch

ROW_GROUP = 16
"""Rows of a fragment."""

LAYER_BLOCK = 64
"""Threads of a block that maps rows: small, so that few rows still fill the device."""

SHARES_PER_PROCESSOR = 2
"""Blocks of a multiprocessor that sum weight gradients side by side."""

SIGN_UNITS = 128
"""Hidden units whose signs are one word for each of the four lanes that share a row."""


def _aligned(rows: Tensor) -> Tensor:
    """Return contiguous rows, which are read 16 bytes at a time, moved if they begin elsewhere."""
    rows = rows.contiguous()
    return rows if rows.data_ptr() % 16 == 0 else rows.clone()


def _map_rows(
    rows: Tensor,
    arranged: list[Tensor],
    out_width: int,
    unit_count: int,
    signs: Tensor | None,
    mode: str,
) -> Tensor:
    """Run two layers on rows [K, width], as `make_two_layers` says; returns [K, out_width]."""
    steps, tiles = -(-rows.shape[1] // 16), -(-out_width // 8)
    output = rows.new_empty(rows.shape[0], out_width)
    warps = -(-rows.shape[0] // ROW_GROUP)
    launch(
        two_layer_kernel(steps, tiles, mode),
        -(-warps * WARP // LAYER_BLOCK) * LAYER_BLOCK,
        rows.device,
        unit_count,
        _aligned(rows),
        *arranged[:3],
        signs,
        output,
        block_dim=LAYER_BLOCK,
    )
    return output


@torch.library.custom_op("npa::run_network", mutates_args=())
def _run_network(
    rows: Tensor, arranged: list[Tensor], out_width: int, unit_count: int, noting: bool
) -> tuple[Tensor, Tensor]:
    words = _sign_words(unit_count) if noting else 0
    signs = rows.new_empty(rows.shape[0], words, dtype=torch.int32)
    mode = "note" if noting else "rectify"
    return _map_rows(rows, arranged, out_width, unit_count, signs, mode), signs


@_run_network.register_fake
def _(
    rows: Tensor, arranged: list[Tensor], out_width: int, unit_count: int, noting: bool
) -> tuple[Tensor, Tensor]:
    words = _sign_words(unit_count) if noting else 0
    signs = rows.new_empty(rows.shape[0], words, dtype=torch.int32)
    return rows.new_empty(rows.shape[0], out_width), signs


def _sign_words(unit_count: int) -> int:
    """Return how many words hold the signs of a row's hidden units."""
    return 4 * -(-unit_count // SIGN_UNITS)


@torch.library.custom_op("npa::run_network_backward", mutates_args=())
def _run_network_backward(
    update_bar: Tensor, arranged: list[Tensor], signs: Tensor, width: int, unit_count: int
) -> Tensor:
    return _map_rows(update_bar, arranged, width, unit_count, signs, "mask")


@_run_network_backward.register_fake
def _(
    update_bar: Tensor, arranged: list[Tensor], signs: Tensor, width: int, unit_count: int
) -> Tensor:
    return update_bar.new_empty(update_bar.shape[0], width)


@torch.library.custom_op("npa::network_weight_gradients", mutates_args=())
def _weight_gradients(
    rows: Tensor, update_bar: Tensor, signs: Tensor, arranged: list[Tensor], unit_count: int
) -> Tensor:
    count, width = rows.shape
    out_width = update_bar.shape[1]
    warps = next(n for n in (4, 3, 2, 1) if unit_count // WARP_UNITS % n == 0)
    unit_blocks = unit_count // WARP_UNITS // warps
    kernels = weight_gradient_kernels(
        -(-width // 16), -(-width // 8), -(-out_width // 8), warps, unit_blocks, signs.shape[1]
    )
    processors = torch.cuda.get_device_properties(rows.device).multi_processor_count
    most = max(SHARES_PER_PROCESSOR * processors // unit_blocks, 1)
    share_rows = max(-(-count // (most * ROW_GROUP)), 1) * ROW_GROUP
    shares = -(-count // share_rows)
    partial_sums = rows.new_empty(shares, unit_count * (width + out_width))
    launch(
        kernels.sum_weight_gradients,
        shares * unit_blocks * warps * WARP,
        rows.device,
        unit_count,
        share_rows,
        _aligned(rows),
        _aligned(update_bar),
        signs,
        *arranged[3:],
        partial_sums,
        block_dim=warps * WARP,
    )
    total = rows.new_empty(partial_sums.shape[1])
    launch(
        kernels.add_shares,
        -(-total.shape[0] // WARP) * 4 * WARP,
        rows.device,
        partial_sums,
        total,
    )
    return total


@_weight_gradients.register_fake
def _(
    rows: Tensor, update_bar: Tensor, signs: Tensor, arranged: list[Tensor], unit_count: int
) -> Tensor:
    return rows.new_empty(unit_count * (rows.shape[1] + update_bar.shape[1]))


class _Network(torch.autograd.Function):
    """Raw updates of rows of perception."""

    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor,
        weights: Tensor,
        out_width: int,
        unit_count: int,
        arranged: ArrangedWeights,
        noting: bool,
    ) -> Tensor:
        update: Tensor
        update, signs = _run_network(rows, arranged.forward, out_width, unit_count, noting)
        if noting:
            ctx.save_for_backward(rows, signs, *arranged.backward)
        ctx.unit_count = unit_count
        return update

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, update_bar: Tensor) -> tuple[Tensor | None, ...]:
        rows, signs, *arranged = ctx.saved_tensors
        unit_count, width = ctx.unit_count, rows.shape[1]
        rows_bar = weights_bar = None
        if ctx.needs_input_grad[0]:
            rows_bar = _run_network_backward(update_bar, arranged, signs, width, unit_count)
        if ctx.needs_input_grad[1]:
            weights_bar = _weight_gradients(rows, update_bar, signs, arranged, unit_count)
        return rows_bar, weights_bar, None, None, None, None


def run_network(
    rows: Tensor, weights: Tensor, output_shape: tuple[int, ...], arranged: ArrangedWeights
) -> Tensor:
    """Map rows to relu(rows W1.T) W2.T, as accurate as products in float32.

    A row's result depends on nothing but that row and the weights.

    Args:
        rows: Rows of perception, dimensionless, shape [K, row_width].
        weights: W1 [H, row_width] and W2 [A', H], one after the other, shape [H (row_width + A')].
        output_shape: Shape (A', H) of W2.
        arranged: The same weights as `arrange_weights` laid them out; again where gradients were
            not enabled then and are now.

    Returns:
        Raw updates, dimensionless, shape [K, A'].
    """
    out_width, unit_count = output_shape
    noting = torch.is_grad_enabled() and (rows.requires_grad or weights.requires_grad)
    if noting and not arranged.backward:
        end = unit_count * rows.shape[1]
        hidden_weight = weights[:end].view(unit_count, -1)
        output_weight = weights[end:].view(out_width, unit_count)
        arranged = arrange(hidden_weight, output_weight, with_backward=True)
    update: Tensor = _Network.apply(  # type: ignore[no-untyped-call]
        rows, weights, out_width, unit_count, arranged, noting
    )
    return update
