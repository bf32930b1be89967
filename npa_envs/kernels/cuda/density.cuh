// For cuda/density.py: densities and neighbour lists; a warp serves a tile of eight particles.

namespace npa {

// Particles of a tile, the lanes that share one, and cells on each side in which neighbours lie.
constexpr int TILE_PARTICLES = 8, TILE_LANES = 4, CELLS_PER_EPS = 2;
constexpr int TILE_LINES = 2 * CELLS_PER_EPS + 1;
// A bit for each candidate that a lane tests, and the bits of a word.
constexpr int TILE_TESTS = 32;
// Tests in a row without a check of how many are left.
constexpr int TILE_UNROLLED = 4;
// Largest distance in cells of particles that are served together: those further on come later, so
// that few distant particles do not share all candidates between them.
constexpr int TILE_SPAN = 12;
// Cells along each side of the smallest periodic box whose density is computed in tiles: in smaller
// ones the images of a particle that are nearest to its tile's particles may differ.
constexpr int MIN_SIDE = 7;

// Infinity, as padding: every particle's position is finite.
__device__ inline float nowhere() { return __uint_as_float(0x7f800000u); }

template <int CAPACITY> struct TileMemory {
    // Candidates in memory at a time: fewer with long lists, so that 32 blocks fit on a
    // multiprocessor.
    static constexpr int WINDOW = CAPACITY > 128 ? 192 : 256;
    float2 positions[WINDOW];
    // Differences of their sorted indices from that of the tile's first particle.
    short steps[WINDOW];
    // The additional 16 bytes spread the lists over the banks of shared memory.
    alignas(16) short lists[TILE_PARTICLES][CAPACITY + 8];
};

// Copy 8 bytes from global to shared memory, asynchronously.
__device__ inline void fetch(float2* to, const float2* from)
{
    const unsigned address = (unsigned)__cvta_generic_to_shared(to);
    asm volatile("cp.async.ca.shared.global [%0], [%1], 8;" : : "r"(address), "l"(from)
        : "memory");
}

__device__ inline void await_fetched() { asm volatile("cp.async.wait_all;" : : : "memory"); }

// A run of cells around some of the tile's particles, as one lane copies it: 6 lanes share a run, or
// 3 where lines wrap around the grid and are two runs each.
struct TileRun {
    int begin, count;
    // Index of its first candidate in shared memory, and the number of candidates of all runs.
    int place, total;
    // Index of this lane among those that copy the run, and their number.
    int copier, copiers;
};

// The image of a position in a periodic box that is nearest to another position.
template <typename Domain>
__device__ inline float2 image_near(const Domain& domain, float2 position, float2 other)
{
    position.x -= domain.box[0] * rintf((position.x - other.x) * domain.inverse_box[0]);
    position.y -= domain.box[1] * rintf((position.y - other.y) * domain.inverse_box[1]);
    return position;
}

// The run that this lane copies for the particles from cell `left` to cell `right` of a line.
template <typename Domain>
__device__ inline TileRun run_around(
    const Domain& domain, const int* starts, int left, int right, int line)
{
    const int lane = threadIdx.x & 31;
    const int nx = domain.cell_shape[0], ny = domain.cell_shape[1];
    const int width = right - left + 2 * CELLS_PER_EPS + 1;
    const int first = left - CELLS_PER_EPS < 0 ? left - CELLS_PER_EPS + nx : left - CELLS_PER_EPS;
    const bool wraps = first + width > nx;
    TileRun run;
    run.copiers = wraps ? 3 : 6;
    const int number = wraps ? lane / 3 : lane / 6;
    run.copier = lane - number * run.copiers;
    const bool second = wraps && number & 1;
    const int unwrapped = line - CELLS_PER_EPS + (wraps ? number / 2 : number);
    const int y = unwrapped < 0 ? unwrapped + ny : unwrapped >= ny ? unwrapped - ny : unwrapped;
    run.begin = run.count = 0;
    if (number < (wraps ? 2 * TILE_LINES : TILE_LINES)) {
        const int* line_starts = starts + y * nx;
        const int end = second ? first + width - nx : wraps ? nx : first + width;
        run.begin = line_starts[second ? 0 : first];
        run.count = line_starts[end] - run.begin;
    }
    // The first lane of each run counts its candidates.
    const int end = sum_up_to(run.copier == 0 ? run.count : 0);
    run.place = end - run.count;
    run.total = __shfl_sync(~0u, end, 31);
    return run;
}

// Copy candidates from `window` on into shared memory, in a periodic box their images nearest to an
// origin, followed by padding; return their number.
template <bool PERIODIC, int CAPACITY, typename Domain>
__device__ inline int fetch_window(
    const Domain& domain, TileMemory<CAPACITY>& memory, const TileRun& run,
    const float2* positions, float2 origin, int first, int window)
{
    constexpr int TOGETHER = TILE_LANES * TILE_UNROLLED;
    const int count = min(memory.WINDOW, run.total - window);
    const int place = run.place - window;
    const int end = min(run.count, count - place);
    const int begin = max(-place, 0) + run.copier;
    for (int i = begin; i < end; i += run.copiers) {
        fetch(memory.positions + place + i, positions + run.begin + i);
        memory.steps[place + i] = run.begin + i - first;
    }
    const int padded = (count + TOGETHER - 1) / TOGETHER * TOGETHER;
    const int i = count + (threadIdx.x & 31);
    if (i < padded) memory.positions[i] = make_float2(nowhere(), nowhere());
    await_fetched();
    if (PERIODIC) {
        for (int i = begin; i < end; i += run.copiers) {
            float2& candidate = memory.positions[place + i];
            candidate = image_near(domain, candidate, origin);
        }
    }
    __syncwarp();
    return padded;
}

// Sum of the smoothing kernel over candidates in shared memory, without its norm; `near` gets a bit
// for each, the first in the highest bit: whether 1 - r^2 / eps^2 is positive.
__device__ inline float smoothing_of_candidates(
    const float2* candidates, int tests, float2 centre, float inverse_squared_eps, unsigned& near)
{
    float total = 0.0f;
    for (int test = 0; test < tests; test += TILE_UNROLLED) {
        #pragma unroll
        for (int u = 0; u < TILE_UNROLLED; ++u) {
            const float2 candidate = candidates[(test + u) * TILE_LANES];
            const float x = candidate.x - centre.x, y = candidate.y - centre.y;
            const float squared = fmaf(x, x, y * y);
            total += smoothing(squared, inverse_squared_eps);
            // The sign bit of r^2 / eps^2 - 1, which is 0 for NaN.
            const float beyond = fmaf(squared, inverse_squared_eps, -1.0f);
            near = __funnelshift_l(__float_as_uint(beyond), near, 1);
        }
    }
    near <<= TILE_TESTS - tests;
    return total;
}

// Append the near candidates of a particle's lanes to its list; return its new length, CAPACITY + 1
// if they do not fit. The particle is the `number`-th of its tile.
template <int CAPACITY>
__device__ inline int append_near(
    short* list, int length, const short* steps, int number, unsigned near)
{
    const int own = __popc(near), end = sum_up_to<TILE_LANES>(own);
    const int total = length + __shfl_sync(~0u, end, TILE_LANES - 1, TILE_LANES);
    if (total > CAPACITY) return CAPACITY + 1;
    short* to = list + length + end - own;
    while (near) {
        const int test = __clz(near);
        near &= 0x7fffffffu >> test;
        *to++ = steps[test * TILE_LANES] - number;
    }
    return total;
}

// Sum of the smoothing kernel over all neighbours of particle k, without its norm. All lanes of the
// tile call it together. It also writes the list of the particle's row (-1: none). `first` is the
// tile's first particle, `base` the first cell of their world.
template <int CAPACITY, bool PERIODIC, typename Domain>
__device__ inline float density_of_tile(
    const Domain& domain, const wp::array_t<int>& starts, const wp::array_t<int>& sorted_cell,
    const wp::array_t<wp::vec_t<2, float>>& sorted_positions, int base, int first, int k,
    bool inside, int row, const wp::array_t<wp::int16>& lists, const wp::array_t<int>& list_lengths)
{
    __shared__ TileMemory<CAPACITY> memory;
    const int lane = threadIdx.x & 31, part = lane & (TILE_LANES - 1);
    const float2* positions = reinterpret_cast<const float2*>(sorted_positions.data);
    const float2 position = positions[k];
    const int cell = sorted_cell.data[k] - base;
    const int nx = domain.cell_shape[0], ny = domain.cell_shape[1];
    const int y = (unsigned)cell / (unsigned)nx, x = cell - y * nx;
    // Particles that are served together share one image of each candidate: they and their neighbours
    // are less than half a periodic box away from the first one's cell.
    const int span = min(PERIODIC ? (nx - MIN_SIDE) / 2 : nx - TILE_LINES, TILE_SPAN);
    short* list = memory.lists[lane / TILE_LANES];
    float total = 0.0f;
    int length = 0;
    // Particles of one line are served together: those of a tile are in the order of cells.
    for (unsigned waiting = __ballot_sync(~0u, inside); waiting;) {
        const int leader = __ffs(waiting) - 1;
        const int line = __shfl_sync(~0u, y, leader), left = __shfl_sync(~0u, x, leader);
        const unsigned members = __ballot_sync(~0u, y == line && x - left <= span) & waiting;
        waiting &= ~members;
        const int right = __shfl_sync(~0u, x, 31 - __clz(members));
        // Not the first particle's position, which may be NaN.
        const float2 origin = make_float2(
            (left + 0.5f) * domain.box[0] / nx, (line + 0.5f) * domain.box[1] / ny);
        float2 centre = make_float2(-nowhere(), -nowhere());
        if (members >> lane & 1) {
            centre = PERIODIC ? image_near(domain, position, origin) : position;
        }
        const TileRun run = run_around(domain, starts.data + base, left, right, line);
        for (int window = 0; window < run.total; window += memory.WINDOW) {
            const int count = fetch_window<PERIODIC>(
                domain, memory, run, positions, origin, first, window);
            for (int begin = part; begin < count; begin += TILE_TESTS * TILE_LANES) {
                const int tests = min(TILE_TESTS, (count - begin + part) / TILE_LANES);
                unsigned near = 0u;
                total += smoothing_of_candidates(
                    memory.positions + begin, tests, centre, domain.inverse_squared_eps, near);
                if (row < 0) near = 0u;
                length = append_near<CAPACITY>(
                    list, length, memory.steps + begin, lane / TILE_LANES, near);
            }
            __syncwarp();
        }
    }
    #pragma unroll
    for (int offset = 1; offset < TILE_LANES; offset *= 2) {
        total += __shfl_xor_sync(~0u, total, offset);
    }
    if (row >= 0 && length <= CAPACITY) {
        uint4* to = reinterpret_cast<uint4*>(lists.data + (size_t)row * CAPACITY);
        for (int entries = part; 8 * entries < length; entries += TILE_LANES) {
            to[entries] = reinterpret_cast<const uint4*>(list)[entries];
        }
    }
    if (row >= 0 && part == 0) list_lengths.data[row] = length;
    return total;
}

}  // namespace npa
