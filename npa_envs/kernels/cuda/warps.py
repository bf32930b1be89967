"""Warps: the threads that CUDA runs together, their votes, shuffles and sums.

Everything here is native CUDA that plain Warp cannot say, and for whole warps: all of a warp's
threads must take the same way to it. Only `of_warp` is there on the CPU too.
"""

import functools

import warp as wp

from npa_envs.kernels.wide import make_wide_load

WARP = 32
"""Threads of a warp."""

CUDA_BLOCK = 128
"""Threads of a block, where a launch does not say otherwise."""

load_integer = make_wide_load(wp.int32, wp.int32)
load_scalar = make_wide_load(wp.float32, wp.float32)

_SHUFFLE = """
#if defined(__CUDA_ARCH__)
    return __shfl_sync(~0u, value, thread);
#else
    return value;
#endif
"""

_SUM_UP_TO = """
    const unsigned lane = threadIdx.x & 31u;
    #pragma unroll
    for (unsigned offset = 1; offset < 32; offset <<= 1) {
        const int before = __shfl_up_sync(~0u, value, offset);
        if (lane >= offset) value += before;
    }
    return value;
"""

_FIND = """
    unsigned found = 0;
    #pragma unroll
    for (unsigned step = 16; step > 0; step >>= 1) {
        if (__shfl_sync(~0u, ends, found + step - 1) <= number) found += step;
    }
    return found;
"""


@functools.cache
def make_shuffle(scalar: type) -> wp.Function:
    """Return a Warp function for a value that a thread of the warp has; on the CPU, the argument.

    Args:
        scalar: `wp.int32` or `wp.float32`.
    """

    @wp.func_native(_SHUFFLE)
    def shuffle(value: scalar, thread: wp.int32) -> scalar: ...

    return shuffle


of_warp = make_shuffle(wp.int32)
scalar_of_warp = make_shuffle(wp.float32)


# Beside `of_warp`, because which thread is asked differs among the particles of a warp.
@wp.func_native("return __shfl_sync(~0u, value, (threadIdx.x & 31u & ~(lanes - 1u)) + lane);")
def of_lane(value: wp.int32, lane: wp.int32, lanes: wp.uint32) -> wp.int32:
    """Another lane's value, of the same particle."""
    ...


@wp.func_native("return blockIdx.x * blockDim.x + threadIdx.x;")
def thread_number() -> wp.int32:
    """Number of this thread in its launch, without the divisions of `wp.tid`."""
    ...


@wp.func_native("__syncwarp();")
def meet_warp():
    """Wait until the whole warp is here, and sees what it wrote."""
    ...


@wp.func_native("return __any_sync(~0u, condition);")
def any_in_warp(condition: wp.bool) -> wp.bool:
    """Whether a condition holds for some thread of the warp."""
    ...


@wp.func_native("return __ffs(__ballot_sync(~0u, condition)) - 1;")
def first_in_warp(condition: wp.bool) -> wp.int32:
    """The first thread for which a condition holds, -1 if there is none."""
    ...


@wp.func_native("return __ballot_sync(~0u, condition);")
def vote_of_warp(condition: wp.bool) -> wp.uint32:
    """For which threads a condition holds, a bit for each."""
    ...


@wp.func_native("return __reduce_max_sync(~0u, value);")
def largest_in_warp(value: wp.int32) -> wp.int32:
    """The largest value of the warp's threads."""
    ...


@wp.func_native(_SUM_UP_TO)
def sum_up_to(value: wp.int32) -> wp.int32:
    """The sum of the values of this thread and of those before it in the warp."""
    ...


@wp.func_native(_FIND)
def thread_of(ends: wp.int32, number: wp.int32) -> wp.int32:
    """The first thread whose end, one of an ascending order, is beyond a number."""
    ...
