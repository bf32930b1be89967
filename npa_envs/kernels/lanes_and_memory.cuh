// For lanes_and_memory.py: access to memory, up to 16 bytes at a time, and to other threads' values.
//
// The first half also exists on a CPU, where a particle has one thread and no wide access.

namespace npa {

// Wait until all earlier launches have ended and their writes are visible. Every kernel that is
// launched early waits, so its end implies the end of all earlier ones.
CUDA_CALLABLE inline void wait_for_previous_kernel()
{
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Allow the blocks of the next kernel, if it is launched early, to start before those of this one have ended.
CUDA_CALLABLE inline void allow_next_launch()
{
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

// The largest number of bytes, at most 16, that divides a size.
CUDA_CALLABLE constexpr unsigned chunk_bytes(unsigned size)
{
    return size % 16 == 0 ? 16 : size % 8 == 0 ? 8 : 4;
}

template <unsigned BYTES> struct alignas(BYTES) Chunk {
    unsigned part[BYTES / 4];
};

template <unsigned BYTES, typename Value>
CUDA_CALLABLE inline void load_chunks(Value& value, const void* address)
{
    const Chunk<BYTES>* from = reinterpret_cast<const Chunk<BYTES>*>(address);
    unsigned* to = reinterpret_cast<unsigned*>(&value);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(value) / BYTES; ++i) {
        const Chunk<BYTES> chunk = from[i];
        #pragma unroll
        for (unsigned k = 0; k < BYTES / 4; ++k) to[BYTES / 4 * i + k] = chunk.part[k];
    }
}

template <unsigned BYTES, typename Value>
CUDA_CALLABLE inline void store_chunks(void* address, const Value& value)
{
    Chunk<BYTES>* to = reinterpret_cast<Chunk<BYTES>*>(address);
    const unsigned* from = reinterpret_cast<const unsigned*>(&value);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(value) / BYTES; ++i) {
        Chunk<BYTES> chunk;
        #pragma unroll
        for (unsigned k = 0; k < BYTES / 4; ++k) chunk.part[k] = from[BYTES / 4 * i + k];
        to[i] = chunk;
    }
}

template <typename Value>
CUDA_CALLABLE inline Value wide_load(const wp::array_t<Value>& entries, int index)
{
#if defined(__CUDA_ARCH__)
    Value result;
    load_chunks<chunk_bytes(sizeof(Value))>(result, entries.data + index);
    return result;
#else
    return entries.data[index];
#endif
}

template <typename Value>
CUDA_CALLABLE inline void wide_store(const wp::array_t<Value>& entries, int index, Value value)
{
#if defined(__CUDA_ARCH__)
    store_chunks<chunk_bytes(sizeof(Value))>(entries.data + index, value);
#else
    entries.data[index] = value;
#endif
}

template <typename Value, unsigned BYTES, typename Part>
CUDA_CALLABLE inline Value read_at(const wp::array_t<Part>& values, int index)
{
    Value result;
#if defined(__CUDA_ARCH__)
    load_chunks<BYTES>(result, values.data + index);
#else
    __builtin_memcpy(&result, values.data + index, sizeof(result));
#endif
    return result;
}

template <typename Value, typename Part>
CUDA_CALLABLE inline void write_at(const wp::array_t<Part>& values, int index, Value value)
{
#if defined(__CUDA_ARCH__)
    store_chunks<16>(values.data + index, value);
#else
    __builtin_memcpy(values.data + index, &value, sizeof(value));
#endif
}

#if defined(__CUDA_ARCH__)
// The lanes of this thread's particle, as a mask of the warp's threads.
template <int LANES> CUDA_CALLABLE inline unsigned lane_mask()
{
    const unsigned first = threadIdx.x & 31u & ~(LANES - 1u);
    return (LANES == 32 ? ~0u : (1u << LANES % 32) - 1u) << first;
}
#endif

// Part: the scalar type of the value's entries. STRIDE: every STRIDE-th lane is added.
template <typename Part, int LANES, bool WHOLE_WARPS, int STRIDE, typename Value>
CUDA_CALLABLE inline Value lane_sum(Value value)
{
#if defined(__CUDA_ARCH__)
    const unsigned mask = WHOLE_WARPS ? ~0u : lane_mask<LANES>();
    Part* sums = reinterpret_cast<Part*>(&value);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(value) / sizeof(Part); ++i) {
        #pragma unroll
        for (unsigned offset = LANES / 2; offset >= STRIDE; offset >>= 1) {
            sums[i] += __shfl_xor_sync(mask, sums[i], offset);
        }
    }
#endif
    return value;
}

// Share: a lane's columns of a matrix of ROWS rows. In lane i's matrix the k-th group of columns is
// that of lane i ^ k, so that all indices are constants.
template <typename Share, typename Part, int ROWS, int WIDTH, int LANES, typename Value>
CUDA_CALLABLE inline Share lane_collect(Value value)
{
    constexpr int SHARE = WIDTH / LANES;
    Share result;
    Part* own = reinterpret_cast<Part*>(&result);
    const Part* sums = reinterpret_cast<const Part*>(&value);
    #pragma unroll
    for (int i = 0; i < ROWS * SHARE; ++i) {
        const Part* shares = sums + i / SHARE * WIDTH + i % SHARE;
        own[i] = shares[0];
#if defined(__CUDA_ARCH__)
        #pragma unroll
        for (int k = 1; k < LANES; ++k) {
            own[i] += __shfl_xor_sync(lane_mask<LANES>(), shares[k * SHARE], k);
        }
#endif
    }
    return result;
}

// A number kept in a register: the compiler would compute it again in every pass of a loop.
CUDA_CALLABLE inline float kept(float value)
{
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+f"(value));
#endif
    return value;
}

CUDA_CALLABLE inline double kept(double value) { return value; }

template <typename Scalar> CUDA_CALLABLE inline Scalar shuffle(Scalar value, int thread)
{
#if defined(__CUDA_ARCH__)
    return __shfl_sync(~0u, value, thread);
#else
    return value;
#endif
}

// total + factor * value, in vector registers, which the CPU's compiler does not use by itself.
template <typename Group, typename Part>
CUDA_CALLABLE inline Group add_scaled(Group total, Part factor, Group value)
{
#if defined(__CUDA_ARCH__)
    return total + factor * value;
#else
    typedef Part channels __attribute__((vector_size(sizeof(Group))));
    channels sum, product;
    __builtin_memcpy(&sum, &total, sizeof(total));
    __builtin_memcpy(&product, &value, sizeof(value));
    product *= factor;
    sum += product;
    __builtin_memcpy(&total, &sum, sizeof(total));
    return total;
#endif
}

// total + factors x value, row by row; as `add_scaled`.
template <typename Rows, typename Factors, typename Group>
CUDA_CALLABLE inline Rows add_outer(Rows total, Factors factors, Group value)
{
    for (unsigned r = 0; r < sizeof(total) / sizeof(value); ++r) {
        Group& row = reinterpret_cast<Group&>(total.data[r]);
        row = add_scaled(row, factors[r], value);
    }
    return total;
}

// A bit for each value that is below a limit.
template <typename Values, typename Part>
CUDA_CALLABLE inline unsigned bits_below(Values values, Part limit)
{
    constexpr unsigned count = sizeof(values) / sizeof(limit);
#if defined(__clang__) && !defined(__CUDA_ARCH__)
    typedef Part numbers __attribute__((vector_size(sizeof(values))));
    numbers all;
    __builtin_memcpy(&all, &values, sizeof(values));
    auto below = all < limit;
    for (unsigned i = 0; i < count; ++i) below[i] &= 1 << i;
    return __builtin_reduce_or(below);
#else
    unsigned bits = 0;
    for (unsigned i = 0; i < count; ++i) bits |= unsigned(values[i] < limit) << i;
    return bits;
#endif
}

// The sum of the first `count` values, in vector registers.
template <typename Value>
CUDA_CALLABLE inline int sum_of_first(const wp::array_t<Value>& values, int count)
{
    int sum = 0;
    for (int i = 0; i < count; ++i) sum += values.data[i];
    return sum;
}

CUDA_CALLABLE inline int lowest_bit(unsigned bits)
{
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
}

#if defined(__CUDA_ARCH__)

// Unlike in `shuffle`, the source thread differs among the particles of a warp.
__device__ inline int of_lane(int value, int lane, unsigned lanes)
{
    return __shfl_sync(~0u, value, (threadIdx.x & 31u & ~(lanes - 1u)) + lane);
}

__device__ inline int thread_number() { return blockIdx.x * blockDim.x + threadIdx.x; }

__device__ inline int block_number() { return blockIdx.x; }

__device__ inline int thread_of_block() { return threadIdx.x; }

__device__ inline void sync_block() { __syncthreads(); }

__device__ inline void sync_warp() { __syncwarp(); }

__device__ inline bool any_in_warp(bool condition) { return __any_sync(~0u, condition); }

__device__ inline int first_in_warp(bool condition)
{
    return __ffs(__ballot_sync(~0u, condition)) - 1;
}

__device__ inline unsigned vote_of_warp(bool condition) { return __ballot_sync(~0u, condition); }

__device__ inline int largest_in_warp(int value)
{
#if __CUDA_ARCH__ >= 800
    return __reduce_max_sync(~0u, value);
#else
    for (int offset = 16; offset > 0; offset /= 2)
        value = max(value, __shfl_xor_sync(~0u, value, offset));
    return value;
#endif
}

// The sum of a value over this thread and those before it, in a warp or among LANES lanes.
template <unsigned LANES = 32> __device__ inline int sum_up_to(int value)
{
    const unsigned lane = threadIdx.x & (LANES - 1u);
    #pragma unroll
    for (unsigned offset = 1; offset < LANES; offset <<= 1) {
        const int before = __shfl_up_sync(~0u, value, offset, LANES);
        if (lane >= offset) value += before;
    }
    return value;
}

__device__ inline int thread_of(int ends, int number)
{
    unsigned thread = 0;
    #pragma unroll
    for (unsigned step = 16; step > 0; step >>= 1) {
        if (__shfl_sync(~0u, ends, thread + step - 1) <= number) thread += step;
    }
    return thread;
}

__device__ inline int as_number(float word) { return __float_as_int(word); }

__device__ inline float as_word(int number) { return __int_as_float(number); }

#endif

}  // namespace npa
