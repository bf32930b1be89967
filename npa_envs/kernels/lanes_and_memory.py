"""Access to memory and to other threads' values: wide loads and stores, sums over lanes, votes.

On CUDA a few adjacent threads of a warp, called its lanes, may share one particle: each of n lanes
sums every n-th candidate, and warp shuffles then add the lanes' sums in a fixed order. Every lane
gets short sums; each lane gets some columns of long sums. On a CPU a particle has one lane, and
the same source runs without shuffles.

Functions of factories and `of_warp` run on both devices. The others run on CUDA only, and all
threads of a warp must call them together.
"""

from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native

CUDA_LANES = 4
"""Threads that share a particle on CUDA, a power of two; also the smallest channel group."""

WARP = 32
"""Threads of a warp."""

CUDA_BLOCK = 128
"""Default number of threads of a block."""

wait_for_previous_kernel = native.function("wait_for_previous_kernel")
"""Wait for earlier launches; kernels call it first, before they access memory.

On compute capability 9.0 and above such a kernel is started before the previous one has ended
(`npa_envs/ops/cuda_driver.py`). It must not load by `__ldg` or `ld.global.nc`, which the compiler
moves ahead of the wait."""

allow_next_launch = native.function("allow_next_launch")
"""Allow the next kernel's blocks to start before this kernel's blocks have ended.

They start wherever there is room, so a kernel with few blocks may get several of them on one
multiprocessor. Only kernels call it whose successor is not slowed down by that."""


@cached_under_lock()
def make_wide_load(value_type: type) -> Any:
    """Return a Warp function that reads an entry of a flat array, on CUDA in few, wide loads.

    The array must be dense and aligned to the size of an entry, or to 16 bytes; the index must not
    be negative. Warp's own indexing, without these conditions, takes several instructions more.
    """
    return native.function("wide_load", entries=wp.array[value_type], index=int, returns=value_type)


load_integer = make_wide_load(wp.int32)
load_scalar = make_wide_load(wp.float32)

wide_store = native.function("wide_store", untyped="entries index value")
"""Write a value to an entry of a flat array, in few, wide stores; as for `make_wide_load`."""


def scalar_of(value_type: Any) -> Any:
    """Return the type of a vector's or a matrix's entries; a scalar type itself."""
    return getattr(value_type, "_wp_scalar_type_", value_type)


@cached_under_lock()
def make_read_at(value_type: type, alignment: int) -> Any:
    """Return a Warp function that reads a vector from an index of an array of scalars.

    The vector's address must be a multiple of `alignment` bytes, 4, 8 or 16: the width of a load.
    """
    values = wp.array[scalar_of(value_type)]
    return native.function(
        "read_at", value_type, alignment, values=values, index=int, returns=value_type
    )


@cached_under_lock()
def make_read_channels(value_type: Any) -> Any:
    """Return a Warp function that reads adjacent channels of a particle; 0 beyond the last one."""
    scalar, count = scalar_of(value_type), value_type._length_
    read_at = make_read_at(value_type, min(wp.types.type_size_in_bytes(value_type), 16))

    @wp.func
    def read_channels(
        states: wp.array[scalar], state_dim: int, aligned: int, particle: int, first: int
    ):
        result = value_type()
        index = particle * state_dim + first
        if aligned == 0:
            for k in range(wp.static(count)):
                if first + k < state_dim:
                    result[k] = states[index + k]
        elif first < state_dim:
            result = read_at(states, index)
        return result

    return read_channels


write_at = native.function("write_at", untyped="values index value")
"""Write a vector to an array of scalars, from `index` on, at multiples of 16 bytes."""


@cached_under_lock()
def make_lane_sum(value_type: type, lanes: int, whole_warps: bool = False, stride: int = 1) -> Any:
    """Return a Warp function that adds a value over the threads of a particle; each gets the sum.

    On a CPU there is one thread. With `whole_warps` all threads of a warp must call it together,
    which takes fewer instructions. Every `stride`-th thread is added, a power of two.
    """
    options = scalar_of(value_type), lanes, whole_warps, stride
    return native.function("lane_sum", *options, value=value_type, returns=value_type)


def make_add_scaled(group: type) -> Any:
    """Return a Warp function for total + factor * value, rounded after each operation on a CPU."""
    types = {"total": group, "factor": scalar_of(group), "value": group}
    return native.function("add_scaled", **types, returns=group)


@cached_under_lock()
def make_add_outer(rows: type, vector: type, group: type) -> Any:
    """Return a Warp function for total + factors * value of each row; as `make_add_scaled`."""
    return native.function("add_outer", total=rows, factors=vector, value=group, returns=rows)


of_warp = native.function("shuffle", value=int, thread=int, returns=int)
scalar_of_warp = native.function("shuffle", value=float, thread=int, returns=float)
"""The value of a thread of the warp; on a CPU this thread's own."""

of_lane = native.function("of_lane", value=int, lane=int, lanes=wp.uint32, returns=int)
"""The value of thread number `lane` of the `lanes` threads that share a particle."""

thread_number = native.function("thread_number", returns=int)
"""This thread's index in the launch, without the divisions of `wp.tid`."""

block_number = native.function("block_number", returns=int)
thread_of_block = native.function("thread_of_block", returns=int)
"""This block's index in the launch, and this thread's index in its block."""

sync_block, sync_warp = native.function("sync_block"), native.function("sync_warp")
"""Synchronize the threads of the block or warp, and make their writes visible to each other."""

any_in_warp = native.function("any_in_warp", condition=bool, returns=bool)
"""Whether a condition is true for some thread of the warp."""

first_in_warp = native.function("first_in_warp", condition=bool, returns=int)
"""The number in the warp of the first thread for which a condition is true, -1 for none."""

vote_of_warp = native.function("vote_of_warp", condition=bool, returns=wp.uint32)
"""A number with a bit for each thread of the warp: whether a condition is true."""

largest_in_warp = native.function("largest_in_warp", value=int, returns=int)
"""The largest value of the warp's threads."""

sum_up_to = native.function("sum_up_to", value=int, returns=int)
"""The sum of the values of this thread and of those before it in the warp."""

thread_of = native.function("thread_of", ends=int, number=int, returns=int)
"""The number of the first thread of the warp whose `ends` exceeds `number`; `ends` ascend."""

as_number = native.function("as_number", word=float, returns=int)
as_word = native.function("as_word", number=int, returns=float)
"""The int32 with the bits of a float32, and the float32 with the bits of an int32."""
