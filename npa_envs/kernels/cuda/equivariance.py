"""Products of mixed vectors and gated displacements, on CUDA in float32: a warp has a few rows.

The formulas are those of `npa_envs/ops/equivariance.py`. Compared with
`kernels/portable/equivariance.py` there are fewer passes over rows, and one of them also computes
the gradient of the mixing weights.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.lanes_and_memory import WARP, wait_for_previous_kernel

READ_WARPS, PULL_WARPS, STEER_WARPS, MIXING_SUM_WARPS = 4, 4, 4, 16
"""Warps of a block of `read_rows`, `pull_back_rows`, the steering kernels and `add_blocks`."""

STEERED_ROWS = 2
"""Rows of outputs from which a warp computes updates."""

MAX_MIXING = 1024
"""Maximum number of mixing weights: each thread sums gradients of every 32nd of them."""

SHARED_BYTES = 48 * 1024
"""Shared memory of a block that the driver grants by default [bytes]."""


def rows_of_warp(mixed_count: int) -> int:
    """Return the number of rows of a warp, at most 4: a thread for each of their mixed vectors."""
    return min(max(WARP // mixed_count, 1), 4)


def fits_block(
    space_dim: int, scalars: int, perceived: int, mixed_count: int, chiral: bool
) -> bool:
    """Return whether rows of these sizes fit into a block's shared memory, for `row_kernels`."""
    weights = perceived * mixed_count
    products = mixed_count * (mixed_count + 1) // 2 + chiral * (
        mixed_count * (mixed_count - 1) // 2
    )
    row = scalars + products + (perceived + 2 * mixed_count) * space_dim
    floats = weights + PULL_WARPS * (weights + rows_of_warp(mixed_count) * row)
    return weights <= MAX_MIXING and mixed_count < 256 and 4 * floats <= SHARED_BYTES


@cached_under_lock()
def row_kernels(
    space_dim: int, scalars: int, perceived: int, mixed_count: int, chiral: bool
) -> SimpleNamespace:
    """Return the kernel from rows of perception to a network's inputs, and its backward kernel.

    Columns of rows are [scalars | perceived vectors | 1 | 0], those of inputs are [scalars |
    products of mixed vectors | 1 | 0]. Mixed vectors [K, mixed_count, D] and mixing weights
    [perceived, mixed_count] are flat arrays.
    """
    form = space_dim, scalars, perceived, mixed_count, chiral
    module = native.module(f"npa_envs.kernels.vector_rows_{'_'.join(str(int(k)) for k in form)}")
    warp_rows = rows_of_warp(mixed_count)
    read_vectors = native.function(
        "read_vectors", *form, READ_WARPS, warp_rows, untyped="rows mixing mixed inputs"
    )
    pull_back_vectors = native.function(
        "pull_back_vectors",
        *(*form, PULL_WARPS, warp_rows),
        untyped="rows mixing mixed mixed_bar inputs_bar rows_bar partial_sums",
    )

    @wp.kernel(module=module)
    def read_rows(
        rows: wp.array2d[wp.float32],
        mixing: wp.array[wp.float32],
        # outputs
        mixed: wp.array[wp.float32],
        inputs: wp.array2d[wp.float32],
    ):
        """Write the mixed vectors and the network's inputs, from rows of perception."""
        wait_for_previous_kernel()
        read_vectors(rows, mixing, mixed, inputs)

    @wp.kernel(module=module)
    def pull_back_rows(
        rows: wp.array2d[wp.float32],
        mixing: wp.array[wp.float32],
        mixed: wp.array[wp.float32],
        mixed_bar: wp.array[wp.float32],
        inputs_bar: wp.array2d[wp.float32],
        # outputs
        rows_bar: wp.array2d[wp.float32],
        partial_sums: wp.array2d[wp.float32],
    ):
        """Write dL/d(rows), and each block's sum of dL/d(mixing weights)."""
        wait_for_previous_kernel()
        pull_back_vectors(rows, mixing, mixed, mixed_bar, inputs_bar, rows_bar, partial_sums)

    return SimpleNamespace(read_rows=read_rows, pull_back_rows=pull_back_rows)


@cached_under_lock()
def mixing_sum() -> wp.Kernel:
    """Return the kernel that adds up the blocks' sums of dL/d(mixing weights)."""
    add_partial_sums = native.function(
        "add_partial_sums", MIXING_SUM_WARPS, untyped="partial_sums total"
    )
    module = native.module("npa_envs.kernels.vector_sums")

    @wp.kernel(module=module, launch_bounds=MIXING_SUM_WARPS * WARP)
    def add_blocks(
        partial_sums: wp.array2d[wp.float32],
        # outputs
        total: wp.array[wp.float32],
    ):
        """Write dL/d(mixing weights), the sum over the blocks of `pull_back_rows`."""
        wait_for_previous_kernel()
        add_partial_sums(partial_sums, total)

    return add_blocks


@cached_under_lock()
def steering_kernels(space_dim: int, mixed_count: int, chiral: bool) -> SimpleNamespace:
    """Return the kernel from a network's outputs to updates, and its backward kernel.

    Columns of outputs are [gates | state changes | 0], those of updates are [displacement | state
    changes | 0]. A displacement is a sum of mixed vectors times gates.
    """
    form = space_dim, mixed_count, chiral
    module = native.module(f"npa_envs.kernels.steering_{'_'.join(str(int(k)) for k in form)}")
    sizes = *form, STEER_WARPS, STEERED_ROWS
    steer_by_gates = native.function("steer_by_gates", *sizes, untyped="output mixed signs update")
    pull_back_gates = native.function(
        "pull_back_gates", *sizes, untyped="output mixed signs update_bar output_bar mixed_bar"
    )

    @wp.kernel(module=module)
    def steer(
        output: wp.array2d[wp.float32],
        mixed: wp.array[wp.float32],
        signs: wp.array[wp.float32],
        # outputs
        update: wp.array2d[wp.float32],
    ):
        """Write updates: displacements, sums of gates times mixed vectors; state changes."""
        wait_for_previous_kernel()
        steer_by_gates(output, mixed, signs, update)

    @wp.kernel(module=module)
    def pull_back_steering(
        output: wp.array2d[wp.float32],
        mixed: wp.array[wp.float32],
        signs: wp.array[wp.float32],
        update_bar: wp.array2d[wp.float32],
        # outputs
        output_bar: wp.array2d[wp.float32],
        mixed_bar: wp.array[wp.float32],
    ):
        """Write dL/d(output) and dL/d(mixed vectors) from `update_bar`, dL/d(update)."""
        wait_for_previous_kernel()
        pull_back_gates(output, mixed, signs, update_bar, output_bar, mixed_bar)

    return SimpleNamespace(steer=steer, pull_back_steering=pull_back_steering)
