// For cuda/equivariance.py: vectors of equivariant rules, and their gradients; a warp serves a few rows.
// Names: `x_bar` = dL/dx, the gradient of the loss L with respect to x.

namespace npa {

// Sizes of rows [scalars | vectors | 1 | 0], and of inputs and mixed vectors.
template <int D, int SCALARS, int PERCEIVED, int MIXED, int CHIRAL> struct VectorForm {
    static constexpr int DOTS = MIXED * (MIXED + 1) / 2, CROSSES = CHIRAL ? DOTS - MIXED : 0;
    static constexpr int FIRST_CROSS = SCALARS + DOTS, PRODUCTS_END = FIRST_CROSS + CROSSES;
    static constexpr int ROW_END = SCALARS + PERCEIVED * D, WEIGHTS = PERCEIVED * MIXED;

    // Index of the dot product of a and b, and of their cross product.
    static __device__ int dot_of(int a, int b)
    {
        const int low = min(a, b), high = max(a, b);
        return low * MIXED - low * (low - 1) / 2 + high - low;
    }

    static __device__ int cross_of(int a, int b)
    {
        const int low = min(a, b), high = max(a, b);
        return low * (MIXED - 1) - low * (low - 1) / 2 + high - low - 1;
    }
};

// Loads of some columns of a warp's rows, for shared memory: all loads come before the first store,
// which waits for them. Rows beyond the last are zeros.
template <int ROWS, int COLUMNS> struct RowLoads {
    static constexpr int EACH = (ROWS * COLUMNS + 31) / 32;
    float values[EACH];

    __device__ void load(const float* from, int width, int count, int lane)
    {
        #pragma unroll
        for (int k = 0; k < EACH; ++k) {
            const int row = (lane + 32 * k) / COLUMNS, column = (lane + 32 * k) % COLUMNS;
            values[k] = row < count ? from[(size_t)row * width + column] : 0.0f;
        }
    }

    __device__ void store(float* to, int lane) const
    {
        #pragma unroll
        for (int k = 0; k < EACH; ++k) {
            if (lane + 32 * k < ROWS * COLUMNS) to[lane + 32 * k] = values[k];
        }
    }
};

// Write the mixed vectors of rows, and [scalars | products | 1 | 0].
template <int D, int SCALARS, int PERCEIVED, int MIXED, int CHIRAL, int WARPS, int ROWS>
__device__ inline void read_vectors(
    const wp::array_t<float>& rows, const wp::array_t<float>& mixing,
    const wp::array_t<float>& mixed, const wp::array_t<float>& inputs)
{
    using Form = VectorForm<D, SCALARS, PERCEIVED, MIXED, CHIRAL>;
    constexpr int ENTRIES = Form::ROW_END + 1;
    __shared__ float weights[Form::WEIGHTS];
    __shared__ unsigned short pairs[Form::DOTS + Form::CROSSES];
    __shared__ float row_of[WARPS][ROWS][ENTRIES], vectors_of[WARPS][ROWS][MIXED * D];
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const int width = rows.shape[1], out_width = inputs.shape[1];
    const int first = (blockIdx.x * WARPS + warp) * ROWS;
    const int count = max(min(ROWS, rows.shape[0] - first), 0);
    RowLoads<ROWS, ENTRIES> seen;
    seen.load(rows.data + (size_t)first * width, width, count, lane);
    for (int i = threadIdx.x; i < Form::WEIGHTS; i += blockDim.x) weights[i] = mixing.data[i];
    for (int i = threadIdx.x; i < MIXED * MIXED; i += blockDim.x) {
        const int a = i / MIXED, b = i % MIXED;
        if (a <= b) pairs[Form::dot_of(a, b)] = a << 8 | b;
        if (CHIRAL && a < b) pairs[Form::DOTS + Form::cross_of(a, b)] = a << 8 | b;
    }
    seen.store(row_of[warp][0], lane);
    __syncthreads();
    #pragma unroll
    for (int i = lane; i < ROWS * MIXED; i += 32) {
        const int r = i / MIXED, a = i % MIXED;
        const float* vectors = row_of[warp][r] + SCALARS;
        float sum[D] = {};
        #pragma unroll
        for (int k = 0; k < PERCEIVED; ++k) {
            const float weight = weights[k * MIXED + a];
            #pragma unroll
            for (int d = 0; d < D; ++d) sum[d] += weight * vectors[k * D + d];
        }
        float* to = mixed.data + (size_t)first * MIXED * D + i * D;
        #pragma unroll
        for (int d = 0; d < D; ++d) {
            vectors_of[warp][r][a * D + d] = sum[d];
            if (r < count) to[d] = sum[d];
        }
    }
    __syncwarp();
    for (int i = lane; i < out_width; i += 32) {
        const bool product = i >= SCALARS && i < Form::PRODUCTS_END;
        const int pair = product ? pairs[i - SCALARS] : 0;
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            float value = 0.0f;
            if (product) {
                const float* u = vectors_of[warp][r] + (pair >> 8) * D;
                const float* v = vectors_of[warp][r] + (pair & 255) * D;
                if (CHIRAL && i >= Form::FIRST_CROSS) {
                    value = u[0] * v[1] - u[1] * v[0];
                } else {
                    #pragma unroll
                    for (int d = 0; d < D; ++d) value += u[d] * v[d];
                }
            } else if (i <= Form::PRODUCTS_END) {
                value = row_of[warp][r][i < SCALARS ? i : Form::ROW_END];
            }
            if (r < count) inputs.data[(size_t)(first + r) * out_width + i] = value;
        }
    }
}

// Write the cotangents of rows, and each block's sum of the mixing weights' cotangents.
template <int D, int SCALARS, int PERCEIVED, int MIXED, int CHIRAL, int WARPS, int ROWS>
__device__ inline void pull_back_vectors(
    const wp::array_t<float>& rows, const wp::array_t<float>& mixing,
    const wp::array_t<float>& mixed, const wp::array_t<float>& mixed_bar,
    const wp::array_t<float>& inputs_bar, const wp::array_t<float>& rows_bar,
    const wp::array_t<float>& partial_sums)
{
    using Form = VectorForm<D, SCALARS, PERCEIVED, MIXED, CHIRAL>;
    constexpr int OWN = (Form::WEIGHTS + 31) / 32;
    constexpr int TASKS = (ROWS * MIXED + 31) / 32, VECTORS = MIXED * D;
    // The weights of one mixed vector are adjacent, like the threads that read them.
    __shared__ float weights[Form::WEIGHTS], sums[WARPS][Form::WEIGHTS];
    __shared__ float bar_of[WARPS][ROWS][Form::PRODUCTS_END], seen_of[WARPS][ROWS][PERCEIVED * D];
    __shared__ float vectors_of[WARPS][ROWS][VECTORS], total_of[WARPS][ROWS][VECTORS];
    for (int i = threadIdx.x; i < Form::WEIGHTS; i += blockDim.x) {
        weights[i % MIXED * PERCEIVED + i / MIXED] = mixing.data[i];
    }
    __syncthreads();
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const int width = rows.shape[1], in_width = inputs_bar.shape[1];
    float own[OWN] = {};
    const int stride = gridDim.x * WARPS * ROWS;
    for (int first = (blockIdx.x * WARPS + warp) * ROWS; first < rows.shape[0]; first += stride) {
        const int count = min(ROWS, rows.shape[0] - first);
        RowLoads<ROWS, Form::PRODUCTS_END> bars;
        RowLoads<ROWS, PERCEIVED * D> seen;
        RowLoads<ROWS, VECTORS> vectors;
        bars.load(inputs_bar.data + (size_t)first * in_width, in_width, count, lane);
        seen.load(rows.data + (size_t)first * width + SCALARS, width, count, lane);
        vectors.load(mixed.data + (size_t)first * VECTORS, VECTORS, count, lane);
        float total[TASKS][D];
        #pragma unroll
        for (int k = 0; k < TASKS; ++k) {
            const int i = lane + 32 * k;
            #pragma unroll
            for (int d = 0; d < D; ++d) {
                const bool there = i < count * MIXED;
                total[k][d] = there ? mixed_bar.data[((size_t)first * MIXED + i) * D + d] : 0.0f;
            }
        }
        bars.store(bar_of[warp][0], lane);
        seen.store(seen_of[warp][0], lane);
        vectors.store(vectors_of[warp][0], lane);
        __syncwarp();
        #pragma unroll
        for (int k = 0; k < TASKS; ++k) {
            const int r = (lane + 32 * k) / MIXED, a = (lane + 32 * k) % MIXED;
            if (r >= ROWS) break;
            const float* bars_of = bar_of[warp][r];
            #pragma unroll
            for (int b = 0; b < MIXED; ++b) {
                const float* other = vectors_of[warp][r] + b * D;
                float bar = bars_of[SCALARS + Form::dot_of(a, b)];
                if (a == b) bar += bar;
                #pragma unroll
                for (int d = 0; d < D; ++d) total[k][d] += bar * other[d];
                if (CHIRAL && a != b) {
                    bar = bars_of[Form::FIRST_CROSS + Form::cross_of(a, b)];
                    if (a > b) bar = -bar;
                    total[k][0] += bar * other[1];
                    total[k][1] -= bar * other[0];
                }
            }
            #pragma unroll
            for (int d = 0; d < D; ++d) total_of[warp][r][a * D + d] = total[k][d];
        }
        __syncwarp();
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            #pragma unroll
            for (int k = 0; k < OWN; ++k) {
                const int weight = lane + 32 * k;
                if (weight < Form::WEIGHTS) {
                    const float* from = seen_of[warp][r] + weight / MIXED * D;
                    const float* to = total_of[warp][r] + weight % MIXED * D;
                    #pragma unroll
                    for (int d = 0; d < D; ++d) own[k] += from[d] * to[d];
                }
            }
            if (r >= count) continue;
            float* to = rows_bar.data + (size_t)(first + r) * width;
            for (int i = lane; i < SCALARS; i += 32) to[i] = bar_of[warp][r][i];
            for (int i = Form::ROW_END + lane; i < width; i += 32) to[i] = 0.0f;
        }
        for (int i = lane; i < count * PERCEIVED; i += 32) {
            const int r = i / PERCEIVED, k = i % PERCEIVED;
            float sum[D] = {};
            #pragma unroll
            for (int a = 0; a < MIXED; ++a) {
                const float weight = weights[a * PERCEIVED + k];
                #pragma unroll
                for (int d = 0; d < D; ++d) sum[d] += weight * total_of[warp][r][a * D + d];
            }
            float* to = rows_bar.data + (size_t)(first + r) * width + SCALARS + k * D;
            #pragma unroll
            for (int d = 0; d < D; ++d) to[d] = sum[d];
        }
        __syncwarp();
    }
    #pragma unroll
    for (int k = 0; k < OWN; ++k) {
        if (lane + 32 * k < Form::WEIGHTS) sums[warp][lane + 32 * k] = own[k];
    }
    __syncthreads();
    for (int i = threadIdx.x; i < Form::WEIGHTS; i += blockDim.x) {
        float sum = 0.0f;
        #pragma unroll
        for (int k = 0; k < WARPS; ++k) sum += sums[k][i];
        partial_sums.data[(size_t)blockIdx.x * Form::WEIGHTS + i] = sum;
    }
}

// Write updates [δ | Δs | 0] from gates and state changes [g | Δs | 0]. A warp issues the loads of
// all its rows before it uses them.
template <int D, int MIXED, int CHIRAL, int WARPS, int ROWS>
__device__ inline void steer_by_gates(
    const wp::array_t<float>& output, const wp::array_t<float>& mixed,
    const wp::array_t<float>& signs, const wp::array_t<float>& update)
{
    constexpr int GATES = CHIRAL ? 2 * MIXED : MIXED;
    const int first = (blockIdx.x * WARPS + threadIdx.x / 32) * ROWS, lane = threadIdx.x % 32;
    const int count = min(ROWS, output.shape[0] - first);
    if (count <= 0) return;
    const int in_width = output.shape[1], width = update.shape[1];
    const float* from = output.data + (size_t)first * in_width;
    const float* vectors = mixed.data + (size_t)first * MIXED * D;
    float* to = update.data + (size_t)first * width;
    float sum[ROWS][D] = {};
    for (int g = lane; g < GATES; g += 32) {
        const float sign = signs.data[g];
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            if (r >= count) continue;
            const float gate = fmaxf(from[r * in_width + g], 0.0f) * sign;
            const float* u = vectors + (r * MIXED + g % MIXED) * D;
            if (CHIRAL && g >= MIXED) {
                sum[r][0] -= gate * u[1];
                sum[r][1] += gate * u[0];
            } else {
                #pragma unroll
                for (int d = 0; d < D; ++d) sum[r][d] += gate * u[d];
            }
        }
    }
    for (int i = D + lane; i < width; i += 32) {
        const int place = GATES + i - D;
        float change[ROWS];
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            change[r] = r < count && place < in_width ? from[r * in_width + place] : 0.0f;
        }
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            if (r < count) to[r * width + i] = change[r];
        }
    }
    #pragma unroll
    for (int r = 0; r < ROWS; ++r) {
        #pragma unroll
        for (int d = 0; d < D; ++d) {
            #pragma unroll
            for (int offset = 16; offset > 0; offset >>= 1) {
                sum[r][d] += __shfl_xor_sync(~0u, sum[r][d], offset);
            }
            if (lane == d && r < count) to[r * width + d] = sum[r][d];
        }
    }
}

// Write the cotangents of the inputs of `steer_by_gates`.
template <int D, int MIXED, int CHIRAL, int WARPS, int ROWS>
__device__ inline void pull_back_gates(
    const wp::array_t<float>& output, const wp::array_t<float>& mixed,
    const wp::array_t<float>& signs, const wp::array_t<float>& update_bar,
    const wp::array_t<float>& output_bar, const wp::array_t<float>& mixed_bar)
{
    constexpr int GATES = CHIRAL ? 2 * MIXED : MIXED;
    const int first = (blockIdx.x * WARPS + threadIdx.x / 32) * ROWS, lane = threadIdx.x % 32;
    const int count = min(ROWS, output.shape[0] - first);
    if (count <= 0) return;
    const int in_width = output.shape[1], width = update_bar.shape[1];
    const float* from = output.data + (size_t)first * in_width;
    const float* vectors = mixed.data + (size_t)first * MIXED * D;
    const float* bars = update_bar.data + (size_t)first * width;
    float* to = output_bar.data + (size_t)first * in_width;
    float* vectors_to = mixed_bar.data + (size_t)first * MIXED * D;
    float displacement_bar[ROWS][D] = {};
    #pragma unroll
    for (int r = 0; r < ROWS; ++r) {
        #pragma unroll
        for (int d = 0; d < D; ++d) {
            if (r < count) displacement_bar[r][d] = bars[r * width + d];
        }
    }
    for (int i = lane; i < in_width; i += 32) {
        const float sign = i < GATES ? signs.data[i] : 0.0f;
        float value[ROWS] = {};
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            if (r >= count) continue;
            if (i >= GATES) {
                if (i - GATES + D < width) value[r] = bars[r * width + i - GATES + D];
            } else {
                const float* u = vectors + (r * MIXED + i % MIXED) * D;
                if (CHIRAL && i >= MIXED) {
                    value[r] = u[0] * displacement_bar[r][1] - u[1] * displacement_bar[r][0];
                } else {
                    #pragma unroll
                    for (int d = 0; d < D; ++d) value[r] += u[d] * displacement_bar[r][d];
                }
                value[r] = from[r * in_width + i] > 0.0f ? sign * value[r] : 0.0f;
            }
        }
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            if (r < count) to[r * in_width + i] = value[r];
        }
    }
    for (int i = lane; i < MIXED * D; i += 32) {
        const int a = i / D, d = i % D;
        const float sign = signs.data[a], turned_sign = CHIRAL ? signs.data[MIXED + a] : 0.0f;
        float value[ROWS];
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            if (r >= count) continue;
            const float* gates = from + r * in_width;
            value[r] = fmaxf(gates[a], 0.0f) * sign * bars[r * width + d];
            if (CHIRAL) {
                const float turned = d == 0 ? -displacement_bar[r][1] : displacement_bar[r][0];
                value[r] -= fmaxf(gates[MIXED + a], 0.0f) * turned_sign * turned;
            }
        }
        #pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            if (r < count) vectors_to[r * MIXED * D + i] = value[r];
        }
    }
}

}  // namespace npa
