"""Lanes: on CUDA a few neighbouring threads share one particle and split its candidates.

Each lane sums every so-many-th candidate; a butterfly of warp shuffles adds the lanes in a fixed
order. On the CPU a particle has one lane, and the same kernels run unchanged. The two native
snippets here are what plain Warp cannot say: a shuffle among some threads of a warp, and a load
of 16 bytes at a time.
"""

import functools
from typing import Any

import warp as wp

from npa_envs.kernels.domain import scalar_name

CUDA_LANES = {"density": 8, "perception": 4, "adjoint": 8}
"""Lanes of a particle in each pass on CUDA: powers of two, at most 32."""

_SUM = """
    auto total = value;
#if defined(__CUDA_ARCH__)
    {part}* parts = reinterpret_cast<{part}*>(&total);
    const unsigned first = threadIdx.x & 31u & ~({lanes}u - 1u);
    const unsigned lanes = (unsigned)((1ull << {lanes}) - 1ull) << first;
    #pragma unroll
    for (unsigned i = 0; i < sizeof(total) / sizeof({part}); ++i) {{
        #pragma unroll
        for (int offset = {lanes} / 2; offset > 0; offset >>= 1) {{
            parts[i] += __shfl_xor_sync(lanes, parts[i], offset);
        }}
    }}
#endif
    return total;
"""

_LOAD = """
#if defined(__CUDA_ARCH__)
    struct alignas(16) Chunk {{ unsigned part[4]; }};
    auto entry = {entry}();
    const Chunk* from = reinterpret_cast<const Chunk*>(entries.data + index);
    unsigned* to = reinterpret_cast<unsigned*>(&entry);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(entry) / 16; ++i) {{
        const Chunk chunk = from[i];
        #pragma unroll
        for (unsigned k = 0; k < 4; ++k) to[4 * i + k] = chunk.part[k];
    }}
    return entry;
#else
    return entries.data[index];
#endif
"""


@functools.cache
def make_lane_sum(topic: str, value_type: type, scalar: type) -> Any:
    """Return a Warp function that adds a value over the lanes of a particle; all lanes get the sum.

    Args:
        topic: The pass, a key of `CUDA_LANES`.
        value_type: A scalar, vector or matrix type.
        scalar: The scalar type that it is made of.
    """
    part = {"f32": "float", "f64": "double"}[scalar_name(scalar)]

    @wp.func_native(_SUM.format(part=part, lanes=CUDA_LANES[topic]))
    def lane_sum(value: value_type) -> value_type: ...

    return lane_sum


@functools.cache
def make_wide_load(value_type: type, scalar: type) -> Any:
    """Return a Warp function that reads an entry of a flat array 16 bytes at a time on CUDA.

    Args:
        value_type: A vector or matrix type of a multiple of 16 bytes.
        scalar: The scalar type that it is made of.
    """
    part = {"f32": "float", "f64": "double"}[scalar_name(scalar)]
    shape = value_type._shape_
    kind = "vec_t" if len(shape) == 1 else "mat_t"
    entry = f"wp::{kind}<{', '.join(str(size) for size in shape)}, {part}>"

    @wp.func_native(_LOAD.format(entry=entry))
    def wide_load(entries: wp.array(dtype=value_type), index: wp.int32) -> value_type: ...

    return wide_load
