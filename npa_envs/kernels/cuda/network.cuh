// For cuda/network.py: a network of two layers, and gradients of its weights, on tensor cores.
//
// A float32 number is split: a 16-bit number and the remainder in 16 bits. Of the four products
// of two such pairs the three larger ones are summed: 22 bits with float16, 16 with bfloat16. Tensor
// cores truncate when they add, so long sums are added outside of them.
//
// A group of units or of rows is a fragment of PTX's `mma.m16n8k16`: lane 4 g + t of a warp holds
// row g (and g + 8) and columns 2 t, 2 t + 1 (and 8 further). Two results side by side are laid out
// like the left operand of a next product, so hidden units stay in registers between two products.
// Names: `x_bar` = dL/dx, the gradient of the loss L with respect to x.

namespace npa {

// What is done to hidden units between two products.
enum HiddenMode { RELU, RELU_STORE_MASK, APPLY_MASK };

// The first of two numbers is in the lower half of a word.
__device__ inline void split_half(float a, float b, unsigned& high, unsigned& low)
{
    float upper, lower;
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(high) : "f"(b), "f"(a));
    asm("{ .reg .b16 l, u; mov.b32 {l, u}, %2; cvt.f32.f16 %0, l; cvt.f32.f16 %1, u; }"
        : "=f"(lower), "=f"(upper) : "r"(high));
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(low) : "f"(b - upper), "f"(a - lower));
}

__device__ inline void split_bfloat(float a, float b, unsigned& high, unsigned& low)
{
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(high) : "f"(b), "f"(a));
    const float lower = __uint_as_float(high << 16);
    const float upper = __uint_as_float(high & 0xffff0000u);
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(low) : "f"(b - upper), "f"(a - lower));
}

__device__ inline void multiply_half(
    float (&sum)[4], const unsigned (&a)[4], unsigned b0, unsigned b1)
{
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
        "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

__device__ inline void multiply_bfloat(
    float (&sum)[4], const unsigned (&a)[4], unsigned b0, unsigned b1)
{
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 "
        "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

__device__ inline unsigned scale_exponent(float size, unsigned target)
{
    return min(max(__float_as_uint(size) >> 23, target + 1u), 254u);
}

// The power of two that scales a positive number into [2^target, 2^(target + 1)).
__device__ inline float scale_to(float size, unsigned target)
{
    return __uint_as_float((254u + target - scale_exponent(size, target)) << 23);
}

// STEPS: groups of 16 input columns. TILES: groups of 8 output columns.
template <int STEPS, int TILES, HiddenMode MODE, unsigned TARGET, typename Half>
__device__ inline void two_layers(
    int unit_count, const wp::array_t<float>& rows, const wp::array_t<Half>& hidden_weights,
    const wp::array_t<Half>& output_weights, const wp::array_t<float>& output_unscale,
    const wp::array_t<int>& signs_of, const wp::array_t<float>& output)
{
    const unsigned lane = threadIdx.x & 31u, t = lane & 3u;
    const int count = rows.shape[0], width = rows.shape[1], out_width = output.shape[1];
    const int first = (blockIdx.x * blockDim.x + threadIdx.x) / 32 * 16 + lane / 4;
    const int units = unit_count / 16, words = (units + 7) / 8 * 4;

    unsigned high[STEPS][4], low[STEPS][4];
    float unscale[2];
    #pragma unroll
    for (int half = 0; half < 2; ++half) {
        const int row = first + 8 * half;
        const float* from = rows.data + (size_t)row * width + 4 * t;
        float values[STEPS][4];
        float largest = 0.0f;
        #pragma unroll
        for (int k = 0; k < STEPS; ++k) {
            #pragma unroll
            for (int i = 0; i < 4; ++i) values[k][i] = 0.0f;
            if (row < count && 16 * k + 4 * t < width) {
                asm volatile("ld.global.L1::no_allocate.v4.f32 {%0, %1, %2, %3}, [%4];"
                    : "=f"(values[k][0]), "=f"(values[k][1]), "=f"(values[k][2]), "=f"(values[k][3])
                    : "l"(from + 16 * k));
            }
            #pragma unroll
            for (int i = 0; i < 4; ++i) largest = fmaxf(largest, fabsf(values[k][i]));
        }
        largest = fmaxf(largest, __shfl_xor_sync(~0u, largest, 1));
        largest = fmaxf(largest, __shfl_xor_sync(~0u, largest, 2));
        const float scale = scale_to(largest, TARGET);
        unscale[half] = __uint_as_float((scale_exponent(largest, TARGET) - TARGET) << 23);
        #pragma unroll
        for (int k = 0; k < STEPS; ++k) {
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                split_half(values[k][2 * i] * scale, values[k][2 * i + 1] * scale,
                    high[k][2 * i + half], low[k][2 * i + half]);
            }
        }
    }

    float total[TILES][4] = {};
    unsigned signs[2] = {};
    const uint4* hidden_weight = reinterpret_cast<const uint4*>(hidden_weights.data) + lane;
    const uint4* output_weight = reinterpret_cast<const uint4*>(output_weights.data) + lane;
    #pragma unroll 1
    for (int unit = 0; unit < units; ++unit) {
        // Three independent sums of products: of high parts, and small ones with a low part.
        float sum[2][4] = {}, small[2][2][4] = {};
        #pragma unroll
        for (int k = 0; k < STEPS; ++k) {
            #pragma unroll
            for (int tile = 0; tile < 2; ++tile) {
                const uint4 weight = hidden_weight[(tile * STEPS + k) * 32];
                multiply_half(sum[tile], high[k], weight.x, weight.y);
                multiply_half(small[0][tile], low[k], weight.x, weight.y);
                multiply_half(small[1][tile], high[k], weight.z, weight.w);
            }
        }
        hidden_weight += 2 * STEPS * 32;
        unsigned high_units[4], low_units[4];
        #pragma unroll
        for (int half = 0; half < 2; ++half) {
            const int row = first + 8 * half;
            int* word = signs_of.data + (size_t)row * words + (unit / 8) * 4 + t;
            unsigned& mask = signs[half];
            if constexpr (MODE == APPLY_MASK) {
                if ((unit & 7) == 0 && row < count) mask = *word;
            }
            #pragma unroll
            for (int tile = 0; tile < 2; ++tile) {
                float value[2];
                #pragma unroll
                for (int i = 0; i < 2; ++i) {
                    const int entry = 2 * half + i;
                    value[i] = small[0][tile][entry] + small[1][tile][entry] + sum[tile][entry];
                    const unsigned bit = 1u << (2 * tile + i);
                    if constexpr (MODE == APPLY_MASK) {
                        if (!(mask & bit)) value[i] = 0.0f;
                    } else if (value[i] <= 0.0f) {
                        // A hidden unit that is NaN stays so, as it does in torch.
                        value[i] = 0.0f;
                    } else if (MODE == RELU_STORE_MASK) {
                        mask |= bit << (4 * (unit & 7));
                    }
                }
                split_half(
                    value[0], value[1], high_units[2 * tile + half], low_units[2 * tile + half]);
            }
            if constexpr (MODE == RELU_STORE_MASK) {
                if ((unit & 7) == 7 || unit + 1 == units) {
                    if (row < count) *word = mask;
                    mask = 0u;
                }
            }
            if constexpr (MODE == APPLY_MASK) mask >>= 4;
        }
        #pragma unroll
        for (int tile = 0; tile < TILES; ++tile) {
            const uint4 weight = output_weight[tile * 32];
            float product[4] = {};
            multiply_half(product, low_units, weight.x, weight.y);
            multiply_half(product, high_units, weight.z, weight.w);
            multiply_half(product, high_units, weight.x, weight.y);
            #pragma unroll
            for (int i = 0; i < 4; ++i) total[tile][i] += product[i];
        }
        output_weight += TILES * 32;
    }

    #pragma unroll
    for (int tile = 0; tile < TILES; ++tile) {
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
}

// STEPS and TILES: groups of 16 and of 8 columns of a row. OUT_TILES: groups of 8 columns of an
// update. ROWS: rows between two barriers. WORDS: words of a row's signs.
template <int STEPS, int TILES, int OUT_TILES, int WARPS, int UNIT_BLOCKS, int WORDS, int ROWS,
    typename Bfloat>
__device__ inline void weight_sums(
    int unit_count, int part_rows, const wp::array_t<float>& rows,
    const wp::array_t<float>& output_bar, const wp::array_t<int>& signs_of,
    const wp::array_t<Bfloat>& hidden_weights,
    const wp::array_t<Bfloat>& output_weights, const wp::array_t<float>& partial_sums)
{
    constexpr int out_steps = (OUT_TILES + 1) / 2;  // of 16 columns of a cotangent
    constexpr int pitch = 16 * STEPS + 8, out_pitch = 16 * out_steps + 8;
    constexpr int chunks = 4 * (STEPS + out_steps);  // of 4 numbers, in a row of both
    __shared__ float4 arriving[ROWS * chunks];
    __shared__ __align__(16) unsigned short inputs[2][ROWS * pitch];
    __shared__ __align__(16) unsigned short bars[2][ROWS * out_pitch];

    const unsigned lane = threadIdx.x & 31u, t = lane & 3u, g = lane >> 2;
    const int width = rows.shape[1], out_width = output_bar.shape[1];
    const int range = blockIdx.x / UNIT_BLOCKS;
    const int base = ((blockIdx.x % UNIT_BLOCKS) * WARPS + threadIdx.x / 32) * 32;
    const int begin = range * part_rows, end = min(begin + part_rows, rows.shape[0]);

    // Rows are loaded while the previous ones are summed. A thread splits the numbers it loads.
    const auto ask_for_rows = [&](int first) {
        #pragma unroll
        for (int i = threadIdx.x; i < ROWS * chunks; i += 32 * WARPS) {
            const int row = first + i / chunks, chunk = i % chunks;
            const bool is_input = chunk < 4 * STEPS;
            const int column = 4 * (is_input ? chunk : chunk - 4 * STEPS);
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
        for (int i = threadIdx.x; i < ROWS * chunks; i += 32 * WARPS) {
            const int row = i / chunks, chunk = i % chunks;
            const float4 part = arriving[i];
            uint2 upper, lower;
            split_bfloat(part.x, part.y, upper.x, lower.x);
            split_bfloat(part.z, part.w, upper.y, lower.y);
            const bool is_input = chunk < 4 * STEPS;
            const int to = is_input ? row * pitch + 4 * chunk
                : row * out_pitch + 4 * (chunk - 4 * STEPS);
            *reinterpret_cast<uint2*>((is_input ? inputs[0] : bars[0]) + to) = upper;
            *reinterpret_cast<uint2*>((is_input ? inputs[1] : bars[1]) + to) = lower;
        }
    };
    const auto fetch = [](unsigned (&to)[4], const unsigned short* from) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
            : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
            : "r"((unsigned)__cvta_generic_to_shared(from)) : "memory");
    };
    const auto fetch_transposed = [](unsigned (&to)[4], const unsigned short* from) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
            : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
            : "r"((unsigned)__cvta_generic_to_shared(from)) : "memory");
    };
    // Where this lane's part of 16 rows and 16 columns begins, as stored and transposed.
    const int straight = (lane & 7) + (lane >> 4) * 8, straight_column = (lane >> 3 & 1) * 8;
    const int transposed = lane & 15, transposed_column = (lane >> 4) * 8;

    // Adds the transposed product of two groups of 16 units and of a fragment's rows and columns.
    using Units = float[2][2][4];
    const auto multiply_units = [&](Units& sum, const uint4* weights, int count, int k,
                                    const unsigned (&high)[4], const unsigned (&low)[4]) {
        #pragma unroll
        for (int group = 0; group < 2; ++group) {
            const uint4* from = weights + ((group * count + k) * 2) * 32;
            const uint4 upper = from[0], lower = from[32];
            const unsigned a[4] = {upper.x, upper.y, upper.z, upper.w};
            const unsigned rest[4] = {lower.x, lower.y, lower.z, lower.w};
            #pragma unroll
            for (int tile = 0; tile < 2; ++tile) {
                multiply_bfloat(sum[group][tile], rest, high[2 * tile], high[2 * tile + 1]);
                multiply_bfloat(sum[group][tile], a, low[2 * tile], low[2 * tile + 1]);
                multiply_bfloat(sum[group][tile], a, high[2 * tile], high[2 * tile + 1]);
            }
        }
    };
    const auto add_product = [&](float (&total)[4], const unsigned (&a)[4],
                                 const unsigned (&rest)[4], const unsigned (&high)[4],
                                 const unsigned (&low)[4], int tile) {
        float part[4] = {};
        multiply_bfloat(part, rest, high[2 * tile], high[2 * tile + 1]);
        multiply_bfloat(part, a, low[2 * tile], low[2 * tile + 1]);
        multiply_bfloat(part, a, high[2 * tile], high[2 * tile + 1]);
        #pragma unroll
        for (int i = 0; i < 4; ++i) total[i] += part[i];
    };

    float hidden_total[2][TILES][4] = {}, output_total[2][OUT_TILES][4] = {};
    const uint4* hidden =
        reinterpret_cast<const uint4*>(hidden_weights.data) + base / 16 * STEPS * 64 + lane;
    const uint4* outer =
        reinterpret_cast<const uint4*>(output_weights.data) + base / 16 * out_steps * 64 + lane;
    const int* signs = signs_of.data + base / 128 * 4 + g / 2;
    ask_for_rows(begin);
    #pragma unroll 1
    for (int first = begin; first < end; first += ROWS) {
        __syncthreads();
        split_rows();
        __syncthreads();
        if (first + ROWS < end) ask_for_rows(first + ROWS);
        #pragma unroll 1
        for (int row = 0; row < ROWS && first + row < end; row += 16) {
            unsigned masks[2][2];
            #pragma unroll
            for (int i = 0; i < 4; ++i) {
                const int at = first + row + 8 * (i / 2) + 2 * t + i % 2;
                const int word = at < end ? signs[(size_t)at * WORDS] : 0;
                masks[i / 2][i % 2] = (unsigned)word >> (base % 128 / 4 + (g & 1u));
            }
            float sum[2][2][4] = {}, bar[2][2][4] = {};
            #pragma unroll
            for (int k = 0; k < STEPS; ++k) {
                unsigned high[4], low[4];
                const int from = (row + straight) * pitch + 16 * k + straight_column;
                fetch(high, inputs[0] + from);
                fetch(low, inputs[1] + from);
                multiply_units(sum, hidden, STEPS, k, high, low);
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
                            const bool on = masks[tile][i] >> (4 * group + 2 * half) & 1u;
                            unit[i] = on ? sum[group][tile][2 * half + i] : 0.0f;
                            unit_bar[i] = on ? bar[group][tile][2 * half + i] : 0.0f;
                        }
                        const int word = 2 * tile + half;
                        split_bfloat(unit[0], unit[1], units[group][word], units_rest[group][word]);
                        split_bfloat(unit_bar[0], unit_bar[1],
                            unit_bars[group][word], unit_bars_rest[group][word]);
                    }
                }
            }
            #pragma unroll
            for (int tile = 0; tile < TILES; tile += 2) {
                unsigned high[4], low[4];
                const int from = (row + transposed) * pitch + 8 * tile + transposed_column;
                fetch_transposed(high, inputs[0] + from);
                fetch_transposed(low, inputs[1] + from);
                #pragma unroll
                for (int other = 0; other < 2 && tile + other < TILES; ++other) {
                    #pragma unroll
                    for (int group = 0; group < 2; ++group) {
                        add_product(hidden_total[group][tile + other], unit_bars[group],
                            unit_bars_rest[group], high, low, other);
                    }
                }
            }
            #pragma unroll
            for (int tile = 0; tile < OUT_TILES; tile += 2) {
                unsigned high[4], low[4];
                const int from = (row + transposed) * out_pitch + 8 * tile + transposed_column;
                fetch_transposed(high, bars[0] + from);
                fetch_transposed(low, bars[1] + from);
                #pragma unroll
                for (int other = 0; other < 2 && tile + other < OUT_TILES; ++other) {
                    #pragma unroll
                    for (int group = 0; group < 2; ++group) {
                        add_product(output_total[group][tile + other], units[group],
                            units_rest[group], high, low, other);
                    }
                }
            }
        }
    }

    float* to = partial_sums.data + (size_t)range * partial_sums.shape[1];
    #pragma unroll
    for (int group = 0; group < 2; ++group) {
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
            const int unit = base + 16 * group + g + i / 2 * 8, place = 2 * t + i % 2;
            #pragma unroll
            for (int tile = 0; tile < TILES; ++tile) {
                const int column = 8 * tile + place;
                if (column < width) to[unit * width + column] = hidden_total[group][tile][i];
            }
            float* output_to = to + unit_count * width + unit;
            #pragma unroll
            for (int tile = 0; tile < OUT_TILES; ++tile) {
                const int column = 8 * tile + place;
                if (column >= out_width) continue;
                output_to[column * unit_count] = output_total[group][tile][i];
            }
        }
    }
}

template <int WARPS>
__device__ inline void add_partial_sums(
    const wp::array_t<float>& partial_sums, const wp::array_t<float>& total)
{
    __shared__ float sums[WARPS][32];
    const int column = blockIdx.x * 32 + threadIdx.x % 32, warp = threadIdx.x / 32;
    const int count = partial_sums.shape[0], width = partial_sums.shape[1];
    float sum = 0.0f;
    if (column < width) {
        const float* from = partial_sums.data + column;
        #pragma unroll 8
        for (int range = warp; range < count; range += WARPS) sum += from[(size_t)range * width];
    }
    sums[warp][threadIdx.x % 32] = sum;
    __syncthreads();
    if (warp == 0 && column < width) {
        float parts[WARPS];
        #pragma unroll
        for (int k = 0; k < WARPS; ++k) parts[k] = sums[k][threadIdx.x];
        #pragma unroll
        for (int step = 1; step < WARPS; step *= 2) {
            #pragma unroll
            for (int k = 0; k + step < WARPS; k += 2 * step) parts[k] += parts[k + step];
        }
        total.data[column] = parts[0];
    }
}

}  // namespace npa
