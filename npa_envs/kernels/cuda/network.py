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
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.cuda.warps import WARP

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


# The weights' gradients of the rule's network, summed on CUDA's tensor cores.
#
# A block sums a share of the rows, each warp of it for some hidden units: it computes their
# values and cotangents again, transposed, so that they are the left operands of the gradients'
# products. Numbers are pairs of bfloat16, which need no scaling: the rows' scales differ, and
# sums run over rows.


ROW_TILE = 32
"""Rows that a block sums weight gradients of between two barriers."""

WARP_UNITS = 32
"""Hidden units whose weight gradients a warp sums."""

_WEIGHT_SUMS = """
    constexpr int steps = $steps;            // of 16 columns of a row
    constexpr int tiles = $tiles;            // of 8
    constexpr int out_steps = $out_steps;    // of 16 columns of a cotangent
    constexpr int out_tiles = $out_tiles;    // of 8
    constexpr int warps = $warps;
    constexpr int pitch = 16 * steps + 8, out_pitch = 16 * out_steps + 8;
    constexpr int words = $words;
    constexpr int chunks = 4 * (steps + out_steps);  // of 4 numbers, in a row of both
    __shared__ float4 arriving[$rows * chunks];
    __shared__ __align__(16) unsigned short inputs[2][$rows * pitch];
    __shared__ __align__(16) unsigned short bars[2][$rows * out_pitch];

    const unsigned lane = threadIdx.x & 31u, t = lane & 3u, g = lane >> 2;
    const int width = rows.shape[1], out_width = output_bar.shape[1];
    const int share = blockIdx.x / $unit_blocks;
    const int base = ((blockIdx.x % $unit_blocks) * warps + threadIdx.x / 32) * 32;
    const int begin = share * share_rows, end = min(begin + share_rows, rows.shape[0]);

    // Rows come in while the ones before them are summed. A thread splits what it asked for.
    const auto ask_for_rows = [&](int first) {
        #pragma unroll
        for (int i = threadIdx.x; i < $rows * chunks; i += 32 * warps) {
            const int row = first + i / chunks, chunk = i % chunks;
            const bool is_input = chunk < 4 * steps;
            const int column = 4 * (is_input ? chunk : chunk - 4 * steps);
            const int columns = is_input ? width : out_width;
            const bool inside = row < end && column < columns;
            const float* from = is_input ? rows.data : output_bar.data;
            from += inside ? (size_t)row * columns + column : 0;
            asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;"
                :: "r"((unsigned)__cvta_generic_to_shared(arriving + i)), "l"(from),
                "r"(inside ? 16 : 0) : "memory");
        }
        asm volatile("cp.async.commit_group;" ::: "memory");
    };
    const auto split_rows = [&]() {
        asm volatile("cp.async.wait_group 0;" ::: "memory");
        #pragma unroll
        for (int i = threadIdx.x; i < $rows * chunks; i += 32 * warps) {
            const int row = i / chunks, chunk = i % chunks;
            const float4 part = arriving[i];
            uint2 upper, lower;
            split(part.x, part.y, upper.x, lower.x);
            split(part.z, part.w, upper.y, lower.y);
            const bool is_input = chunk < 4 * steps;
            const int to = is_input ? row * pitch + 4 * chunk
                : row * out_pitch + 4 * (chunk - 4 * steps);
            *reinterpret_cast<uint2*>((is_input ? inputs[0] : bars[0]) + to) = upper;
            *reinterpret_cast<uint2*>((is_input ? inputs[1] : bars[1]) + to) = lower;
        }
    };
    const auto fetch = [](unsigned (&to)[4], const unsigned short* from) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
            : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
            : "r"((unsigned)__cvta_generic_to_shared(from)) : "memory");
    };
    const auto fetch_turned = [](unsigned (&to)[4], const unsigned short* from) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
            : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
            : "r"((unsigned)__cvta_generic_to_shared(from)) : "memory");
    };
    // Where this lane's part of 16 rows and 16 columns begins, as it is and turned.
    const int straight = (lane & 7) + (lane >> 4) * 8, straight_column = (lane >> 3 & 1) * 8;
    const int turned = lane & 15, turned_column = (lane >> 4) * 8;

    // Adds the transposed product of two groups of 16 units and of a fragment's rows and columns.
    using Units = Four[2][2];
    const auto multiply_units = [&](Units& sum, const uint4* weights, int count, int k,
                                    const unsigned (&high)[4], const unsigned (&low)[4]) {
        #pragma unroll
        for (int group = 0; group < 2; ++group) {
            const uint4* from = weights + ((group * count + k) * 2) * 32;
            const uint4 upper = __ldg(from), lower = __ldg(from + 32);
            const unsigned a[4] = {upper.x, upper.y, upper.z, upper.w};
            const unsigned rest[4] = {lower.x, lower.y, lower.z, lower.w};
            #pragma unroll
            for (int tile = 0; tile < 2; ++tile) {
                multiply(sum[group][tile], rest, high[2 * tile], high[2 * tile + 1]);
                multiply(sum[group][tile], a, low[2 * tile], low[2 * tile + 1]);
                multiply(sum[group][tile], a, high[2 * tile], high[2 * tile + 1]);
            }
        }
    };
    const auto add_product = [&](Four& total, const unsigned (&a)[4],
                                 const unsigned (&rest)[4], const unsigned (&high)[4],
                                 const unsigned (&low)[4], int tile) {
        float part[4] = {};
        multiply(part, rest, high[2 * tile], high[2 * tile + 1]);
        multiply(part, a, low[2 * tile], low[2 * tile + 1]);
        multiply(part, a, high[2 * tile], high[2 * tile + 1]);
        #pragma unroll
        for (int i = 0; i < 4; ++i) total[i] += part[i];
    };

    float hidden_total[2][tiles][4] = {}, output_total[2][out_tiles][4] = {};
    const uint4* hidden =
        reinterpret_cast<const uint4*>(hidden_weights.data) + base / 16 * steps * 64 + lane;
    const uint4* outer =
        reinterpret_cast<const uint4*>(output_weights.data) + base / 16 * out_steps * 64 + lane;
    const int* signs = signs_of.data + base / 128 * 4 + g / 2;
    ask_for_rows(begin);
    #pragma unroll 1
    for (int first = begin; first < end; first += $rows) {
        __syncthreads();
        split_rows();
        __syncthreads();
        if (first + $rows < end) ask_for_rows(first + $rows);
        #pragma unroll 1
        for (int row = 0; row < $rows && first + row < end; row += 16) {
            unsigned kept[2][2];
            #pragma unroll
            for (int i = 0; i < 4; ++i) {
                const int at = first + row + 8 * (i / 2) + 2 * t + i % 2;
                const int word = at < end ? __ldg(signs + (size_t)at * words) : 0;
                kept[i / 2][i % 2] = (unsigned)word >> (base % 128 / 4 + (g & 1u));
            }
            float sum[2][2][4] = {}, bar[2][2][4] = {};
            #pragma unroll
            for (int k = 0; k < steps; ++k) {
                unsigned high[4], low[4];
                const int from = (row + straight) * pitch + 16 * k + straight_column;
                fetch(high, inputs[0] + from);
                fetch(low, inputs[1] + from);
                multiply_units(sum, hidden, steps, k, high, low);
            }
            #pragma unroll
            for (int k = 0; k < out_steps; ++k) {
                unsigned high[4], low[4];
                const int from = (row + straight) * out_pitch + 16 * k + straight_column;
                fetch(high, bars[0] + from);
                fetch(low, bars[1] + from);
                multiply_units(bar, outer, out_steps, k, high, low);
            }
            unsigned units[2][4], units_rest[2][4], unit_bars[2][4], unit_bars_rest[2][4];
            #pragma unroll
            for (int tile = 0; tile < 2; ++tile) {
                #pragma unroll
                for (int group = 0; group < 2; ++group) {
                    #pragma unroll
                    for (int half = 0; half < 2; ++half) {
                        float unit[2], unit_bar[2];
                        #pragma unroll
                        for (int i = 0; i < 2; ++i) {
                            const bool on = kept[tile][i] >> (4 * group + 2 * half) & 1u;
                            unit[i] = on ? sum[group][tile][2 * half + i] : 0.0f;
                            unit_bar[i] = on ? bar[group][tile][2 * half + i] : 0.0f;
                        }
                        const int word = 2 * tile + half;
                        split(unit[0], unit[1], units[group][word], units_rest[group][word]);
                        split(unit_bar[0], unit_bar[1],
                            unit_bars[group][word], unit_bars_rest[group][word]);
                    }
                }
            }
            #pragma unroll
            for (int tile = 0; tile < tiles; ++tile) {
                unsigned high[4], low[4];
                if (tile % 2 == 0) {
                    const int from = (row + turned) * pitch + 8 * tile + turned_column;
                    fetch_turned(high, inputs[0] + from);
                    fetch_turned(low, inputs[1] + from);
                    #pragma unroll
                    for (int other = 0; other < 2 && tile + other < tiles; ++other) {
                        #pragma unroll
                        for (int group = 0; group < 2; ++group) {
                            add_product(hidden_total[group][tile + other], unit_bars[group],
                                unit_bars_rest[group], high, low, other);
                        }
                    }
                }
            }
            #pragma unroll
            for (int tile = 0; tile < out_tiles; tile += 2) {
                unsigned high[4], low[4];
                const int from = (row + turned) * out_pitch + 8 * tile + turned_column;
                fetch_turned(high, bars[0] + from);
                fetch_turned(low, bars[1] + from);
                #pragma unroll
                for (int other = 0; other < 2 && tile + other < out_tiles; ++other) {
                    #pragma unroll
                    for (int group = 0; group < 2; ++group) {
                        add_product(output_total[group][tile + other], units[group],
                            units_rest[group], high, low, other);
                    }
                }
            }
        }
    }

    float* to = partial_sums.data + (size_t)share * partial_sums.shape[1];
    #pragma unroll
    for (int group = 0; group < 2; ++group) {
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
            const int unit = base + 16 * group + g + i / 2 * 8, place = 2 * t + i % 2;
            #pragma unroll
            for (int tile = 0; tile < tiles; ++tile) {
                const int column = 8 * tile + place;
                if (column < width) to[unit * width + column] = hidden_total[group][tile][i];
            }
            float* output_to = to + unit_count * width + unit;
            #pragma unroll
            for (int tile = 0; tile < out_tiles; ++tile) {
                const int column = 8 * tile + place;
                if (column >= out_width) continue;
                output_to[column * unit_count] = output_total[group][tile][i];
            }
        }
    }
"""

_ADD_SHARES = """
    __shared__ float sums[4][32];
    const int column = blockIdx.x * 32 + threadIdx.x % 32, warp = threadIdx.x / 32;
    const int count = partial_sums.shape[0], width = partial_sums.shape[1];
    float sum = 0.0f;
    if (column < width) {
        const float* from = partial_sums.data + column;
        #pragma unroll 8
        for (int share = warp; share < count; share += 4) sum += from[(size_t)share * width];
    }
    sums[warp][threadIdx.x % 32] = sum;
    __syncthreads();
    if (warp == 0 && column < width) {
        const int i = threadIdx.x;
        total.data[column] = (sums[0][i] + sums[1][i]) + (sums[2][i] + sums[3][i]);
    }
"""


@functools.cache
def make_weight_sums(
    steps: int, tiles: int, out_tiles: int, warps: int, unit_blocks: int, words: int
) -> wp.Function:
    """Return the Warp function that sums the weights' gradients over a share of the rows.

    Args:
        steps: Groups of 16 columns of a row.
        tiles: Groups of 8 columns of a row.
        out_tiles: Groups of 8 columns of an update.
        warps: Warps of a block, each for `WARP_UNITS` hidden units.
        unit_blocks: Blocks that serve the hidden units of one share of rows.
        words: Words of a row's signs.
    """
    body = Template(BFLOAT_PAIRS + MULTIPLY + _WEIGHT_SUMS).substitute(
        type="bf16",
        rows=ROW_TILE,
        steps=steps,
        tiles=tiles,
        out_steps=-(-out_tiles // 2),
        out_tiles=out_tiles,
        warps=warps,
        unit_blocks=unit_blocks,
        words=words,
    )

    @wp.func_native(body)
    def weight_sums(
        unit_count: wp.int32,
        share_rows: wp.int32,
        rows: wp.array(dtype=wp.float32, ndim=2),
        output_bar: wp.array(dtype=wp.float32, ndim=2),
        signs_of: wp.array(dtype=wp.int32, ndim=2),
        hidden_weights: wp.array(dtype=wp.bfloat16),
        output_weights: wp.array(dtype=wp.bfloat16),
        partial_sums: wp.array(dtype=wp.float32, ndim=2),
    ): ...

    return weight_sums


@wp.func_native(_ADD_SHARES)
def add_partial_sums(
    partial_sums: wp.array(dtype=wp.float32, ndim=2), total: wp.array(dtype=wp.float32)
):
    """Add what the shares of rows summed, in a fixed order; blocks of 128 threads, 32 columns."""
    ...


# The rule's network on CUDA in float32: fused kernels, and the weights laid out for them.


LAYER_REGISTERS, GRADIENT_REGISTERS = 168, 255
"""Registers of a thread of the two kinds of kernels."""


@functools.cache
def arrangement_kernels() -> SimpleNamespace:
    """Return the kernels that lay out weights in the order in which the lanes of a warp read them.

    Each number is split in two halves; `products` says how fragments lie in a warp.
    """
    module = wp.get_module("npa_envs.kernels.network_arrangement")

    @wp.kernel(enable_backward=False, module=module)
    def arrange_hidden(
        weights: wp.array(dtype=wp.float32, ndim=2),
        # outputs
        unit_unscale: wp.array(dtype=wp.float32),
        fragments: wp.array(dtype=wp.float16),
    ):
        """Scale and lay out a first layer [H, width]; threads (H / 8, width / 16, lanes)."""
        tile, step, lane = wp.tid()
        unit = 8 * tile + lane / 4
        size = wp.float32(0.0)
        for column in range(weights.shape[1]):
            size += wp.abs(weights[unit, column])
        scale = scale_to(size, wp.uint32(wp.static(UNIT_TARGET)))
        if step == 0 and lane % 4 == 0:
            unit_unscale[unit] = wp.float32(1.0) / scale
        first = ((tile * ((weights.shape[1] + 15) / 16) + step) * wp.static(WARP) + lane) * 8
        for i in range(4):
            column = 16 * step + lane % 4 * 4 + i
            value = wp.float32(0.0)
            if column < weights.shape[1]:
                value = weights[unit, column] * scale
            high = wp.float16(value)
            fragments[first + i] = high
            fragments[first + 4 + i] = wp.float16(value - wp.float32(high))

    @wp.kernel(enable_backward=False, module=module)
    def arrange_output(
        weights: wp.array(dtype=wp.float32, ndim=2),
        unit_unscale: wp.array(dtype=wp.float32),
        # outputs
        output_unscale: wp.array(dtype=wp.float32),
        fragments: wp.array(dtype=wp.float16),
    ):
        """Scale and lay out a second layer [width, H]; threads (H / 16, width / 8, lanes)."""
        step, tile, lane = wp.tid()
        column = 8 * tile + lane / 4
        size = wp.float32(0.0)
        if column < weights.shape[0]:
            for unit in range(weights.shape[1]):
                size = wp.max(size, wp.abs(weights[column, unit] * unit_unscale[unit]))
        scale = scale_to(size, wp.uint32(wp.static(OUTPUT_TARGET)))
        if step == 0 and lane % 4 == 0:
            output_unscale[column] = wp.float32(1.0) / scale
        first = ((step * ((weights.shape[0] + 7) / 8) + tile) * wp.static(WARP) + lane) * 8
        for i in range(4):
            unit = 16 * step + lane % 4 * 2 + i % 2 + i / 2 * 8
            value = wp.float32(0.0)
            if column < weights.shape[0]:
                value = weights[column, unit] * unit_unscale[unit] * scale
            high = wp.float16(value)
            fragments[first + i] = high
            fragments[first + 4 + i] = wp.float16(value - wp.float32(high))

    @wp.kernel(enable_backward=False, module=module)
    def arrange_left(
        weights: wp.array(dtype=wp.float32, ndim=2),
        # outputs
        fragments: wp.array(dtype=wp.bfloat16),
    ):
        """Lay out [H, width] as a left operand; threads (H / 16, width / 16, lanes)."""
        group, step, lane = wp.tid()
        place = (group * ((weights.shape[1] + 15) / 16) + step) * 2 * wp.static(WARP)
        first = (place + lane) * 8
        for i in range(8):
            unit = 16 * group + lane / 4 + i / 2 % 2 * 8
            column = 16 * step + lane % 4 * 2 + i % 2 + i / 4 * 8
            value = wp.float32(0.0)
            if column < weights.shape[1]:
                value = weights[unit, column]
            high = wp.bfloat16(value)
            fragments[first + i] = high
            fragments[first + 8 * wp.static(WARP) + i] = wp.bfloat16(value - wp.float32(high))

    return SimpleNamespace(
        arrange_hidden=arrange_hidden, arrange_output=arrange_output, arrange_left=arrange_left
    )


@functools.cache
def two_layer_kernel(steps: int, tiles: int, mode: str) -> wp.Kernel:
    """Return the kernel of two products, row by row: `make_two_layers` names the variants."""
    name = f"npa_envs.kernels.network_{mode}_{steps}_{tiles}"
    two_layers = make_two_layers(steps, tiles, mode)

    @wp.kernel(
        enable_backward=False, module=wp.get_module(name), cuda_max_registers=LAYER_REGISTERS
    )
    def network_layers(
        unit_count: wp.int32,
        rows: wp.array(dtype=wp.float32, ndim=2),
        hidden_weights: wp.array(dtype=wp.float16),
        output_weights: wp.array(dtype=wp.float16),
        output_unscale: wp.array(dtype=wp.float32),
        signs: wp.array(dtype=wp.int32, ndim=2),
        # outputs
        output: wp.array(dtype=wp.float32, ndim=2),
    ):
        """Map rows through both layers; the hidden units between stay in registers."""
        two_layers(unit_count, rows, hidden_weights, output_weights, output_unscale, signs, output)

    return network_layers


@functools.cache
def weight_gradient_kernels(
    steps: int, tiles: int, out_tiles: int, warps: int, unit_blocks: int, words: int
) -> SimpleNamespace:
    """Return the kernels of the weights' gradients: `make_weight_sums` names the variants."""
    variant = f"{steps}_{tiles}_{out_tiles}_{warps}_{unit_blocks}_{words}"
    module = wp.get_module(f"npa_envs.kernels.network_gradients_{variant}")
    weight_sums = make_weight_sums(steps, tiles, out_tiles, warps, unit_blocks, words)

    @wp.kernel(enable_backward=False, module=module, cuda_max_registers=GRADIENT_REGISTERS)
    def sum_weight_gradients(
        unit_count: wp.int32,
        share_rows: wp.int32,
        rows: wp.array(dtype=wp.float32, ndim=2),
        output_bar: wp.array(dtype=wp.float32, ndim=2),
        signs: wp.array(dtype=wp.int32, ndim=2),
        hidden_weights: wp.array(dtype=wp.bfloat16),
        output_weights: wp.array(dtype=wp.bfloat16),
        # outputs
        partial_sums: wp.array(dtype=wp.float32, ndim=2),
    ):
        """Sum both weights' gradients over each share of the rows."""
        weight_sums(
            unit_count,
            share_rows,
            rows,
            output_bar,
            signs,
            hidden_weights,
            output_weights,
            partial_sums,
        )

    @wp.kernel(enable_backward=False, module=module)
    def add_shares(
        partial_sums: wp.array(dtype=wp.float32, ndim=2),
        # outputs
        total: wp.array(dtype=wp.float32),
    ):
        """Add the shares' sums."""
        add_partial_sums(partial_sums, total)

    return SimpleNamespace(sum_weight_gradients=sum_weight_gradients, add_shares=add_shares)
