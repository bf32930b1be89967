"""Access to memory and to other threads' values: wide loads and stores, sums over lanes, votes.

On CUDA a few neighbouring threads, its lanes, may share one particle and split its candidates: each
lane sums every so-many-th candidate, and warp shuffles then add the lanes in a fixed order. Short
sums go to every lane; of long ones each lane gets its own share. On the CPU a particle has one lane
and the same source runs without either.

What the factories make is for both devices, as is `of_warp`; the rest is for whole warps of CUDA:
all of a warp's threads must take the same way to it.
"""

from typing import Any

import warp as wp

from npa_envs.kernels import native
from npa_envs.once import made_once

CUDA_LANES = 4
"""Lanes of a particle on CUDA, a power of two; also the smallest channel group."""

WARP = 32
"""Threads of a warp."""

CUDA_BLOCK = 128
"""Threads of a block, where a launch does not say otherwise."""


@native.func_native()
def await_earlier():
    """Wait for the launches before this one; kernels begin with it, before they touch memory.

    On compute capability 9.0 and above such a kernel is launched before the one ahead has ended
    (`npa_envs/ops/driver.py`): when that ends its blocks are there. It loads neither by `__ldg` nor
    by `ld.global.nc`, which the compiler moves ahead of the wait.
    """


@native.func_native()
def allow_next_launch():
    """Let the next kernel's blocks take free places before this one's have ended.

    They take them where they find them: a kernel with few blocks for a processor then has too many
    on some. So only kernels call it that are followed by one which does not mind.
    """


@made_once()
def make_wide_load(value_type: type, scalar: type) -> Any:
    """Return a Warp function that reads an entry of a flat array, on CUDA in few, wide loads.

    The array must be dense and its memory aligned to an entry, or to 16 bytes; the index must not
    be negative. Warp's own indexing, which knows neither, takes several instructions more.
    """

    @native.func_native()
    def wide_load(entries: wp.array(dtype=value_type), index: wp.int32) -> value_type: ...

    return wide_load


load_integer = make_wide_load(wp.int32, wp.int32)
load_scalar = make_wide_load(wp.float32, wp.float32)


@made_once()
def make_wide_store(value_type: type, scalar: type) -> Any:
    """Return a Warp function that writes an entry of a flat array, on CUDA in few, wide stores.

    The array and the index are as those of `make_wide_load`.
    """

    @native.func_native()
    def wide_store(entries: wp.array(dtype=value_type), index: wp.int32, value: value_type): ...

    return wide_store


@made_once()
def make_read_at(value_type: type, scalar: type, alignment: int) -> Any:
    """Return a Warp function that reads a vector from a place of an array of scalars.

    The place is a multiple of `alignment` bytes in memory, 4, 8 or 16, which a load takes.
    """

    @native.func_native(value_type, alignment)
    def read_at(values: wp.array(dtype=scalar), place: wp.int32) -> value_type: ...

    return read_at


@made_once()
def make_read_channels(value_type: type, scalar: type) -> Any:
    """Return a Warp function that reads adjacent channels of a particle, zeros beyond the last."""
    count = value_type._length_
    alignment = min(wp.types.type_size_in_bytes(value_type), 16)
    read_at = make_read_at(value_type, scalar, alignment)

    @wp.func
    def read_channels(
        states: wp.array(dtype=scalar),
        state_dim: wp.int32,
        aligned: wp.int32,
        particle: wp.int32,
        first: wp.int32,
    ):
        result = value_type()
        place = particle * state_dim + first
        if aligned == 0:
            for k in range(wp.static(count)):
                if first + k < state_dim:
                    result[k] = states[place + k]
        elif first < state_dim:
            result = read_at(states, place)
        return result

    return read_channels


@made_once()
def make_write_at(value_type: type, scalar: type) -> Any:
    """Return a Warp function that writes a vector to a place of an array of scalars.

    Place and size of the vector are multiples of 16 bytes.
    """

    @native.func_native()
    def write_at(values: wp.array(dtype=scalar), place: wp.int32, value: value_type): ...

    return write_at


def share_type(value_type: type, scalar: type, lanes: int) -> type:
    """Return the type of one lane's share of a vector [W] or matrix [D, W] of channels."""
    *rows, width = value_type._shape_
    share = width // lanes
    if rows:
        return wp.types.matrix((rows[0], share), scalar)
    return wp.types.vector(share, scalar)


@made_once()
def make_lane_sum(
    value_type: type, scalar: type, lanes: int, whole_warps: bool = False, stride: int = 1
) -> Any:
    """Return a Warp function that adds a value over the lanes of a particle; each gets the sum.

    There is one lane on the CPU. With `whole_warps` all threads of a warp call it together, which
    takes fewer instructions; every so-manyth lane is added, as `stride` says, a power of two.
    """

    @native.func_native(scalar, lanes, whole_warps, stride)
    def lane_sum(value: value_type) -> value_type: ...

    return lane_sum


@made_once()
def make_lane_collect(value_type: type, scalar: type, lanes: int) -> Any:
    """Return a Warp function that adds over the lanes; each gets its share of the columns.

    Of the shares in a lane's value, a matrix [D, W], the k-th is that of lane `lane ^ k`, its own
    one the first: so no lane has to look for what it gives.
    """
    rows, width = value_type._shape_
    share = share_type(value_type, scalar, lanes)

    @native.func_native(share, scalar, rows, width, lanes)
    def lane_collect(value: value_type) -> share: ...

    return lane_collect


@made_once()
def make_kept(scalar: type) -> Any:
    """Return a Warp function that returns its argument, of `scalar`, and keeps it in a register.

    CUDA's compiler would compute an integer's float anew in every turn of a loop that follows.
    """

    @native.func_native()
    def kept(value: scalar) -> scalar: ...

    return kept


@made_once()
def make_warp_sum(value_type: type) -> Any:
    """Return a Warp function that adds a value over the 32 threads of a warp; each gets the sum.

    All 32 must call it. On the CPU it returns its argument.
    """

    @native.func_native()
    def warp_sum(value: value_type) -> value_type: ...

    return warp_sum


@made_once()
def make_shuffle(scalar: type) -> wp.Function:
    """Return a Warp function for a value of a thread of the warp; on the CPU, the argument."""

    @native.func_native()
    def shuffle(value: scalar, thread: wp.int32) -> scalar: ...

    return shuffle


of_warp = make_shuffle(wp.int32)
scalar_of_warp = make_shuffle(wp.float32)


@native.func_native()
def of_lane(value: wp.int32, lane: wp.int32, lanes: wp.uint32) -> wp.int32:
    """Another lane's value, of the same particle."""


@native.func_native()
def thread_number() -> wp.int32:
    """Number of this thread in its launch, without the divisions of `wp.tid`."""


@native.func_native()
def block_number() -> wp.int32:
    """Number of this block in its launch."""


@native.func_native()
def thread_of_block() -> wp.int32:
    """Number of this thread in its block."""


@native.func_native()
def sync_block():
    """Wait until the whole block is here, and sees what it wrote."""


@native.func_native()
def sync_warp():
    """Wait until the whole warp is here, and sees what it wrote."""


@native.func_native()
def any_in_warp(condition: wp.bool) -> wp.bool:
    """Whether a condition holds for some thread of the warp."""


@native.func_native()
def first_in_warp(condition: wp.bool) -> wp.int32:
    """The first thread for which a condition holds, -1 if there is none."""


@native.func_native()
def vote_of_warp(condition: wp.bool) -> wp.uint32:
    """For which threads a condition holds, a bit for each."""


@native.func_native()
def largest_in_warp(value: wp.int32) -> wp.int32:
    """The largest value of the warp's threads."""


@native.func_native()
def sum_up_to(value: wp.int32) -> wp.int32:
    """The sum of the values of this thread and of those before it in the warp."""


@native.func_native()
def thread_of(ends: wp.int32, number: wp.int32) -> wp.int32:
    """The first thread whose end, one of an ascending order, is beyond a number."""


@native.func_native()
def as_number(word: wp.float32) -> wp.int32:
    """The integer that was packed into a word."""


@native.func_native()
def as_word(number: wp.int32) -> wp.float32:
    """An integer packed into a word."""


@made_once()
def make_add_scaled(group: type, scalar: type) -> Any:
    """Return a Warp function for total + factor * value, rounded after each operation on the CPU.

    It uses vector registers of the CPU, where its compiler finds none by itself.
    """

    @native.func_native()
    def add_scaled(total: group, factor: scalar, value: group) -> group: ...

    return add_scaled
