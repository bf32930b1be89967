"""The weights' gradients of the rule's network, summed on CUDA's tensor cores.

A block sums a share of the rows, each warp of it for some hidden units: it computes their values
and cotangents again, transposed, so that they are the left operands of the gradients' products.
Numbers are pairs of bfloat16, which need no scaling: the rows' scales differ, and sums run over
rows.
"""

import functools
from string import Template

import warp as wp

from npa_envs.kernels.products import BFLOAT_PAIRS, MULTIPLY

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
