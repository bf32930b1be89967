// For cuda/adjoint.py: backward pass of perception; a warp sums for a tile of eight particles.
//
// The rows that may be near these particles are listed in shared memory. For eight rows at a time,
// each thread computes the weights of two rows for one particle; weights [particles, rows] times
// channels [rows, W] are then small matrix products. A tensor core multiplies numbers of 11 bits, so
// each number is split into two, and three products of parts are accurate to about 2^-21.

namespace npa {

// A listed row: its position, and last the index of its channels.
using RowEntry = wp::vec_t<4, float>;

using FourChannels = wp::vec_t<4, float>;

template <int WARPS, int ENTRIES> __device__ inline unsigned row_list_address()
{
    __shared__ __align__(16) float4 lists[WARPS * ENTRIES];
    return (unsigned)__cvta_generic_to_shared(lists + threadIdx.x / 32u * ENTRIES);
}

__device__ inline float4& listed_row(unsigned address, unsigned entry)
{
    return *reinterpret_cast<float4*>(__cvta_shared_to_generic(address + 16 * entry));
}

__device__ inline float4 four(FourChannels values)
{
    return make_float4(values[0], values[1], values[2], values[3]);
}

__device__ inline int append_entry(unsigned address, int count, bool accepted, RowEntry entry)
{
    const unsigned votes = __ballot_sync(~0u, accepted);
    const unsigned before = (1u << (threadIdx.x & 31u)) - 1u;
    if (accepted) listed_row(address, count + __popc(votes & before)) = four(entry);
    return count + __popc(votes);
}

__device__ inline int pad_list(unsigned address, int count, RowEntry entry)
{
    const unsigned lane = threadIdx.x & 31u;
    if (lane < (-count & 7)) listed_row(address, count + lane) = four(entry);
    return (count + 7) & ~7;
}

__device__ inline void keep_unsummed(unsigned address, int summed_count, int count)
{
    __syncwarp();
    const unsigned lane = threadIdx.x & 31u;
    if ((int)lane < count - summed_count) {
        listed_row(address, lane) = listed_row(address, summed_count + lane);
    }
    __syncwarp();
}

__device__ inline void multiply_tiles(float* sums, const unsigned* a, const unsigned* b)
{
    asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 "
        "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
}

// Clear the low bits of a number, which a tensor core ignores; the rest is its second part.
__device__ inline void split_number(float number, unsigned& part, unsigned& rest)
{
    part = __float_as_uint(number);
    rest = __float_as_uint(number - __uint_as_float(part & 0xffffe000u));
}

template <int DIMS, int WIDTH, int WEIGHTS, bool PERIODIC, typename Domain>
__device__ inline FourChannels sum_listed(
    unsigned address, int count, const Domain& domain, wp::vec_t<DIMS, float> position,
    const wp::array_t<float>& channels, FourChannels value)
{
    __syncwarp();
    const unsigned lane = threadIdx.x & 31u;
    const unsigned first_row = lane & 3u;
    const unsigned channel = lane >> 2 << 1;
    const float* columns = channels.data + (channel < WIDTH ? channel : 0u);
    FourChannels total = value;
    for (unsigned begin = 0; begin < count; begin += 8) {
        unsigned weights[WEIGHTS][2], weight_rests[WEIGHTS][2];
        unsigned values[WEIGHTS][4], value_rests[WEIGHTS][4];
        #pragma unroll
        for (unsigned half = 0; half < 2; ++half) {
            const float4 row = listed_row(address, begin + first_row + 4 * half);
            const float* from = columns + (size_t)__float_as_uint(row.w) * (WEIGHTS * WIDTH);
            #pragma unroll
            for (unsigned w = 0; w < WEIGHTS; ++w) {
                float2 pair = *reinterpret_cast<const float2*>(from + WIDTH * w);
                if (channel >= WIDTH) pair = make_float2(0.0f, 0.0f);
                split_number(pair.x, values[w][2 * half], value_rests[w][2 * half]);
                split_number(pair.y, values[w][2 * half + 1], value_rests[w][2 * half + 1]);
            }
            const float other[3] = {row.x, row.y, row.z};
            float offset[DIMS];
            float squared = 1e-37f;  // not 0, which has no inverse root
            #pragma unroll
            for (unsigned d = 0; d < DIMS; ++d) {
                offset[d] = position[d] - other[d];
                if (PERIODIC) offset[d] -= domain.box[d] * rintf(offset[d] * domain.inverse_box[d]);
                squared = fmaf(offset[d], offset[d], squared);
            }
            const float weight = smoothing(squared, domain.inverse_squared_eps);
            split_number(weight, weights[0][half], weight_rests[0][half]);
            if constexpr (WEIGHTS > 1) {
                const float factor = spiky_factor(squared, domain.inverse_eps);
                #pragma unroll
                for (unsigned d = 0; d < WEIGHTS - 1; ++d) {
                    const float component = factor * offset[d];
                    split_number(component, weights[1 + d][half], weight_rests[1 + d][half]);
                }
            }
        }
        // Three short chains instead of a long one, because tensor cores round towards zero.
        float sums[3][4] = {};
        #pragma unroll
        for (unsigned w = 0; w < WEIGHTS; ++w) {
            multiply_tiles(sums[0], values[w], weight_rests[w]);
            multiply_tiles(sums[1], value_rests[w], weights[w]);
            multiply_tiles(sums[2], values[w], weights[w]);
        }
        #pragma unroll
        for (unsigned i = 0; i < 4; ++i) total[i] += sums[2][i] + (sums[0][i] + sums[1][i]);
    }
    return total;
}

// A thread has two channels of two particles; adjacent threads swap, to have four of one particle.
__device__ inline FourChannels regroup_tile(FourChannels total)
{
    const bool odd = threadIdx.x & 4u;
    const float first = __shfl_xor_sync(~0u, odd ? total[0] : total[1], 4);
    const float second = __shfl_xor_sync(~0u, odd ? total[2] : total[3], 4);
    FourChannels result;
    result[0] = odd ? first : total[0];
    result[1] = odd ? second : total[2];
    result[2] = odd ? total[1] : first;
    result[3] = odd ? total[3] : second;
    return result;
}

__device__ inline float smallest_in_tile(float value)
{
    #pragma unroll
    for (unsigned offset = 4; offset < 32; offset <<= 1) {
        value = fminf(value, __shfl_xor_sync(~0u, value, offset));
    }
    return value;
}

// Unlike in `wide_load`, a row may begin at any address, and end within a group of columns.
__device__ inline float* column_address(const wp::array_t<float>& values, int row, int column)
{
    return values.data + (size_t)(unsigned)row * (unsigned)values.shape[1] + column;
}

template <int COUNT>
__device__ inline wp::vec_t<COUNT, float> read_columns(
    const wp::array_t<float>& values, int row, int column, int end)
{
    wp::vec_t<COUNT, float> result;
    const float* from = column_address(values, row, column);
    if (column + COUNT <= end && ((size_t)from & 15u) == 0) {
        #pragma unroll
        for (int i = 0; i < COUNT / 4; ++i) {
            const float4 part = reinterpret_cast<const float4*>(from)[i];
            result[4 * i] = part.x;
            result[4 * i + 1] = part.y;
            result[4 * i + 2] = part.z;
            result[4 * i + 3] = part.w;
        }
    } else {
        #pragma unroll
        for (int i = 0; i < COUNT; ++i) result[i] = column + i < end ? from[i] : 0.0f;
    }
    return result;
}

__device__ inline void write_columns(
    const wp::array_t<float>& values, int row, int column, FourChannels entry)
{
    float* to = column_address(values, row, column);
    if (column + 4 <= values.shape[1] && ((size_t)to & 15u) == 0) {
        *reinterpret_cast<float4*>(to) = four(entry);
    } else {
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
            if (column + i < values.shape[1]) to[i] = entry[i];
        }
    }
}

__device__ inline void prefetch_columns(const wp::array_t<float>& values, int row, int column)
{
    asm volatile("prefetch.global.L2 [%0];" : : "l"(column_address(values, row, column)));
}

}  // namespace npa
