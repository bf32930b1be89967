// For cuda/perceive.py: perception; access to states and to a particle's scratch, writing of rows.
//
// The scratch is the part of shared memory that the lanes of a particle use. It contains a short
// list of neighbours, first only their indices, then each with its weights; at the end it contains
// the resulting row of perception, to be written. Votes are of complete warps, so all threads of a
// warp must take the same branches: votes among the lanes of a particle would make the particles of
// a warp run one after the other.

namespace npa {

template <int BYTES, int LANES, int BLOCK> __device__ inline unsigned scratch_address()
{
    __shared__ __align__(16) unsigned char scratches[BLOCK / LANES * BYTES];
    return (unsigned)__cvta_generic_to_shared(scratches + threadIdx.x / LANES * BYTES);
}

// Address of a part of the first state, computed once: if the compiler added the part's index for
// each state, that would take two instructions more.
template <typename Share>
__device__ inline unsigned long long part_address(const wp::array_t<Share>& states, int part)
{
    size_t address = __cvta_generic_to_global(states.data + part);
    asm volatile("" : "+l"(address));
    return address;
}

template <typename Share>
__device__ inline Share part_of_state(unsigned long long address, int part_count, int number)
{
    Share result;
    address += (unsigned long long)(unsigned)number * (unsigned)(sizeof(Share) * part_count);
    load_chunks<chunk_bytes(sizeof(Share))>(result, __cvta_global_to_generic(address));
    return result;
}

// Four words of an entry are adjacent: in 2D the last is its index; in 3D indices follow all entries.
template <int DIMS, int ENTRIES> __device__ inline int* number_place(unsigned scratch, int entry)
{
    const unsigned place = DIMS == 2 ? scratch + 12 + 16 * entry : scratch + 16 * ENTRIES + 4 * entry;
    return reinterpret_cast<int*>(__cvta_shared_to_generic(place));
}

template <int DIMS, int ENTRIES, int LANES>
__device__ inline int append_number(unsigned scratch, int count, bool accepted, int number)
{
    const unsigned lanes = lane_mask<LANES>();
    const unsigned before = lanes & ((1u << (threadIdx.x & 31u)) - 1u);
    const unsigned votes = __ballot_sync(~0u, accepted);
    if (accepted) *number_place<DIMS, ENTRIES>(scratch, count + __popc(votes & before)) = number;
    return count + __popc(votes & lanes);
}

template <int DIMS, int ENTRIES> __device__ inline int number_at(unsigned scratch, int entry)
{
    return *number_place<DIMS, ENTRIES>(scratch, entry);
}

template <int DIMS, int ENTRIES>
__device__ inline void put_entry(
    unsigned scratch, int entry, float smooth, wp::vec_t<DIMS, float> kernel, int number)
{
    float4 packed;
    packed.x = smooth;
    packed.y = kernel[0];
    packed.z = kernel[1];
    packed.w = DIMS == 2 ? __int_as_float(number) : kernel[DIMS - 1];
    *reinterpret_cast<float4*>(__cvta_shared_to_generic(scratch + 16 * entry)) = packed;
    if (DIMS == 3) *number_place<DIMS, ENTRIES>(scratch, entry) = number;
}

template <int DIMS, int ENTRIES>
__device__ inline wp::vec_t<DIMS + 2, float> entry_at(unsigned scratch, int entry)
{
    const float4 packed =
        *reinterpret_cast<const float4*>(__cvta_shared_to_generic(scratch + 16 * entry));
    wp::vec_t<DIMS + 2, float> result;
    result[0] = packed.x;
    result[1] = packed.y;
    result[2] = packed.z;
    result[3] = packed.w;
    if (DIMS == 3) result[DIMS + 1] = __int_as_float(*number_place<DIMS, ENTRIES>(scratch, entry));
    return result;
}

template <typename Value> __device__ inline void stage(unsigned scratch, int word, Value value)
{
    store_chunks<chunk_bytes(sizeof(Value))>(__cvta_shared_to_generic(scratch + 4 * word), value);
}

// A complete warp writes one particle's row after the other, so that rows take few, full transactions;
// in pairs of words if the channels fill their group, as the scratch then has its row's layout.
template <int DIMS, int WIDTH, int LANES, int ROW_WORDS, int BYTES, bool GROUPED>
__device__ inline void write_rows(
    unsigned scratch, int destination, int group, int state_dim, float limit,
    const wp::array_t<float>& rows)
{
    __syncwarp();
    const unsigned lane = threadIdx.x & 31u;
    const unsigned scratches = scratch - lane / LANES * BYTES;
    const bool paired = ((size_t)rows.data | 4 * (size_t)rows.shape[1]) % 8 == 0;
    if (!GROUPED && state_dim == WIDTH && paired) {
        char* base = reinterpret_cast<char*>(rows.data + 2 * lane);
        unsigned from = scratches + 8 * lane;
        // Common to all particles, so computed once.
        asm volatile("" : "+l"(base), "+r"(from));
        #pragma unroll
        for (unsigned s = 0; s < 32 / LANES; ++s) {
            const int row = __shfl_sync(~0u, destination, s * LANES);
            float2* to = reinterpret_cast<float2*>(
                base + (unsigned long long)(unsigned)row * (4u * rows.shape[1]));
            #pragma unroll
            for (unsigned part = 0; part < (ROW_WORDS + 63) / 64; ++part) {
                float2 pair;
                asm volatile("ld.shared.v2.f32 {%0, %1}, [%2];"
                    : "=f"(pair.x), "=f"(pair.y) : "r"(from + s * BYTES + 256 * part));
                pair.x = within(pair.x, limit);
                pair.y = within(pair.y, limit);
                if (row >= 0 && part * 64 + 2 * lane < ROW_WORDS) to[32 * part] = pair;
            }
        }
        return;
    }
    #pragma unroll
    for (unsigned s = 0; s < 32 / LANES; ++s) {
        const int row = __shfl_sync(~0u, destination, s * LANES);
        const int first = GROUPED ? __shfl_sync(~0u, group, s * LANES) * WIDTH : 0;
        float* to = rows.data + (size_t)(unsigned)row * (unsigned)rows.shape[1];
        #pragma unroll
        for (unsigned part = 0; part < (ROW_WORDS + 31) / 32; ++part) {
            const int word = part * 32 + lane;
            int channel = word;
            int column = word + first;
            if (word >= WIDTH) {
                channel = word - WIDTH;
                column = state_dim + channel + first;
            }
            if (word >= 2 * WIDTH) {
                const int component = word - 2 * WIDTH;
                channel = component / DIMS;
                column = 2 * state_dim + component + first * DIMS;
            }
            if (word < ROW_WORDS && row >= 0 && channel + first < state_dim) {
                const float value = *reinterpret_cast<const float*>(
                    __cvta_shared_to_generic(scratches + s * BYTES + 4 * word));
                to[column] = within(value, limit);
            }
        }
    }
}

}  // namespace npa
