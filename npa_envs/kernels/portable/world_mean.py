"""Means within each world, in an order of summation that depends only on the world's size.

On CUDA the threads of a warp share a sum, first of a chunk of values, then of the chunks' sums.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes_and_memory import make_lane_sum, wait_for_previous_kernel

CHUNK = 256
"""Values of one partial sum."""

MEAN_LANES = 32
"""CUDA threads that share a sum, a warp; on a CPU it is one."""


@cached_under_lock()
def mean_kernels(scalar: type, lanes: int) -> SimpleNamespace:
    """Return the kernels of the mean within each world; `lanes` threads share a sum."""
    module = native.module(f"npa_envs.kernels.worlds_{scalar_name(scalar)}_l{lanes}")
    lane_sum = make_lane_sum(wp.float64, lanes, whole_warps=True)

    @wp.kernel(module=module)
    def sum_chunks(
        values: wp.array3d[scalar],
        # outputs
        partial_sums: wp.array3d[wp.float64],
    ):
        """Write the sum of each chunk of `CHUNK` values of a world."""
        wait_for_previous_kernel()
        world, k, chunk, lane = wp.tid()
        total = wp.float64(0.0)
        end = wp.min((chunk + 1) * wp.static(CHUNK), values.shape[1])
        for m in range(chunk * wp.static(CHUNK) + lane, end, wp.static(lanes)):
            total += wp.float64(values[world, m, k])
        total = lane_sum(total)
        if lane == 0:
            partial_sums[world, chunk, k] = total

    @wp.kernel(module=module)
    def average_sums(
        value_count: wp.float64,
        partial_sums: wp.array3d[wp.float64],
        # outputs
        means: wp.array2d[scalar],
    ):
        """Add the partial sums of each world and divide by the number of values."""
        wait_for_previous_kernel()
        world, k, lane = wp.tid()
        total = wp.float64(0.0)
        for part in range(lane, partial_sums.shape[1], wp.static(lanes)):
            total += partial_sums[world, part, k]
        total = lane_sum(total)
        if lane == 0:
            means[world, k] = scalar(total / value_count)

    return SimpleNamespace(sum_chunks=sum_chunks, average_sums=average_sums)
