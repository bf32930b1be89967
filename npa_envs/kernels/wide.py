"""Native snippets beside those of `lanes`: what plain Warp cannot say on CUDA.

Stores of up to 16 bytes at a time, sums over a warp, the hardware's own exponential.
"""

import functools
from typing import Any

import warp as wp

from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.lanes import READ, c_type, chunk_bytes

_WRITE = """
#if defined(__CUDA_ARCH__)
    struct alignas({bytes}) Chunk {{ unsigned part[{bytes} / 4]; }};
    Chunk* to = reinterpret_cast<Chunk*>({place});
    const unsigned* from = reinterpret_cast<const unsigned*>(&value);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(value) / {bytes}; ++i) {{
        Chunk chunk;
        #pragma unroll
        for (unsigned k = 0; k < {bytes} / 4; ++k) chunk.part[k] = from[{bytes} / 4 * i + k];
        to[i] = chunk;
    }}
#else
    {otherwise}
#endif
"""

_WARP_SUM = """
#if defined(__CUDA_ARCH__)
    auto parts = value;
    double* sums = reinterpret_cast<double*>(&parts);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(parts) / sizeof(double); ++i) {
        #pragma unroll
        for (unsigned offset = 16; offset > 0; offset >>= 1) {
            sums[i] += __shfl_xor_sync(0xffffffffu, sums[i], offset);
        }
    }
    return parts;
#else
    return value;
#endif
"""

_EXP2 = """
#if defined(__CUDA_ARCH__)
    return ::exp2(value);
#else
    return wp::exp(value * 0.69314718055994530942);
#endif
"""

_FAST_EXP2 = """
#if defined(__CUDA_ARCH__)
    float power;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(power) : "f"(value));
    return power;
#else
    return wp::exp(value * 0.69314718f);
#endif
"""


@functools.cache
def make_wide_store(value_type: type, scalar: type) -> Any:
    """Return a Warp function that writes an entry of a flat array, on CUDA in few, wide stores.

    The array must be dense and its memory aligned to an entry, or to 16 bytes; the index must not
    be negative.

    Args:
        value_type: A scalar, vector or matrix type.
        scalar: The scalar type that it is made of.
    """

    snippet = _WRITE.format(
        bytes=chunk_bytes(value_type),
        place="entries.data + index",
        otherwise="entries.data[index] = value;",
    )

    @wp.func_native(snippet)
    def wide_store(entries: wp.array(dtype=value_type), index: wp.int32, value: value_type): ...

    return wide_store


@functools.cache
def make_read_at(value_type: type, scalar: type, alignment: int) -> Any:
    """Return a Warp function that reads a vector from a place of an array of scalars.

    Args:
        value_type: A vector type of a multiple of `alignment` bytes.
        scalar: The scalar type that it is made of.
        alignment: Bytes that the place is a multiple of in memory, and that a load takes: 4, 8
            or 16.
    """
    count = value_type._length_
    snippet = READ.format(
        entry=c_type(value_type, scalar),
        bytes=alignment,
        place="values.data + place",
        otherwise=f"for (int k = 0; k < {count}; ++k) result[k] = values.data[place + k];",
    )

    @wp.func_native(snippet)
    def read_at(values: wp.array(dtype=scalar), place: wp.int32) -> value_type: ...

    return read_at


@functools.cache
def make_read_channels(value_type: type, scalar: type) -> Any:
    """Return a Warp function that reads adjacent channels of a particle, zeros beyond its last one.

    Args:
        value_type: A vector type.
        scalar: The scalar type that it is made of.
    """
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


@functools.cache
def make_write_at(value_type: type, scalar: type) -> Any:
    """Return a Warp function that writes a vector to a place of an array of scalars.

    Args:
        value_type: A vector type of a multiple of 16 bytes; the place is one, too, in memory.
        scalar: The scalar type that it is made of.
    """

    count = value_type._length_
    snippet = _WRITE.format(
        bytes=16,
        place="values.data + place",
        otherwise=f"for (int k = 0; k < {count}; ++k) values.data[place + k] = value[k];",
    )

    @wp.func_native(snippet)
    def write_at(values: wp.array(dtype=scalar), place: wp.int32, value: value_type): ...

    return write_at


@functools.cache
def make_warp_sum(value_type: type) -> Any:
    """Return a Warp function that adds a value over the 32 threads of a warp; each gets the sum.

    All 32 must call it. On the CPU it returns its argument.

    Args:
        value_type: `wp.float64` or a vector of it.
    """

    @wp.func_native(_WARP_SUM)
    def warp_sum(value: value_type) -> value_type: ...

    return warp_sum


@functools.cache
def make_fast_exp2(scalar: type) -> Any:
    """Return a Warp function for powers of two, in float32 on CUDA right to about 2e-7.

    Args:
        scalar: `wp.float32` or `wp.float64`.
    """
    snippet = {"f32": _FAST_EXP2, "f64": _EXP2}[scalar_name(scalar)]

    @wp.func_native(snippet)
    def fast_exp2(value: scalar) -> scalar: ...

    return fast_exp2
