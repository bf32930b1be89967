"""The rule's network on CUDA's tensor cores, in float32: fused kernels, and their weight layout.

Each factor of a product is split into two numbers of 16 bits; `network.cuh` has the layout in a
warp. float16 has a small range, so rows are first scaled by powers of two, which is exact.
Names: `x_bar` = dL/dx, the gradient of the loss L with respect to x.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.lanes_and_memory import WARP, allow_next_launch, wait_for_previous_kernel

UNIT_GROUP = 16
"""Hidden units of one step: the inner dimension of a matrix product."""

ROW_TARGET, UNIT_TARGET, OUTPUT_TARGET = 8, 4, 7
"""Exponents of 2 to which rows, hidden weights and output weights are scaled by `scale_to`.

A hidden unit is then below 2^(8 + 1 + 4 + 1), in the range of float16, with a far smaller error."""

ROW_TILE, WARP_UNITS, SUM_WARPS = 32, 32, 4
"""Of weight gradients: rows that a block sums between two barriers, hidden units of one warp, and
warps of a block that adds partial sums."""

LAYER_REGISTERS, GRADIENT_REGISTERS = 168, 255
"""Registers per thread of the layer kernels and of the weight gradient kernels."""

WIDE, WIDE_REGISTERS = range(81, 97), 128
"""Row widths (of 3D rules with 16 channels) with another number of registers, and that number."""


@cached_under_lock()
def two_layer_kernel(column_blocks: int, tiles: int, mode: str) -> wp.Kernel:
    """Return the kernel that applies a network of two layers to rows; a warp serves 16 rows.

    Rows have at most 16 `column_blocks` columns, outputs 8 `tiles`. `mode` "relu" applies ReLU to
    hidden units, "relu_store_mask" also stores its mask, "apply_mask" applies a stored one.

    Arguments: number of hidden units H, a multiple of 16; rows [K, width]; weights of both layers,
    from `arrange_hidden` and `arrange_output`; scales of the outputs [8 `tiles`]; `signs`, the
    mask, a bit for each hidden unit, [K, 4 ceil(H / 128)]; outputs [K, out_width]. Rows are read 16
    bytes at a time and outputs written 8 at a time: both must be dense, begin at a multiple of that
    and have a multiple of 4, or 2, columns. Weights begin at a multiple of 16 bytes, too.
    """
    name = f"npa_envs.kernels.network_{mode}_{column_blocks}_{tiles}"
    registers = WIDE_REGISTERS if max(16 * column_blocks, 8 * tiles) in WIDE else LAYER_REGISTERS

    two_layers = native.function(
        "two_layers",
        *(column_blocks, tiles, mode.upper(), ROW_TARGET),
        untyped="unit_count rows hidden_weights output_weights output_unscale signs output",
    )

    @wp.kernel(module=native.module(name), cuda_max_registers=registers)
    def network_layers(
        unit_count: int,
        rows: wp.array2d[wp.float32],
        hidden_weights: wp.array[wp.float16],
        output_weights: wp.array[wp.float16],
        output_unscale: wp.array[wp.float32],
        signs: wp.array2d[wp.int32],
        # outputs
        output: wp.array2d[wp.float32],
    ):
        """Write a network's outputs for rows of inputs; its hidden units stay in registers."""
        wait_for_previous_kernel()
        two_layers(unit_count, rows, hidden_weights, output_weights, output_unscale, signs, output)

    return network_layers


@cached_under_lock()
def weight_gradient_kernels(
    column_blocks: int, tiles: int, out_tiles: int, warps: int, unit_blocks: int, words: int
) -> SimpleNamespace:
    """Return two kernels: both layers' weight gradients, summed over ranges of rows; their total.

    Rows have 16 `column_blocks` or 8 `tiles` columns, their `output_bar` 8 `out_tiles`, masks
    `words` words. A block sums a range of rows for 1 / `unit_blocks` of the hidden units, each of
    its `warps` for `WARP_UNITS`. It recomputes hidden units and their cotangents, transposed, as
    left operands of the weight gradients' products. Numbers are pairs of bfloat16, which need no
    scaling: scales differ among rows, and sums run over rows.
    """
    variant = f"{column_blocks}_{tiles}_{out_tiles}_{warps}_{unit_blocks}_{words}"
    module = native.module(f"npa_envs.kernels.network_gradients_{variant}")
    sizes = column_blocks, tiles, out_tiles, warps, unit_blocks, words, ROW_TILE
    weight_sums = native.function(
        "weight_sums",
        *sizes,
        untyped="unit_count part_rows rows output_bar signs hidden_weights output_weights sums",
    )
    add_partial_sums = native.function("add_partial_sums", SUM_WARPS, untyped="partial_sums total")

    @wp.kernel(module=module, cuda_max_registers=GRADIENT_REGISTERS)
    def sum_weight_gradients(
        unit_count: int,
        part_rows: int,
        rows: wp.array2d[wp.float32],
        output_bar: wp.array2d[wp.float32],
        signs: wp.array2d[wp.int32],
        hidden_weights: wp.array[wp.bfloat16],
        output_weights: wp.array[wp.bfloat16],
        # outputs
        sums: wp.array2d[wp.float32],
    ):
        """Write both layers' weight gradients, summed over each range of `part_rows` rows."""
        wait_for_previous_kernel()
        allow_next_launch()
        weight_sums(
            unit_count, part_rows, rows, output_bar, signs, hidden_weights, output_weights, sums
        )

    @wp.kernel(module=module)
    def add_parts(
        partial_sums: wp.array2d[wp.float32],
        # outputs
        total: wp.array[wp.float32],
    ):
        """Add up the weight gradients of all ranges of rows."""
        wait_for_previous_kernel()
        allow_next_launch()
        add_partial_sums(partial_sums, total)

    return SimpleNamespace(sum_weight_gradients=sum_weight_gradients, add_parts=add_parts)


scale_to = native.function("scale_to", size=float, exponent=wp.uint32, returns=float)
"""The power of two that scales a positive number into [2^exponent, 2^(exponent + 1))."""


@cached_under_lock()
def arrangement_kernels() -> SimpleNamespace:
    """Return the kernels that lay out weights in the order in which a warp's threads read them.

    Each weight is split into two numbers of 16 bits. The last dimension of launches is a warp, 32.
    """
    module = native.module("npa_envs.kernels.network_arrangement")

    @wp.kernel(module=module)
    def arrange_hidden(
        weights: wp.array2d[wp.float32],
        # outputs
        unit_unscale: wp.array[wp.float32],
        fragments: wp.array[wp.float16],
    ):
        """Scale and arrange layer 1's weights [H, width], with [H / 8, ceil(width / 16)] warps."""
        wait_for_previous_kernel()
        tile, step, lane = wp.tid()
        unit = 8 * tile + lane / 4
        size = wp.float32(0.0)
        for column in range(weights.shape[1]):
            size += wp.abs(weights[unit, column])
        scale = scale_to(size, wp.uint32(wp.static(UNIT_TARGET)))
        if step == 0 and lane % 4 == 0:
            unit_unscale[unit] = wp.float32(1.0) / scale
        first = ((tile * ((weights.shape[1] + 15) / 16) + step) * wp.static(WARP) + lane) * 8
        for i in range(4):
            column = 16 * step + lane % 4 * 4 + i
            value = wp.float32(0.0)
            if column < weights.shape[1]:
                value = weights[unit, column] * scale
            high = wp.float16(value)
            fragments[first + i] = high
            fragments[first + 4 + i] = wp.float16(value - wp.float32(high))

    @wp.kernel(module=module)
    def arrange_output(
        weights: wp.array2d[wp.float32],
        unit_unscale: wp.array[wp.float32],
        # outputs
        output_unscale: wp.array[wp.float32],
        fragments: wp.array[wp.float16],
    ):
        """Scale and arrange layer 2's weights [width, H], with [H / 16, ceil(width / 8)] warps."""
        wait_for_previous_kernel()
        step, tile, lane = wp.tid()
        column = 8 * tile + lane / 4
        size = wp.float32(0.0)
        if column < weights.shape[0]:
            for unit in range(weights.shape[1]):
                size = wp.max(size, wp.abs(weights[column, unit] * unit_unscale[unit]))
        scale = scale_to(size, wp.uint32(wp.static(OUTPUT_TARGET)))
        if step == 0 and lane % 4 == 0:
            output_unscale[column] = wp.float32(1.0) / scale
        first = ((step * ((weights.shape[0] + 7) / 8) + tile) * wp.static(WARP) + lane) * 8
        for i in range(4):
            unit = 16 * step + lane % 4 * 2 + i % 2 + i / 2 * 8
            value = wp.float32(0.0)
            if column < weights.shape[0]:
                value = weights[column, unit] * unit_unscale[unit] * scale
            high = wp.float16(value)
            fragments[first + i] = high
            fragments[first + 4 + i] = wp.float16(value - wp.float32(high))

    @wp.kernel(module=module)
    def arrange_left(
        weights: wp.array2d[wp.float32],
        # outputs
        fragments: wp.array[wp.bfloat16],
    ):
        """Arrange weights [H, width] as a left operand, with [H / 16, ceil(width / 16)] warps."""
        wait_for_previous_kernel()
        group, step, lane = wp.tid()
        fragment = (group * ((weights.shape[1] + 15) / 16) + step) * 2 * wp.static(WARP)
        first = (fragment + lane) * 8
        for i in range(8):
            unit = 16 * group + lane / 4 + i / 2 % 2 * 8
            column = 16 * step + lane % 4 * 2 + i % 2 + i / 4 * 8
            value = wp.float32(0.0)
            if column < weights.shape[1]:
                value = weights[unit, column]
            high = wp.bfloat16(value)
            fragments[first + i] = high
            fragments[first + 8 * wp.static(WARP) + i] = wp.bfloat16(value - wp.float32(high))

    return native.namespace(locals())
