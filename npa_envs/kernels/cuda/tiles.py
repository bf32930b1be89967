"""Tiles: what a warp does together for eight neighbouring particles, on tensor cores.

The rows that these particles may see are listed in a block's fast memory. Eight rows at a time,
each thread weighs two rows for one particle; weights [particles, rows] times channels [rows, W]
are then products of small matrices. A tensor core multiplies numbers of 11 bits; each number is
therefore split into two, and three products of parts come to float32 within about 2^-21.
Everything here is native CUDA, in float32, for whole warps.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.cuda.warps import CUDA_BLOCK, WARP

TILE = 8
"""Particles that a warp serves together, and rows of one product."""

LIST_ENTRIES = 96
"""Rows that a list has room for; longer ones are summed in several rounds."""

ENTRY = wp.types.vector(4, wp.float32)
"""A listed row: its position, and last the number of its channels' entry."""

CHANNELS = wp.types.vector(4, wp.float32)
"""Four adjacent channels."""

TINY = 1e-37
"""Added to squared distances, so that they have an inverse root."""

_ADDRESS = """
    __shared__ __align__(16) float4 lists[{warps} * {entries}];
    return (unsigned)__cvta_generic_to_shared(lists + threadIdx.x / 32u * {entries});
"""

_APPEND = """
    const unsigned votes = __ballot_sync(~0u, accepted);
    const unsigned before = (1u << (threadIdx.x & 31u)) - 1u;
    if (accepted) {
        const unsigned place = address + 16 * (count + __popc(votes & before));
        *reinterpret_cast<float4*>(__cvta_shared_to_generic(place)) =
            make_float4(entry[0], entry[1], entry[2], entry[3]);
    }
    return count + __popc(votes);
"""

_PAD = """
    const unsigned lane = threadIdx.x & 31u;
    if (lane < (-count & 7)) {
        *reinterpret_cast<float4*>(__cvta_shared_to_generic(address + 16 * (count + lane))) =
            make_float4(entry[0], entry[1], entry[2], entry[3]);
    }
    return (count + 7) & ~7;
"""

_CARRY = """
    __syncwarp();
    const unsigned lane = threadIdx.x & 31u;
    if ((int)lane < count - summed) {
        *reinterpret_cast<float4*>(__cvta_shared_to_generic(address + 16 * lane)) =
            *reinterpret_cast<const float4*>(
                __cvta_shared_to_generic(address + 16 * (summed + lane)));
    }
    __syncwarp();
"""

# The low bits that a tensor core ignores are taken off a number to give its second part.
_SUM = """
    __syncwarp();
    const unsigned lane = threadIdx.x & 31u;
    const unsigned first_row = lane & 3u;
    const unsigned channel = lane >> 2 << 1;
    const float* columns = channels.data + (channel < {width} ? channel : 0u);
    wp::vec_t<4, float> total = value;
    for (unsigned begin = 0; begin < count; begin += 8) {{
        unsigned weights[{kinds}][2], weight_rests[{kinds}][2];
        unsigned values[{kinds}][4], value_rests[{kinds}][4];
        #pragma unroll
        for (unsigned half = 0; half < 2; ++half) {{
            const unsigned place = address + 16 * (begin + first_row + 4 * half);
            const float4 row = *reinterpret_cast<const float4*>(__cvta_shared_to_generic(place));
            const float* from = columns + (size_t)__float_as_uint(row.w) * ({kinds} * {width});
            #pragma unroll
            for (unsigned kind = 0; kind < {kinds}; ++kind) {{
                float2 pair = *reinterpret_cast<const float2*>(from + {width} * kind);
                if (channel >= {width}) pair = make_float2(0.0f, 0.0f);
                split(pair.x, values[kind][2 * half], value_rests[kind][2 * half]);
                split(pair.y, values[kind][2 * half + 1], value_rests[kind][2 * half + 1]);
            }}
            const float other[3] = {{row.x, row.y, row.z}};
            float offset[{dims}];
            float squared = {tiny}f;
            #pragma unroll
            for (unsigned d = 0; d < {dims}; ++d) {{
                offset[d] = position[d] - other[d];
                if ({periodic}) offset[d] -= box[d] * rintf(offset[d] * inverse_box[d]);
                squared = fmaf(offset[d], offset[d], squared);
            }}
            const float falloff = __saturatef(fmaf(-squared, inverse_squared_eps, 1.0f));
            split(falloff * falloff * falloff, weights[0][half], weight_rests[0][half]);
            if ({kinds} > 1) {{
                float inverse;
                asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(squared));
                const float near = __saturatef(fmaf(-squared * inverse, inverse_eps, 1.0f));
                const float factor = near * near * inverse;
                #pragma unroll
                for (unsigned d = 0; d < {kinds} - 1; ++d) {{
                    split(factor * offset[d], weights[1 + d][half], weight_rests[1 + d][half]);
                }}
            }}
        }}
        // Three short chains of products, and none that is longer: tensor cores round towards zero.
        float sums[3][4] = {{}};
        #pragma unroll
        for (unsigned kind = 0; kind < {kinds}; ++kind) {{
            multiply(sums[0], values[kind], weight_rests[kind]);
            multiply(sums[1], value_rests[kind], weights[kind]);
            multiply(sums[2], values[kind], weights[kind]);
        }}
        #pragma unroll
        for (unsigned i = 0; i < 4; ++i) total[i] += sums[2][i] + (sums[0][i] + sums[1][i]);
    }}
    return total;
"""

_MULTIPLY = """
    const auto multiply = [](float* sums, const unsigned* a, const unsigned* b) {
        asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 "
            "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
            : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
    };
    const auto split = [](float number, unsigned& part, unsigned& rest) {
        part = __float_as_uint(number);
        rest = __float_as_uint(number - __uint_as_float(part & 0xffffe000u));
    };
"""

# A thread has two channels of two particles: neighbours swap, for four channels of one.
_SHARE = """
    const bool odd = threadIdx.x & 4u;
    const float first = __shfl_xor_sync(~0u, odd ? total[0] : total[1], 4);
    const float second = __shfl_xor_sync(~0u, odd ? total[2] : total[3], 4);
    wp::vec_t<4, float> result;
    result[0] = odd ? first : total[0];
    result[1] = odd ? second : total[2];
    result[2] = odd ? total[1] : first;
    result[3] = odd ? total[3] : second;
    return result;
"""

_SMALLEST = """
    #pragma unroll
    for (unsigned offset = 4; offset < 32; offset <<= 1) {
        value = fminf(value, __shfl_xor_sync(~0u, value, offset));
    }
    return value;
"""

# Beside the reads and writes of `lanes` and `wide`, for aligned entries that are all there: here
# a row may begin anywhere, and end before a group of columns does.
_READ = """
    constexpr int count = {count};
    wp::vec_t<count, float> result;
    const float* from = values.data + (size_t)(unsigned)row * (unsigned)values.shape[1] + column;
    if (column + count <= end && ((size_t)from & 15u) == 0) {{
        #pragma unroll
        for (int i = 0; i < count / 4; ++i) {{
            const float4 part = reinterpret_cast<const float4*>(from)[i];
            result[4 * i] = part.x;
            result[4 * i + 1] = part.y;
            result[4 * i + 2] = part.z;
            result[4 * i + 3] = part.w;
        }}
    }} else {{
        #pragma unroll
        for (int i = 0; i < count; ++i) result[i] = column + i < end ? from[i] : 0.0f;
    }}
    return result;
"""

_WRITE = """
    float* to = values.data + (size_t)(unsigned)row * (unsigned)values.shape[1] + column;
    if (column + 4 <= values.shape[1] && ((size_t)to & 15u) == 0) {
        *reinterpret_cast<float4*>(to) = make_float4(entry[0], entry[1], entry[2], entry[3]);
    } else {
        #pragma unroll
        for (int i = 0; i < 4; ++i) if (column + i < values.shape[1]) to[i] = entry[i];
    }
"""

_PREFETCH = """
    const float* from = values.data + (size_t)(unsigned)row * (unsigned)values.shape[1] + column;
    asm volatile("prefetch.global.L2 [%0];" : : "l"(from));
"""


@functools.cache
def make_tiles(space_dim: int, width: int, kinds: int, periodic: bool) -> SimpleNamespace:
    """Return the Warp functions on lists of rows of one variant.

    Args:
        space_dim: Space dimension D.
        width: Channels of a group, W, at most 16.
        kinds: Weights of a pair: 1 for the smoothing kernel, 1 + D with the spiky gradient kernel.
        periodic: Whether space is a periodic box.
    """
    vector = wp.types.vector(space_dim, wp.float32)
    names = {
        "warps": CUDA_BLOCK // WARP,
        "entries": LIST_ENTRIES,
        "dims": space_dim,
        "width": width,
        "kinds": kinds,
        "periodic": int(periodic),
        "tiny": TINY,
    }

    @wp.func_native(_ADDRESS.format(**names))
    def list_address() -> wp.uint32: ...

    @wp.func_native(_MULTIPLY + _SUM.format(**names))
    def sum_listed(
        address: wp.uint32,
        count: wp.int32,
        position: vector,
        inverse_eps: wp.float32,
        inverse_squared_eps: wp.float32,
        box: vector,
        inverse_box: vector,
        channels: wp.array(dtype=wp.float32),
        value: CHANNELS,
    ) -> CHANNELS: ...

    return SimpleNamespace(list_address=list_address, sum_listed=sum_listed)


@functools.cache
def make_read_columns(count: int) -> wp.Function:
    """Return a Warp function that reads some adjacent columns of a row, 0 from a last one on.

    Args:
        count: Columns to read, a multiple of 4.
    """
    result_type = wp.types.vector(count, wp.float32)

    @wp.func_native(_READ.format(count=count))
    def read_columns(
        values: wp.array(dtype=wp.float32, ndim=2), row: wp.int32, column: wp.int32, end: wp.int32
    ) -> result_type: ...

    return read_columns


@wp.func_native(_WRITE)
def write_columns(
    values: wp.array(dtype=wp.float32, ndim=2), row: wp.int32, column: wp.int32, entry: CHANNELS
):
    """Write four adjacent columns of a row, as far as there are so many."""
    ...


@wp.func_native(_APPEND)
def append_entry(address: wp.uint32, count: wp.int32, accepted: wp.bool, entry: ENTRY) -> wp.int32:
    """Append the entries of the threads that accept theirs; return the new length."""
    ...


@wp.func_native(_PAD)
def pad_list(address: wp.uint32, count: wp.int32, entry: ENTRY) -> wp.int32:
    """Fill a list up to a multiple of a tile; return the new length."""
    ...


@wp.func_native(_CARRY)
def carry_rest(address: wp.uint32, summed: wp.int32, count: wp.int32):
    """Move what is not summed yet, less than a tile, to a list's beginning."""
    ...


@wp.func_native(_PREFETCH)
def prefetch_columns(values: wp.array(dtype=wp.float32, ndim=2), row: wp.int32, column: wp.int32):
    """Ask for a column of a row, to be read later."""
    ...


@wp.func_native(_SHARE)
def share_tile(total: CHANNELS) -> CHANNELS:
    """Return this thread's four channels of one particle, from the sums of `sum_listed`."""
    ...


@wp.func_native(_SMALLEST)
def smallest_in_tile(value: wp.float32) -> wp.float32:
    """The smallest value of the tile's particles, four threads each."""
    ...
