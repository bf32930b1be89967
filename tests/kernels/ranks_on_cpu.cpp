// Ranks of tiles by `rank_tiles`: most candidates first, each tile once.

#include <algorithm>

#include "cuda_on_cpu.h"

#include "tiles_by_work.cuh"

constexpr int CAPACITY = 128;

int check(int tile_count, int limit)
{
    std::vector<int> candidates(32), counts(tile_count), tiles(tile_count);
    // None around a tile, and no tile at all.
    for (int& count : candidates) count = std::rand() % limit - 1;
    candidates[3] = candidates[5] = -1;
    candidates[4] = 0;
    block::run(32, [&] {
        npa::rank_tiles<CAPACITY>(tile_count, candidates[threadIdx.x]);
        if (int(threadIdx.x) < tile_count) {
            const wp::vec_t<2, int> ranked = npa::ranked_tile<CAPACITY>(threadIdx.x);
            tiles[threadIdx.x] = ranked[0];
            counts[threadIdx.x] = ranked[1];
        }
    });
    int wrong = !std::is_sorted(counts.rbegin(), counts.rend());
    for (int rank = 0; rank < tile_count; ++rank) {
        wrong += counts[rank] != candidates[tiles[rank]];
    }
    std::sort(tiles.begin(), tiles.end());
    for (int tile = 0; tile < tile_count; ++tile) wrong += tiles[tile] != tile;
    return wrong;
}

int main()
{
    int wrong = 0;
    for (int tile_count : {8, 16, 32}) {
        for (int limit : {3, 90, 4000000}) wrong += check(tile_count, limit);
    }
    std::printf("%d wrong\n", wrong);
    return wrong != 0;
}
