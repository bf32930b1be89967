// For pictures/blending.py: backward pass; sums over the warps of a block, in shared memory.

namespace npa {

// Writes the value that a warp's first thread has for pair i, or returns an entry of the sum over
// the warps; both in one function, as they share its memory.
template <int BATCH, int WARPS, unsigned SIZE, typename Part>
__device__ inline Part store_or_sum(bool write, int i, int entry, wp::vec_t<SIZE, Part> value)
{
    __shared__ Part stored[BATCH][WARPS][SIZE];
    Part sum = 0;
    if (!write) {
        #pragma unroll
        for (unsigned warp = 0; warp < WARPS; ++warp) sum += stored[i][warp][entry];
    } else if ((threadIdx.x & 31u) == 0) {
        #pragma unroll
        for (unsigned k = 0; k < SIZE; ++k) stored[i][threadIdx.x / 32u][k] = value[k];
    }
    return sum;
}

}  // namespace npa
