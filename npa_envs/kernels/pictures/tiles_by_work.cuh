// For pictures/pixel_errors.py: order of a picture's tiles by descending numbers of candidates.

namespace npa {

// Tiles in the order of their ranks: their candidates times CAPACITY, plus CAPACITY - 1 less their
// number.
template <int CAPACITY> __device__ inline int* ranked_tiles()
{
    __shared__ int ranked[CAPACITY];
    return ranked;
}

// Sort the block's tiles, one per thread, by descending numbers of particles around them.
template <int CAPACITY> __device__ inline void rank_tiles(int tile_count, int candidates)
{
    __shared__ int4 keys[CAPACITY / 4];
    const int tile = threadIdx.x;
    // More need not be distinguished: the order only saves time.
    const int key = min(candidates, (1 << 30) / CAPACITY) * CAPACITY + CAPACITY - 1 - tile;
    if (tile < tile_count) reinterpret_cast<int*>(keys)[tile] = key;
    __syncthreads();
    if (tile < tile_count) {
        int rank = 0;
        for (int i = 0; i < tile_count / 4; ++i) {
            const int4 others = keys[i];
            // The signs of the differences, which are small enough.
            rank += unsigned(key - others.x) >> 31;
            rank += unsigned(key - others.y) >> 31;
            rank += unsigned(key - others.z) >> 31;
            rank += unsigned(key - others.w) >> 31;
        }
        ranked_tiles<CAPACITY>()[rank] = key;
    }
    __syncthreads();
}

// The tile of a rank in the block and its number of particles, -1 for no tile.
template <int CAPACITY> __device__ inline wp::vec_t<2, int> ranked_tile(int rank)
{
    const unsigned key = ranked_tiles<CAPACITY>()[rank] + CAPACITY;  // which is not negative
    return {CAPACITY - 1 - int(key % CAPACITY), int(key / CAPACITY) - 1};
}

}  // namespace npa
