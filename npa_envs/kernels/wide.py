"""Native snippets beside those of `lanes`: what plain Warp cannot say on CUDA.

Stores of up to 16 bytes at a time, sums over a warp, the hardware's own exponential.
"""

import functools
from typing import Any

import warp as wp

from npa_envs.kernels.domain import scalar_name

_STORE = """
#if defined(__CUDA_ARCH__)
    constexpr unsigned size = sizeof(value);
    constexpr unsigned bytes = size % 16 == 0 ? 16 : size % 8 == 0 ? 8 : 4;
    struct alignas(bytes) Chunk { unsigned part[bytes / 4]; };
    Chunk* to = reinterpret_cast<Chunk*>(entries.data + index);
    const unsigned* from = reinterpret_cast<const unsigned*>(&value);
    #pragma unroll
    for (unsigned i = 0; i < size / bytes; ++i) {
        Chunk chunk;
        #pragma unroll
        for (unsigned k = 0; k < bytes / 4; ++k) chunk.part[k] = from[bytes / 4 * i + k];
        to[i] = chunk;
    }
#else
    entries.data[index] = value;
#endif
"""

_READ = """
    {entry} result;
#if defined(__CUDA_ARCH__)
    struct alignas({bytes}) Chunk {{ unsigned part[{bytes} / 4]; }};
    const Chunk* from = reinterpret_cast<const Chunk*>(values.data + place);
    unsigned* to = reinterpret_cast<unsigned*>(&result);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(result) / {bytes}; ++i) {{
        const Chunk chunk = from[i];
        #pragma unroll
        for (unsigned k = 0; k < {bytes} / 4; ++k) to[{bytes} / 4 * i + k] = chunk.part[k];
    }}
#else
    for (unsigned k = 0; k < {count}; ++k) result[k] = values.data[place + k];
#endif
    return result;
"""

_WRITE = """
#if defined(__CUDA_ARCH__)
    struct alignas(16) Chunk {{ unsigned part[4]; }};
    Chunk* to = reinterpret_cast<Chunk*>(values.data + place);
    const unsigned* from = reinterpret_cast<const unsigned*>(&entry);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(entry) / 16; ++i) {{
        Chunk chunk;
        #pragma unroll
        for (unsigned k = 0; k < 4; ++k) chunk.part[k] = from[4 * i + k];
        to[i] = chunk;
    }}
#else
    for (unsigned k = 0; k < {count}; ++k) values.data[place + k] = entry[k];
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

_OF_WARP = """
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, value, lane);
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


@wp.func_native(_OF_WARP)
def of_warp(value: wp.int32, lane: wp.int32) -> wp.int32:
    """What a thread of the warp has, all 32 of which must ask; on the CPU, the argument."""
    ...


@functools.cache
def make_wide_store(value_type: type, scalar: type) -> Any:
    """Return a Warp function that writes an entry of a flat array, on CUDA in few, wide stores.

    The array must be dense and its memory aligned to an entry, or to 16 bytes; the index must not
    be negative.

    Args:
        value_type: A scalar, vector or matrix type.
        scalar: The scalar type that it is made of.
    """

    @wp.func_native(_STORE)
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
    name = {"f32": "wp::float32", "f64": "wp::float64"}[scalar_name(scalar)]
    snippet = _READ.format(bytes=alignment, count=count, entry=f"wp::vec_t<{count}, {name}>")

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

    @wp.func_native(_WRITE.format(count=value_type._length_))
    def write_at(values: wp.array(dtype=scalar), place: wp.int32, entry: value_type): ...

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
