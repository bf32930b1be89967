"""Lanes: on CUDA a few neighbouring threads share one particle and split its candidates.

Each lane sums every so-many-th candidate; warp shuffles then add the lanes in a fixed order. Short
sums go to every lane; the sums over channels are scattered, so that each lane finishes its own
share of the channels. On the CPU a particle has one lane and the same source runs without either.
The native snippets here are what plain Warp cannot say: a shuffle among some threads of a warp,
and a load of 16 bytes at a time.
"""

import functools
from typing import Any

import warp as wp

from npa_envs.kernels.domain import scalar_name

CUDA_LANES = 4
"""Lanes of a particle on CUDA, a power of two; also the smallest channel group."""

_SHUFFLES = """
    const unsigned first = threadIdx.x & 31u & ~({lanes}u - 1u);
    const unsigned mask = {whole} ? ~0u : ((1u << {lanes}) - 1u) << first;
    auto parts = value;
    {part}* sums = reinterpret_cast<{part}*>(&parts);
"""

_ADD = """
#if defined(__CUDA_ARCH__)
    {shuffles}
    #pragma unroll
    for (unsigned i = 0; i < sizeof(parts) / sizeof({part}); ++i) {{
        #pragma unroll
        for (unsigned offset = {lanes} / 2; offset >= {stride}; offset >>= 1) {{
            sums[i] += __shfl_xor_sync(mask, sums[i], offset);
        }}
    }}
    return parts;
#else
    return value;
#endif
"""

# At each step a lane keeps the half of the channels on its side and gives the other half away.
_SCATTER = """
    {share} result;
    {part}* own = reinterpret_cast<{part}*>(&result);
#if defined(__CUDA_ARCH__)
    {shuffles}
    #pragma unroll
    for (unsigned row = 0; row < {rows}; ++row) {{
        unsigned count = {width};
        #pragma unroll
        for (unsigned offset = {lanes} / 2; offset > 0; offset >>= 1) {{
            const bool upper = threadIdx.x & offset;
            count /= 2;
            #pragma unroll
            for (unsigned c = 0; c < {width} / 2; ++c) {{
                if (c < count) {{
                    const {part} low = sums[row * {width} + c];
                    const {part} high = sums[row * {width} + count + c];
                    const {part} given = __shfl_xor_sync(mask, upper ? low : high, offset);
                    sums[row * {width} + c] = (upper ? high : low) + given;
                }}
            }}
        }}
        #pragma unroll
        for (unsigned c = 0; c < {width} / {lanes}; ++c) {{
            own[row * ({width} / {lanes}) + c] = sums[row * {width} + c];
        }}
    }}
#else
    const {part}* sums = reinterpret_cast<const {part}*>(&value);
    for (unsigned i = 0; i < sizeof(result) / sizeof({part}); ++i) own[i] = sums[i];
#endif
    return result;
"""

READ = """
    {entry} result;
#if defined(__CUDA_ARCH__)
    struct alignas({bytes}) Chunk {{ unsigned part[{bytes} / 4]; }};
    const Chunk* from = reinterpret_cast<const Chunk*>({place});
    unsigned* to = reinterpret_cast<unsigned*>(&result);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(result) / {bytes}; ++i) {{
        const Chunk chunk = from[i];
        #pragma unroll
        for (unsigned k = 0; k < {bytes} / 4; ++k) to[{bytes} / 4 * i + k] = chunk.part[k];
    }}
#else
    {otherwise}
#endif
    return result;
"""
"""Reads a value in chunks of some bytes; also `otherwise`, without assumptions on alignment."""


def c_scalar(scalar: type) -> str:
    """Return the name of a scalar type in native code."""
    if scalar is wp.int32:
        return "int"
    return {"f32": "float", "f64": "double"}[scalar_name(scalar)]


def c_type(value_type: type, scalar: type) -> str:
    """Return the name of a scalar, vector or matrix type in native code."""
    if value_type is scalar:
        return c_scalar(scalar)
    shape = value_type._shape_
    kind = "vec_t" if len(shape) == 1 else "mat_t"
    return f"wp::{kind}<{', '.join(str(size) for size in shape)}, {c_scalar(scalar)}>"


def chunk_bytes(value_type: type) -> int:
    """Return how many bytes of a value an access takes: as many as 16 that divide its size."""
    size = wp.types.type_size_in_bytes(value_type)
    return next(count for count in (16, 8, 4) if size % count == 0)


def share_type(value_type: type, scalar: type, lanes: int) -> type:
    """Return the type of one lane's share of a vector [W] or matrix [D, W] of channels."""
    *rows, width = value_type._shape_
    share = width // lanes
    if rows:
        return wp.types.matrix((rows[0], share), scalar)
    return wp.types.vector(share, scalar)


@functools.cache
def make_lane_sum(
    value_type: type, scalar: type, lanes: int, whole_warps: bool = False, stride: int = 1
) -> Any:
    """Return a Warp function that adds a value over the lanes of a particle; each gets the sum.

    Args:
        value_type: A scalar, vector or matrix type.
        scalar: The scalar type that it is made of.
        lanes: Lanes of a particle, 1 on the CPU.
        whole_warps: All threads of a warp call it together, which takes fewer instructions.
        stride: Every so-manyth lane is added, a power of two.
    """
    part = c_scalar(scalar)
    shuffles = _SHUFFLES.format(part=part, lanes=lanes, whole=int(whole_warps))

    @wp.func_native(_ADD.format(part=part, lanes=lanes, stride=stride, shuffles=shuffles))
    def lane_sum(value: value_type) -> value_type: ...

    return lane_sum


@functools.cache
def make_lane_scatter(value_type: type, scalar: type, lanes: int) -> Any:
    """Return a Warp function that adds a value over the lanes; each gets its share of channels.

    Args:
        value_type: A vector [W] or matrix [D, W] type; W is a multiple of `lanes`.
        scalar: The scalar type that it is made of.
        lanes: Lanes of a particle, 1 on the CPU.
    """
    part = c_scalar(scalar)
    shape = value_type._shape_
    result_type = share_type(value_type, scalar, lanes)
    snippet = _SCATTER.format(
        part=part,
        lanes=lanes,
        shuffles=_SHUFFLES.format(part=part, lanes=lanes, whole=0),
        share=c_type(result_type, scalar),
        rows=shape[0] if len(shape) == 2 else 1,
        width=shape[-1],
    )

    @wp.func_native(snippet)
    def lane_scatter(value: value_type) -> result_type: ...

    return lane_scatter


@functools.cache
def make_wide_load(value_type: type, scalar: type) -> Any:
    """Return a Warp function that reads an entry of a flat array, on CUDA in few, wide loads.

    The array must be dense and its memory aligned to an entry, or to 16 bytes; the index must not
    be negative. Warp's own indexing, which knows neither, takes several instructions more.

    Args:
        value_type: A scalar, vector or matrix type.
        scalar: The scalar type that it is made of, `wp.int32` included.
    """
    snippet = READ.format(
        entry=c_type(value_type, scalar),
        bytes=chunk_bytes(value_type),
        place="entries.data + index",
        otherwise="result = entries.data[index];",
    )

    @wp.func_native(snippet)
    def wide_load(entries: wp.array(dtype=value_type), index: wp.int32) -> value_type: ...

    return wide_load


# Native snippets beside those of `lanes`: what plain Warp cannot say on CUDA.
#
# Stores of up to 16 bytes at a time, sums over a warp, the hardware's own exponential.


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
