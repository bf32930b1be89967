// Vectors of equivariant rules: a warp has a few rows. npa_envs/ops/equivariance.py has the formulas.

namespace npa {

// What rows [scalars | vectors | 1 | 0] and what is made of them look like.
template <int D, int SCALARS, int PERCEIVED, int MIXED, int CHIRAL> struct VectorForm {
    static constexpr int DOTS = MIXED * (MIXED + 1) / 2, CROSSES = CHIRAL ? DOTS - MIXED : 0;
    static constexpr int FIRST_CROSS = SCALARS + DOTS, PRODUCTS_END = FIRST_CROSS + CROSSES;
    static constexpr int ROW_END = SCALARS + PERCEIVED * D, WEIGHTS = PERCEIVED * MIXED;
    // Rows of a warp: as many as have a thread for each of their mixed vectors, at most four.
    static constexpr int ROWS = MIXED >= 32 ? 1 : 32 / MIXED < 4 ? 32 / MIXED : 4;

    // Number of the dot product of a and b, and of the cross product.
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

// Write the mixed vectors of rows, and [scalars | products | 1 | 0].
template <int D, int SCALARS, int PERCEIVED, int MIXED, int CHIRAL, int WARPS>
__device__ inline void read_vectors(
    const wp::array_t<float>& rows,
    const wp::array_t<float>& mixing,
    const wp::array_t<float>& mixed,
    const wp::array_t<float>& inputs)
{
    using Form = VectorForm<D, SCALARS, PERCEIVED, MIXED, CHIRAL>;
    constexpr int ROWS = Form::ROWS, ENTRIES = Form::ROW_END + 1;
    __shared__ float weights[Form::WEIGHTS];
    __shared__ unsigned short pairs[Form::DOTS + Form::CROSSES];
    __shared__ float row_of[WARPS][ROWS][ENTRIES], vectors_of[WARPS][ROWS][MIXED * D];
    for (int i = threadIdx.x; i < Form::WEIGHTS; i += blockDim.x) weights[i] = mixing.data[i];
    for (int i = threadIdx.x; i < MIXED * MIXED; i += blockDim.x) {
        const int a = i / MIXED, b = i % MIXED;
        if (a <= b) pairs[Form::dot_of(a, b)] = a << 8 | b;
        if (CHIRAL && a < b) pairs[Form::DOTS + Form::cross_of(a, b)] = a << 8 | b;
    }
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const int width = rows.shape[1], out_width = inputs.shape[1];
    const int first = (blockIdx.x * WARPS + warp) * ROWS, count = min(ROWS, rows.shape[0] - first);
    for (int r = 0; r < count; ++r) {
        const float* from = rows.data + (size_t)(first + r) * width;
        for (int i = lane; i < ENTRIES; i += 32) row_of[warp][r][i] = from[i];
    }
    __syncthreads();
    for (int i = lane; i < count * MIXED; i += 32) {
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
        for (int d = 0; d < D; ++d) to[d] = vectors_of[warp][r][a * D + d] = sum[d];
    }
    __syncwarp();
    for (int r = 0; r < count; ++r) {
        float* to = inputs.data + (size_t)(first + r) * out_width;
        for (int i = lane; i < out_width; i += 32) {
            float value = 0.0f;
            if (i < SCALARS) {
                value = row_of[warp][r][i];
            } else if (i < Form::PRODUCTS_END) {
                const int pair = pairs[i - SCALARS];
                const float* u = vectors_of[warp][r] + (pair >> 8) * D;
                const float* v = vectors_of[warp][r] + (pair & 255) * D;
                if (CHIRAL && i >= Form::FIRST_CROSS) {
                    value = u[0] * v[1] - u[1] * v[0];
                } else {
                    #pragma unroll
                    for (int d = 0; d < D; ++d) value += u[d] * v[d];
                }
            } else if (i == Form::PRODUCTS_END) {
                value = row_of[warp][r][Form::ROW_END];
            }
            to[i] = value;
        }
    }
}

// Write the cotangents of rows, and each block's sum over its rows of those of the mixing weights.
template <int D, int SCALARS, int PERCEIVED, int MIXED, int CHIRAL, int WARPS>
__device__ inline void pull_back_vectors(
    const wp::array_t<float>& rows,
    const wp::array_t<float>& mixing,
    const wp::array_t<float>& mixed,
    const wp::array_t<float>& mixed_bar,
    const wp::array_t<float>& inputs_bar,
    const wp::array_t<float>& rows_bar,
    const wp::array_t<float>& partial_sums)
{
    using Form = VectorForm<D, SCALARS, PERCEIVED, MIXED, CHIRAL>;
    constexpr int ROWS = Form::ROWS, OWN = (Form::WEIGHTS + 31) / 32;
    // The weights of a mixed vector beside each other, as those who read them lie.
    __shared__ float weights[Form::WEIGHTS], sums[WARPS][Form::WEIGHTS];
    __shared__ float bar_of[WARPS][ROWS][Form::PRODUCTS_END], seen_of[WARPS][ROWS][PERCEIVED * D];
    __shared__ float vectors_of[WARPS][ROWS][MIXED * D], total_of[WARPS][ROWS][MIXED * D];
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
        for (int r = 0; r < count; ++r) {
            const float* bars = inputs_bar.data + (size_t)(first + r) * in_width;
            for (int i = lane; i < Form::PRODUCTS_END; i += 32) bar_of[warp][r][i] = bars[i];
            const float* seen = rows.data + (size_t)(first + r) * width + SCALARS;
            for (int i = lane; i < PERCEIVED * D; i += 32) seen_of[warp][r][i] = seen[i];
        }
        const size_t place = (size_t)first * MIXED * D;
        for (int i = lane; i < count * MIXED * D; i += 32) {
            vectors_of[warp][i / (MIXED * D)][i % (MIXED * D)] = mixed.data[place + i];
        }
        __syncwarp();
        for (int i = lane; i < count * MIXED; i += 32) {
            const int r = i / MIXED, a = i % MIXED;
            const float* bars = bar_of[warp][r];
            float total[D];
            #pragma unroll
            for (int d = 0; d < D; ++d) total[d] = mixed_bar.data[place + i * D + d];
            #pragma unroll
            for (int b = 0; b < MIXED; ++b) {
                const float* other = vectors_of[warp][r] + b * D;
                float bar = bars[SCALARS + Form::dot_of(a, b)];
                if (a == b) bar += bar;
                #pragma unroll
                for (int d = 0; d < D; ++d) total[d] += bar * other[d];
                if (CHIRAL && a != b) {
                    bar = bars[Form::FIRST_CROSS + Form::cross_of(a, b)];
                    if (a > b) bar = -bar;
                    total[0] += bar * other[1];
                    total[1] -= bar * other[0];
                }
            }
            #pragma unroll
            for (int d = 0; d < D; ++d) total_of[warp][r][a * D + d] = total[d];
        }
        __syncwarp();
        for (int r = 0; r < count; ++r) {
            float* to = rows_bar.data + (size_t)(first + r) * width;
            for (int i = lane; i < SCALARS; i += 32) to[i] = bar_of[warp][r][i];
            for (int i = Form::ROW_END + lane; i < width; i += 32) to[i] = 0.0f;
            #pragma unroll
            for (int k = 0; k < OWN; ++k) {
                const int weight = lane + 32 * k;
                if (weight < Form::WEIGHTS) {
                    const float* seen = seen_of[warp][r] + weight / MIXED * D;
                    const float* total = total_of[warp][r] + weight % MIXED * D;
                    #pragma unroll
                    for (int d = 0; d < D; ++d) own[k] += seen[d] * total[d];
                }
            }
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

// Write updates [δ | Δs | 0] of gates and state changes [g | Δs | 0]: a warp has a row.
template <int D, int MIXED, int CHIRAL, int WARPS>
__device__ inline void steer_by_gates(
    const wp::array_t<float>& output,
    const wp::array_t<float>& mixed,
    const wp::array_t<float>& signs,
    const wp::array_t<float>& update)
{
    constexpr int GATES = CHIRAL ? 2 * MIXED : MIXED;
    const int row = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32;
    if (row >= output.shape[0]) return;
    const int in_width = output.shape[1], width = update.shape[1];
    const float* from = output.data + (size_t)row * in_width;
    const float* vectors = mixed.data + (size_t)row * MIXED * D;
    float* to = update.data + (size_t)row * width;
    for (int i = D + lane; i < width; i += 32) {
        const int place = GATES + i - D;
        to[i] = place < in_width ? from[place] : 0.0f;
    }
    float sum[D] = {};
    for (int g = lane; g < GATES; g += 32) {
        const float gate = fmaxf(from[g], 0.0f) * signs.data[g];
        const float* u = vectors + g % MIXED * D;
        if (CHIRAL && g >= MIXED) {
            sum[0] -= gate * u[1];
            sum[1] += gate * u[0];
        } else {
            #pragma unroll
            for (int d = 0; d < D; ++d) sum[d] += gate * u[d];
        }
    }
    #pragma unroll
    for (int d = 0; d < D; ++d) {
        #pragma unroll
        for (int offset = 16; offset > 0; offset >>= 1) {
            sum[d] += __shfl_xor_sync(~0u, sum[d], offset);
        }
        if (lane == d) to[d] = sum[d];
    }
}

// Write the cotangents of what `steer_by_gates` reads.
template <int D, int MIXED, int CHIRAL, int WARPS>
__device__ inline void pull_back_gates(
    const wp::array_t<float>& output,
    const wp::array_t<float>& mixed,
    const wp::array_t<float>& signs,
    const wp::array_t<float>& update_bar,
    const wp::array_t<float>& output_bar,
    const wp::array_t<float>& mixed_bar)
{
    constexpr int GATES = CHIRAL ? 2 * MIXED : MIXED;
    const int row = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32;
    if (row >= output.shape[0]) return;
    const int in_width = output.shape[1], width = update_bar.shape[1];
    const float* from = output.data + (size_t)row * in_width;
    const float* vectors = mixed.data + (size_t)row * MIXED * D;
    const float* bars = update_bar.data + (size_t)row * width;
    float* to = output_bar.data + (size_t)row * in_width;
    float pull[D];
    #pragma unroll
    for (int d = 0; d < D; ++d) pull[d] = bars[d];
    for (int i = lane; i < in_width; i += 32) {
        float value = 0.0f;
        if (i >= GATES) {
            if (i - GATES + D < width) value = bars[i - GATES + D];
        } else if (from[i] > 0.0f) {
            const float* u = vectors + i % MIXED * D;
            if (CHIRAL && i >= MIXED) {
                value = u[0] * pull[1] - u[1] * pull[0];
            } else {
                #pragma unroll
                for (int d = 0; d < D; ++d) value += u[d] * pull[d];
            }
            value *= signs.data[i];
        }
        to[i] = value;
    }
    for (int i = lane; i < MIXED * D; i += 32) {
        const int a = i / D, d = i % D;
        float value = fmaxf(from[a], 0.0f) * signs.data[a] * bars[d];
        if (CHIRAL) {
            const float turned = d == 0 ? -pull[1] : pull[0];
            value -= fmaxf(from[MIXED + a], 0.0f) * signs.data[MIXED + a] * turned;
        }
        mixed_bar.data[(size_t)row * MIXED * D + i] = value;
    }
}

}  // namespace npa
