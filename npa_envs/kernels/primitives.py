"""Access to memory and to other threads' values: wide loads and stores, sums over lanes, votes.

On CUDA a few adjacent threads, called lanes, may share one particle: with n lanes each sums every
n-th candidate, and warp shuffles then add the lanes' sums in a fixed order. Short sums go to every
lane; of long ones each lane gets some of the columns. On a CPU a particle has one lane, and the
same source runs without shuffles.

Functions of factories and `of_warp` run on both devices. The others run on CUDA only, and all
threads of a warp must call them together.
"""

from typing import Any

import warp as wp

from npa_envs.kernels import native_functions as native
from npa_envs.thread_lock import cached_under_lock

CUDA_LANES = 4
"""Threads that share a particle on CUDA, a power of two; also the smallest channel group."""

WARP = 32
"""Threads of a warp."""

CUDA_BLOCK = 128
"""Default number of threads of a block."""


@native.func_native()
def await_earlier():
    """Wait for earlier launches; kernels call it first, before they access memory.

    On compute capability 9.0 and above such a kernel is started before the previous one has ended
    (`npa_envs/ops/cuda_driver.py`). It must not load by `__ldg` or `ld.global.nc`, which the
    compiler moves ahead of the wait.
    """


@native.func_native()
def allow_next_launch():
    """Allow the next kernel's blocks to start before this kernel's blocks have ended.

    They start wherever there is room, so a kernel with few blocks may get several of them on one
    multiprocessor. Only kernels call it whose successor is not slowed down by that.
    """


@cached_under_lock()
def make_wide_load(value_type: type) -> Any:
    """Return a Warp function that reads an entry of a flat array, on CUDA in few, wide loads.

    The array must be dense and aligned to the size of an entry, or to 16 bytes; the index must not
    be negative. Warp's own indexing, without these conditions, takes several instructions more.
    """

    @native.func_native()
    def wide_load(entries: wp.array[value_type], index: int) -> value_type: ...

    return wide_load


load_integer = make_wide_load(wp.int32)
load_scalar = make_wide_load(wp.float32)


wide_store = native.generic("wide_store", 3)
"""Writes to `entries` at `index` a `value`, in few, wide stores; as for `make_wide_load`."""


def scalar_of(value_type: Any) -> Any:
    """Return the scalar type of a vector's or a matrix's entries; a scalar type itself."""
    return getattr(value_type, "_wp_scalar_type_", value_type)


@cached_under_lock()
def make_read_at(value_type: type, alignment: int) -> Any:
    """Return a Warp function that reads a vector from an index of an array of scalars.

    The vector's address must be a multiple of `alignment` bytes, 4, 8 or 16: the width of a load.
    """
    scalar = scalar_of(value_type)

    @native.func_native(value_type, alignment)
    def read_at(values: wp.array[scalar], index: int) -> value_type: ...

    return read_at


@cached_under_lock()
def make_read_channels(value_type: Any) -> Any:
    """Return a Warp function that reads adjacent channels of a particle, 0 beyond the last one."""
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


write_at = native.generic("write_at", 3)
"""Writes to an array of scalars, from `index` on, a vector `value`, at multiples of 16 bytes."""


@cached_under_lock()
def make_lane_sum(value_type: type, lanes: int, whole_warps: bool = False, stride: int = 1) -> Any:
    """Return a Warp function that sums a value over the threads of a particle; each gets the sum.

    On a CPU there is one thread. With `whole_warps` all threads of a warp must call it together,
    which takes fewer instructions. Every `stride`-th thread is summed, a power of two.
    """

    @native.func_native(scalar_of(value_type), lanes, whole_warps, stride)
    def lane_sum(value: value_type) -> value_type: ...

    return lane_sum


@cached_under_lock()
def make_lane_collect(value_type: Any, lanes: int) -> Any:
    """Return a Warp function that sums matrices [D, W] over threads; each gets some columns.

    Those of thread i are group i of the columns. Its matrix has group i ^ k as k-th, so its own
    comes first: then all indices are constants.
    """
    scalar, (rows, width) = scalar_of(value_type), value_type._shape_
    lane_columns = wp.types.matrix((rows, width // lanes), scalar)

    @native.func_native(lane_columns, scalar, rows, width, lanes)
    def lane_collect(value: value_type) -> lane_columns: ...

    return lane_collect


@cached_under_lock()
def make_kept(scalar: type) -> Any:
    """Return a Warp function that returns its argument, of type `scalar`, kept in a register.

    CUDA's compiler would otherwise convert an integer to float again in every pass of a loop.
    """

    @native.func_native()
    def kept(value: scalar) -> scalar: ...

    return kept


@cached_under_lock()
def make_shuffle(scalar: type) -> wp.Function:
    """Return a Warp function that reads a value of another thread of the warp; on a CPU its own."""

    @native.func_native()
    def shuffle(value: scalar, thread: int) -> scalar: ...

    return shuffle


of_warp = make_shuffle(wp.int32)
scalar_of_warp = make_shuffle(wp.float32)


@native.func_native()
def of_lane(value: int, lane: int, lanes: wp.uint32) -> int:
    """Return the value of thread number `lane` of the `lanes` threads that share a particle."""


@native.func_native()
def thread_number() -> int:
    """Return this thread's index in the launch, without the divisions of `wp.tid`."""


@native.func_native()
def block_number() -> int:
    """Return this block's index in the launch."""


@native.func_native()
def thread_of_block() -> int:
    """Return this thread's index in its block."""


@native.func_native()
def sync_block():
    """Synchronize the threads of the block, and make their writes visible to each other."""


@native.func_native()
def sync_warp():
    """Synchronize the threads of the warp, and make their writes visible to each other."""


@native.func_native()
def any_in_warp(condition: bool) -> bool:
    """Return whether a condition is true for some thread of the warp."""


@native.func_native()
def first_in_warp(condition: bool) -> int:
    """Return the first thread for which a condition is true, -1 for none."""


@native.func_native()
def vote_of_warp(condition: bool) -> wp.uint32:
    """Return a number with a bit for each thread of the warp: whether a condition is true."""


@native.func_native()
def largest_in_warp(value: int) -> int:
    """Return the largest value of the warp's threads."""


@native.func_native()
def sum_up_to(value: int) -> int:
    """Return the sum of the values of this thread and of those before it in the warp."""


@native.func_native()
def thread_of(ends: int, number: int) -> int:
    """Return the first thread of the warp whose `ends` is above `number`; `ends` must ascend."""


@native.func_native()
def as_number(word: float) -> int:
    """Return the integer whose bits are those of a float32."""


@native.func_native()
def as_word(number: int) -> float:
    """Return the float32 whose bits are those of an integer."""


@cached_under_lock()
def make_add_scaled(group: type) -> Any:
    """Return a Warp function for total + factor * value, rounded after each operation on a CPU.

    It uses vector registers of the CPU, which the compiler does not use by itself.
    """
    scalar = scalar_of(group)

    @native.func_native()
    def add_scaled(total: group, factor: scalar, value: group) -> group: ...

    return add_scaled
