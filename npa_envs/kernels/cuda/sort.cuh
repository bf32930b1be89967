// For cuda/sort.py: one block sorts the particles of a world into cells, in shared memory.

namespace npa {

// Counts, later starts, of cells: of all particles in the low 16 bits, of active ones in the high.
// Then each particle's cell and order of arrival there, and the particle at each provisional
// position: arrivals and members are doubled, plus one if the particle is active.
template <int CAPACITY, int BLOCK, int GRID> struct SortMemory {
    int starts[GRID + 1];
    int sums[BLOCK / 32];
    int earlier;
    unsigned short cells[CAPACITY];
    unsigned short arrivals[CAPACITY];
    unsigned short members[CAPACITY];
};

// The address of the block's memory.
template <int CAPACITY, int BLOCK, int GRID> __device__ inline unsigned long long block_memory()
{
    __shared__ SortMemory<CAPACITY, BLOCK, GRID> memory;
    return (unsigned long long)&memory;
}

template <int CAPACITY, int BLOCK, int GRID>
__device__ inline SortMemory<CAPACITY, BLOCK, GRID>& memory_at(unsigned long long address)
{
    return *reinterpret_cast<SortMemory<CAPACITY, BLOCK, GRID>*>(address);
}

__device__ inline int count_active(const wp::array_t<wp::uint8>& mask, int count)
{
    int sum = 0;
    const uint4* chunks = reinterpret_cast<const uint4*>(mask.data);
    for (int chunk = threadIdx.x; chunk < count / 16; chunk += blockDim.x) {
        const uint4 flags = chunks[chunk];
        sum += __popc(__vsetne4(flags.x, 0)) + __popc(__vsetne4(flags.y, 0));
        sum += __popc(__vsetne4(flags.z, 0)) + __popc(__vsetne4(flags.w, 0));
    }
    const int rest = count / 16 * 16 + threadIdx.x;
    if (rest < count) sum += mask.data[rest] != 0;
    return sum;
}

// Set all cells' counts to 0; sum `earlier`, the rows of earlier worlds by thread.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline void clear_counts(unsigned long long address, int cell_count, int earlier)
{
    auto& memory = memory_at<CAPACITY, BLOCK, GRID>(address);
    for (int cell = threadIdx.x; cell < cell_count; cell += blockDim.x) memory.starts[cell] = 0;
    if (threadIdx.x == 0) memory.earlier = 0;
    __syncthreads();
    const int sum = __reduce_add_sync(~0u, earlier);
    if ((threadIdx.x & 31u) == 0) atomicAdd(&memory.earlier, sum);
}

// Count a particle in its cell, and store its order of arrival there.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline void count_particle(unsigned long long address, int particle, int cell, bool active)
{
    auto& memory = memory_at<CAPACITY, BLOCK, GRID>(address);
    const int before = atomicAdd(&memory.starts[cell], active ? 1 << 16 | 1 : 1);
    memory.cells[particle] = cell;
    memory.arrivals[particle] = (before & 0xffff) << 1 | active;
}

// Replace each cell's count by its start, the sum of the counts of all cells before. A thread sums
// some adjacent cells, a warp its threads, and every thread the warps before it.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline void add_up_counts(unsigned long long address, int cell_count)
{
    auto& memory = memory_at<CAPACITY, BLOCK, GRID>(address);
    __syncthreads();
    const int share = (cell_count + blockDim.x - 1) / blockDim.x;
    const int begin = min((int)threadIdx.x * share, cell_count);
    const int end = min(begin + share, cell_count);
    int sum = 0;
    for (int cell = begin; cell < end; ++cell) sum += memory.starts[cell];
    const unsigned lane = threadIdx.x & 31u;
    int before = sum_up_to(sum);
    if (lane == 31u) memory.sums[threadIdx.x / 32] = before;
    before -= sum;
    __syncthreads();
    before += __reduce_add_sync(~0u, lane < threadIdx.x / 32 ? memory.sums[lane] : 0);
    for (int cell = begin; cell < end; ++cell) {
        const int count = memory.starts[cell];
        memory.starts[cell] = before;
        before += count;
    }
    if (threadIdx.x == blockDim.x - 1) memory.starts[cell_count] = before;
    __syncthreads();
}

// The sorted index in the world, and row among all worlds, where a cell begins.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline wp::vec_t<2, int> start_of(unsigned long long address, int cell)
{
    auto& memory = memory_at<CAPACITY, BLOCK, GRID>(address);
    const int start = memory.starts[cell];
    return wp::vec_t<2, int>(start & 0xffff, memory.earlier + (start >> 16));
}

// Write a particle to its provisional index: its cell's start plus its order of arrival.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline void place_arrived(unsigned long long address, int particle)
{
    auto& memory = memory_at<CAPACITY, BLOCK, GRID>(address);
    const int arrival = memory.arrivals[particle];
    const int place = (memory.starts[memory.cells[particle]] & 0xffff) + (arrival >> 1);
    memory.members[place] = particle << 1 | arrival & 1;
}

// The first and last + 1 provisional index of all cells that a slice touches. A block writes one slice
// of its world: the sorted indices from `begin` to before `end`. Provisional indices go by cell, then
// by arrival.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline wp::vec_t<2, int> span_of_slice(unsigned long long address, int begin, int end)
{
    auto& memory = memory_at<CAPACITY, BLOCK, GRID>(address);
    const int first_cell = memory.cells[memory.members[begin] >> 1];
    const int last_cell = memory.cells[memory.members[end - 1] >> 1];
    return wp::vec_t<2, int>(
        memory.starts[first_cell] & 0xffff, memory.starts[last_cell + 1] & 0xffff
    );
}

// The sorted index, cell and row (-1: none) of the particle at a provisional index. In the cell
// `unordered` (-1: none) provisional indices are final.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline wp::vec_t<3, int> ranked_at(unsigned long long address, int place, int unordered)
{
    auto& memory = memory_at<CAPACITY, BLOCK, GRID>(address);
    const int entry = memory.members[place];
    const int cell = memory.cells[entry >> 1];
    if (cell == unordered) return wp::vec_t<3, int>(place, cell, -1);
    const int start = memory.starts[cell];
    const int end = memory.starts[cell + 1] & 0xffff;
    int ranked = start & 0xffff;
    int row = start >> 16;
    for (int other = start & 0xffff; other < end; ++other) {
        const int member = memory.members[other];
        ranked += member < entry;
        row += member < entry & member;
    }
    row = entry & 1 ? memory.earlier + row : -1;
    return wp::vec_t<3, int>(ranked, cell, row);
}

// The particle at a provisional index, by its index in the world.
template <int CAPACITY, int BLOCK, int GRID>
__device__ inline int member_at(unsigned long long address, int place)
{
    return memory_at<CAPACITY, BLOCK, GRID>(address).members[place] >> 1;
}

// Mean of a world's positions, summed in the order of kernels/portable/world_mean.py: a warp sums
// CHUNK values, then the chunks' sums. All threads of the block call it and get the mean.
template <int CAPACITY, int CHUNK>
__device__ inline wp::vec_t<2, float> mean_of_world(
    const wp::array_t<wp::vec_t<2, float>>& positions, int first, int count)
{
    __shared__ double sums[2 * CAPACITY / CHUNK];
    const int lane = threadIdx.x & 31, chunks = (count + CHUNK - 1) / CHUNK;
    for (int task = threadIdx.x / 32; task < 2 * chunks; task += blockDim.x / 32) {
        const int chunk = task / 2, end = min((chunk + 1) * CHUNK, count);
        double total = 0.0;
        for (int i = chunk * CHUNK + lane; i < end; i += 32) {
            total += (double)positions.data[first + i][task & 1];
        }
        total = lane_sum<double, 32, true, 1>(total);
        if (lane == 0) sums[task] = total;
    }
    __syncthreads();
    double totals[2] = {0.0, 0.0};
    for (int chunk = lane; chunk < chunks; chunk += 32) {
        totals[0] += sums[2 * chunk];
        totals[1] += sums[2 * chunk + 1];
    }
    for (double& total : totals) total = lane_sum<double, 32, true, 1>(total);
    return wp::vec_t<2, float>((float)(totals[0] / count), (float)(totals[1] / count));
}

}  // namespace npa
