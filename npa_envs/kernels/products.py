"""Products on CUDA's tensor cores, of float32 numbers that are each split into two halves.

A number is the sum of a 16-bit number and of what that leaves, again in 16 bits; of the four
products of two such pairs the three larger ones are summed: 22 bits of float16, 16 of bfloat16.
float16 has little range, so a row is first scaled by a power of two, which is exact. Tensor cores
cut off what does not fit when they add, so long sums are added outside of them.

A group of units or of rows is a fragment of PTX's `mma.m16n8k16`: lane 4 g + t of a warp holds row
g (and g + 8) and columns 2 t, 2 t + 1 (and 8 further). Two results side by side are laid out
like the left operand of a next product, so the hidden units between two products stay in registers.
"""

import functools
from string import Template

import warp as wp

UNIT_GROUP = 16
"""Hidden units of one step: the inner extent of a product."""

ROW_TARGET, UNIT_TARGET, OUTPUT_TARGET = 8, 4, 7
"""Binary exponents to which rows, hidden units' and outputs' weights are scaled, see `scale_to`.

A hidden unit then lies below 2^(8 + 1 + 4 + 1), within float16, and its error far below."""

HALF_PAIRS = """
    // The first of two numbers lies in the lower half of a word.
    const auto split = [](float a, float b, unsigned& high, unsigned& low) {
        float upper, lower;
        asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(high) : "f"(b), "f"(a));
        asm("{ .reg .b16 l, u; mov.b32 {l, u}, %2; cvt.f32.f16 %0, l; cvt.f32.f16 %1, u; }"
            : "=f"(lower), "=f"(upper) : "r"(high));
        asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(low) : "f"(b - upper), "f"(a - lower));
    };
"""

BFLOAT_PAIRS = """
    // The first of two numbers lies in the lower half of a word.
    const auto split = [](float a, float b, unsigned& high, unsigned& low) {
        asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(high) : "f"(b), "f"(a));
        const float lower = __uint_as_float(high << 16);
        const float upper = __uint_as_float(high & 0xffff0000u);
        asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(low) : "f"(b - upper), "f"(a - lower));
    };
"""

MULTIPLY = """
    using Four = float[4];  // Warp defines away what reads like a cast
    const auto multiply = [](Four& sum, const unsigned (&a)[4], unsigned b0, unsigned b1) {
        asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.$type.$type.f32 "
            "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
            : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
    };
"""

_TWO_LAYERS = """
    constexpr int steps = $steps;    // of 16 input columns
    constexpr int tiles = $tiles;    // of 8 output columns
    const unsigned lane = threadIdx.x & 31u, t = lane & 3u;
    const int count = rows.shape[0], width = rows.shape[1], out_width = output.shape[1];
    const int first = (blockIdx.x * blockDim.x + threadIdx.x) / 32 * 16 + lane / 4;
    const int units = unit_count / 16, words = (units + 7) / 8 * 4;

    unsigned high[steps][4], low[steps][4];
    float unscale[2];
    #pragma unroll
    for (int half = 0; half < 2; ++half) {
        const int row = first + 8 * half;
        const float* from = rows.data + (size_t)row * width + 4 * t;
        float part[steps][4];
        float largest = 0.0f;
        #pragma unroll
        for (int k = 0; k < steps; ++k) {
            #pragma unroll
            for (int i = 0; i < 4; ++i) part[k][i] = 0.0f;
            if (row < count && 16 * k + 4 * t < width) {
                asm volatile("ld.global.nc.L1::no_allocate.v4.f32 {%0, %1, %2, %3}, [%4];"
                    : "=f"(part[k][0]), "=f"(part[k][1]), "=f"(part[k][2]), "=f"(part[k][3])
                    : "l"(from + 16 * k));
            }
            #pragma unroll
            for (int i = 0; i < 4; ++i) largest = fmaxf(largest, fabsf(part[k][i]));
        }
        largest = fmaxf(largest, __shfl_xor_sync(~0u, largest, 1));
        largest = fmaxf(largest, __shfl_xor_sync(~0u, largest, 2));
        const unsigned exponent = min(max(__float_as_uint(largest) >> 23, $target + 1u), 254u);
        const float scale = __uint_as_float((254u + $target - exponent) << 23);
        unscale[half] = __uint_as_float((exponent - $target) << 23);
        #pragma unroll
        for (int k = 0; k < steps; ++k) {
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                split(part[k][2 * i] * scale, part[k][2 * i + 1] * scale,
                    high[k][2 * i + half], low[k][2 * i + half]);
            }
        }
    }

    float total[tiles][4] = {};
    unsigned signs[2] = {};
    const uint4* hidden = reinterpret_cast<const uint4*>(hidden_weights.data) + lane;
    const uint4* outer = reinterpret_cast<const uint4*>(output_weights.data) + lane;
    #pragma unroll 1
    for (int unit = 0; unit < units; ++unit) {
        // Three sums of products: none waits for another.
        float sum[2][4] = {}, rest[2][2][4] = {};
        #pragma unroll
        for (int k = 0; k < steps; ++k) {
            #pragma unroll
            for (int tile = 0; tile < 2; ++tile) {
                const uint4 weight = __ldg(hidden + (tile * steps + k) * 32);
                multiply(sum[tile], high[k], weight.x, weight.y);
                multiply(rest[0][tile], low[k], weight.x, weight.y);
                multiply(rest[1][tile], high[k], weight.z, weight.w);
            }
        }
        hidden += 2 * steps * 32;
        unsigned left[4], left_rest[4];
        #pragma unroll
        for (int half = 0; half < 2; ++half) {
            const int row = first + 8 * half;
            int* word = signs_of.data + (size_t)row * words + (unit / 8) * 4 + t;
            unsigned& kept = signs[half];
            $before
            #pragma unroll
            for (int tile = 0; tile < 2; ++tile) {
                float value[2];
                #pragma unroll
                for (int i = 0; i < 2; ++i) {
                    const int place = 2 * half + i;
                    value[i] = rest[0][tile][place] + rest[1][tile][place] + sum[tile][place];
                    const unsigned bit = 1u << (2 * tile + i);
                    $choose
                }
                split(value[0], value[1], left[2 * tile + half], left_rest[2 * tile + half]);
            }
            $after
        }
        #pragma unroll
        for (int tile = 0; tile < tiles; ++tile) {
            const uint4 weight = __ldg(outer + tile * 32);
            float part[4] = {};
            multiply(part, left_rest, weight.x, weight.y);
            multiply(part, left, weight.z, weight.w);
            multiply(part, left, weight.x, weight.y);
            #pragma unroll
            for (int i = 0; i < 4; ++i) total[tile][i] += part[i];
        }
        outer += tiles * 32;
    }

    #pragma unroll
    for (int tile = 0; tile < tiles; ++tile) {
        const int column = 8 * tile + 2 * t;
        if (column >= out_width) continue;
        const float2 factor = *reinterpret_cast<const float2*>(output_unscale.data + column);
        #pragma unroll
        for (int half = 0; half < 2; ++half) {
            const int row = first + 8 * half;
            if (row >= count) continue;
            float2 pair;
            pair.x = total[tile][2 * half] * factor.x * unscale[half];
            pair.y = total[tile][2 * half + 1] * factor.y * unscale[half];
            *reinterpret_cast<float2*>(output.data + (size_t)row * out_width + column) = pair;
        }
    }
"""

# A hidden unit that is NaN stays so, as it does in torch.
_RECTIFY = {
    "before": "",
    "choose": "if (value[i] <= 0.0f) value[i] = 0.0f;",
    "after": "",
}

_RECTIFY_AND_NOTE = {
    "before": "",
    "choose": """
        if (value[i] <= 0.0f) value[i] = 0.0f;
        else kept |= bit << (4 * (unit & 7));
    """,
    "after": """
        if ((unit & 7) == 7 || unit + 1 == units) {
            if (row < count) *word = kept;
            kept = 0u;
        }
    """,
}

_MASK = {
    "before": "if ((unit & 7) == 0 && row < count) kept = *word;",
    "choose": "if (!(kept & bit)) value[i] = 0.0f;",
    "after": "kept >>= 4;",
}


@wp.func_native("""
    const unsigned exponent = min(max(__float_as_uint(size) >> 23, target + 1u), 254u);
    return __uint_as_float((254u + target - exponent) << 23);
""")
def scale_to(size: wp.float32, target: wp.uint32) -> wp.float32:
    """The power of two by which a positive size comes to lie in [2^target, 2^(target + 1))."""
    ...


@functools.cache
def make_two_layers(steps: int, tiles: int, mode: str) -> wp.Function:
    """Return the Warp function of two products, row by row, for 16 rows a warp.

    Args:
        steps: Groups of 16 input columns.
        tiles: Groups of 8 output columns.
        mode: Between the products, "rectify" hidden units, "note" which are positive too, or
            "mask" by what was noted.

    The function takes a number of hidden units H, a multiple of 16; rows [K, width] of at most 16
    `steps` columns; both layers' fragments, as `arrange_hidden` and `arrange_output` leave them;
    the outputs' scales [8 `tiles`]; for each row, 4 words of the signs of every 128 hidden units,
    [K, 4 ceil(H / 128)], which "note" writes and "mask" reads; and writes outputs [K, out_width]
    of at most 8 `tiles` columns. All are dimensionless. Rows are read 16 bytes at a time and
    outputs written 8 at a time: rows must be dense, begin at a multiple of 16 bytes and have a
    multiple of 4 columns, outputs of 8 bytes and 2 columns; fragments begin at 16 bytes, too.
    """
    between = {"rectify": _RECTIFY, "note": _RECTIFY_AND_NOTE, "mask": _MASK}[mode]
    body = Template(HALF_PAIRS + MULTIPLY + _TWO_LAYERS).substitute(
        between, type="f16", steps=steps, tiles=tiles, target=ROW_TARGET
    )

    @wp.func_native(body)
    def two_layers(
        unit_count: wp.int32,
        rows: wp.array(dtype=wp.float32, ndim=2),
        hidden_weights: wp.array(dtype=wp.float16),
        output_weights: wp.array(dtype=wp.float16),
        output_unscale: wp.array(dtype=wp.float32),
        signs_of: wp.array(dtype=wp.int32, ndim=2),
        output: wp.array(dtype=wp.float32, ndim=2),
    ): ...

    return two_layers
