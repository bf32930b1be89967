// For cuda/whole_rollout.py: all steps of a rollout of small 2D worlds, each in shared memory.
//
// A group of WARPS warps owns a world; the groups of a block share one copy of the weights. Particles
// are sorted along a Hilbert curve, and again every few steps, so that eight in a row are close. A step
// has two phases. In the first one all particles get their density, and a row for their neighbours:
// volume times state, each split into two float16 numbers. In the second one a warp takes 16 active
// particles at a time. Its sums over neighbours are products on tensor cores, and their result stays in
// registers as the left operand of the network; `network.cuh` explains both. Tensor cores truncate, so
// each product of 16 neighbours starts at 0 and is added outside of them. Moments, which cancel in wide
// worlds, are summed in float32.
//
// With CLUSTER 2 two blocks own a world together: each has all of it, and `put` writes to both.
// No sum depends on WARPS, CLUSTER or the number of groups, so a world has the same bits in each.

namespace npa {

constexpr float SHARPNESS = 64.0f;  // Weights of gradients are SHARPNESS^2 K: their float16 parts are not tiny.
constexpr float FAR_AWAY = 1e18f;   // Place of particles that fill up a block of eight.

template <int N, int BLOCKS> struct WorldMemory {
    static constexpr int ROW = 32 * BLOCKS + 16;  // High parts, low parts, place and volume.
    static constexpr int states = (N + 8) * ROW, places = states + 32 * N * BLOCKS,
        active = places + 16 * (N + 8), number = active + 2 * N, counts = number + 2 * N,
        largest = counts + 128, bytes = largest + 16;
};

// Parts of the weights in shared memory, of `units` groups of 16 hidden units.
template <int BLOCKS> struct NetworkMemory {
    int hidden, extra, output, unscale, bytes;

    __device__ NetworkMemory(int units)
        : hidden(0), extra(units * 2048 * BLOCKS), output(extra + units * 256),
          unscale(output + units * 512 * (BLOCKS + 1)), bytes(unscale + 128) {}
};

__device__ inline void multiply_half8(float (&sum)[4], const unsigned (&a)[2], unsigned b)
{
    asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 "
        "{%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3]) : "r"(a[0]), "r"(a[1]), "r"(b));
}

// Four matrices of 8 rows of 16 bytes, transposed; each eighth of the warp gives the rows of one.
__device__ inline void load_transposed(unsigned (&parts)[4], unsigned address)
{
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
        : "=r"(parts[0]), "=r"(parts[1]), "=r"(parts[2]), "=r"(parts[3]) : "r"(address) : "memory");
}

__device__ inline float rsqrt_fast(float value)
{
    float result;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(value));
    return result;
}

// Synchronize THREADS threads of a block, which use the same barrier.
template <int THREADS> __device__ inline void sync_threads(int barrier)
{
    asm volatile("bar.sync %0, %1;" :: "r"(barrier), "n"(THREADS) : "memory");
}

// Writes to the shared memory of the cluster's other block.
template <typename Value> __device__ inline void put_far(unsigned address, const Value& value)
{
    const unsigned* words = reinterpret_cast<const unsigned*>(&value);
    if constexpr (sizeof(Value) == 16) {
        asm volatile("st.shared::cluster.v4.u32 [%0], {%1, %2, %3, %4};"
            :: "r"(address), "r"(words[0]), "r"(words[1]), "r"(words[2]), "r"(words[3]) : "memory");
    } else if constexpr (sizeof(Value) == 2) {
        asm volatile("st.shared::cluster.u16 [%0], %1;" :: "r"(address), "h"(value) : "memory");
    } else {
        for (unsigned k = 0; k < sizeof(Value) / 4; ++k)
            asm volatile("st.shared::cluster.u32 [%0], %1;" :: "r"(address + 4 * k), "r"(words[k]) : "memory");
    }
}

// Place of a cell on Hilbert's curve of 256 x 256 cells.
__device__ inline unsigned hilbert_place(unsigned x, unsigned y)
{
    unsigned place = 0;
    #pragma unroll
    for (unsigned bit = 128; bit > 0; bit >>= 1) {
        const unsigned right = (x & bit) != 0, up = (y & bit) != 0;
        place += bit * bit * ((3 * right) ^ up);
        if (!up) {
            if (right) { x = 255 - x; y = 255 - y; }
            const unsigned swap = x; x = y; y = swap;
        }
    }
    return place;
}

struct Bounds {
    float left = 3e38f, right = -3e38f, low = 3e38f, high = -3e38f;

    __device__ void include(float2 p)
    {
        left = fminf(left, p.x); right = fmaxf(right, p.x);
        low = fminf(low, p.y); high = fmaxf(high, p.y);
    }

    // Those of threads whose numbers differ in bits FIRST to LAST / 2.
    template <int FIRST, int LAST> __device__ void combine()
    {
        #pragma unroll
        for (int bit = FIRST; bit < LAST; bit *= 2) {
            left = fminf(left, __shfl_xor_sync(~0u, left, bit));
            right = fmaxf(right, __shfl_xor_sync(~0u, right, bit));
            low = fminf(low, __shfl_xor_sync(~0u, low, bit));
            high = fmaxf(high, __shfl_xor_sync(~0u, high, bit));
        }
    }
};

// Bits for the blocks of eight particles of a world.
template <bool WIDE> struct BlockBits { using Type = unsigned; };
template <> struct BlockBits<true> { using Type = unsigned long long; };

__device__ inline int first_block(unsigned bits) { return __ffs(bits) - 1; }
__device__ inline int first_block(unsigned long long bits) { return __ffsll(bits) - 1; }

// Those of which a particle is within a distance of the bounds.
template <int N>
__device__ inline auto blocks_near(const float2* places, const Bounds& bounds, float distance)
{
    using Bits = typename BlockBits<(N > 256)>::Type;
    if constexpr (N <= 64) return (Bits(1) << N / 8) - 1;
    const unsigned lane = threadIdx.x & 31u;
    const float x = 0.5f * (bounds.left + bounds.right), y = 0.5f * (bounds.low + bounds.high);
    const float width = 0.5f * (bounds.right - bounds.left), height = 0.5f * (bounds.high - bounds.low);
    // Far from the origin these are rounded.
    distance = fmaf(1e-6f, fabsf(x) + fabsf(y) + width + height, distance);
    Bits near = 0;
    #pragma unroll
    for (int first = 0; first < N / 8; first += 32) {
        const unsigned block = first + lane;
        float nearest = 3e38f;
        if (block < N / 8) {
            #pragma unroll
            for (int c = 0; c < 4; ++c) {
                // In another order in each lane, which avoids bank conflicts.
                const float4 two = reinterpret_cast<const float4*>(places)[block * 4 + ((c + (lane >> 1)) & 3)];
                const float ax = fmaxf(fabsf(two.x - x) - width, 0.0f), ay = fmaxf(fabsf(two.y - y) - height, 0.0f);
                const float bx = fmaxf(fabsf(two.z - x) - width, 0.0f), by = fmaxf(fabsf(two.w - y) - height, 0.0f);
                nearest = fminf(nearest, fminf(fmaf(ax, ax, ay * ay), fmaf(bx, bx, by * by)));
            }
        }
        // Of places so far away, or not a number, squares and roundings say nothing.
        if (!(width + height < 1e15f)) nearest = 0.0f;
        near |= Bits(__ballot_sync(~0u, block < N / 8 && nearest < distance * distance)) << first;
    }
    return near;
}

// Weights of both layers, scaled and split as `arrange_hidden` and `arrange_output` do it, in the order
// in which `perceive_and_update` reads them. Groups of 8 columns of rows are states, smoothed
// states, x and y components of gradients. The extra columns are the density gradient and the bias.
// Outputs are changes of states, filled up to a multiple of 8, then the two coordinates of δ.
template <int BLOCKS>
__device__ inline void arrange_network(
    unsigned char* shared, float* scales, int units, int state_dim, int gradient_column,
    int density_column, const wp::array_t<float>& hidden, const wp::array_t<float>& bias,
    const wp::array_t<float>& output)
{
    const NetworkMemory<BLOCKS> memory(units);
    const int hidden_dim = hidden.shape[0], width = hidden.shape[1], warps = blockDim.x / 32;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    for (int unit = warp; unit < 16 * units; unit += warps) {
        float size = unit < hidden_dim && lane == 0 ? fabsf(bias.data[unit]) : 0.0f;
        for (int c = lane; unit < hidden_dim && c < width; c += 32)
            size += fabsf(hidden.data[(size_t)unit * width + c]);
        size = lane_sum<float, 32, true, 1>(size);
        if (lane == 0) scales[unit] = scale_to(size, 4);
    }
    __syncthreads();
    float* unscale = reinterpret_cast<float*>(shared + memory.unscale);
    auto weight_of_output = [&](int column, int unit) {
        const int move = column - 8 * BLOCKS, row = move < 0 ? column + 2 : move < 2 ? move : output.shape[0];
        if (unit >= hidden_dim || row >= output.shape[0]) return 0.0f;
        return output.data[(size_t)row * hidden_dim + unit] / scales[unit];
    };
    for (int column = warp; column < 8 * BLOCKS + 8; column += warps) {
        float size = 0.0f;
        for (int unit = lane; unit < hidden_dim; unit += 32) size = fmaxf(size, fabsf(weight_of_output(column, unit)));
        #pragma unroll
        for (int bit = 1; bit < 32; bit *= 2) size = fmaxf(size, __shfl_xor_sync(~0u, size, bit));
        if (lane == 0) unscale[column] = 1.0f / scale_to(size, 7);
    }
    __syncthreads();

    auto layer1 = [&](int unit, int column) {
        if (unit >= hidden_dim || column < 0) return 0.0f;
        return hidden.data[(size_t)unit * width + column] * scales[unit];
    };
    auto row_column = [&](int block, int channel) {
        const int kind = block / BLOCKS, c = block % BLOCKS * 8 + channel;
        if (c >= state_dim || (kind >= 2 && gradient_column < 0)) return -1;
        return kind < 2 ? kind * state_dim + c : gradient_column + 2 * c + kind - 2;
    };
    unsigned* words = reinterpret_cast<unsigned*>(shared + memory.hidden);
    for (int k = threadIdx.x; k < units * 256 * BLOCKS; k += blockDim.x) {
        // Of a left operand's 16 columns a thread has two of the first and two of the second eight.
        const int half = k & 1, thread = k / 2 & 31, tile = k / 64 % (2 * BLOCKS), side = k / 128 / BLOCKS;
        const int unit = side * 8 + thread / 4, channel = thread % 4 * 2, block = 2 * tile + half;
        unsigned* at = words + (k / 2) * 4 + half;
        split_half(layer1(unit, row_column(block, channel)), layer1(unit, row_column(block, channel + 1)),
            at[0], at[2]);
    }
    words = reinterpret_cast<unsigned*>(shared + memory.extra);
    for (int k = threadIdx.x; k < units * 64; k += blockDim.x) {
        const int unit = k / 32 * 8 + k % 32 / 4, t = k & 3;
        const float x = layer1(unit, density_column), y = layer1(unit, density_column < 0 ? -1 : density_column + 1);
        const float b = unit < hidden_dim ? bias.data[unit] * scales[unit] : 0.0f;
        unsigned high, low, high_bias, low_bias;
        split_half(x, y, high, low);
        split_half(b, 0.0f, high_bias, low_bias);
        // By pairs of columns: x, y | b, x | y, and the low parts of x | y, b.
        words[k] = t == 0 ? high : t == 1 ? __byte_perm(high_bias, high, 0x5410)
            : t == 2 ? __byte_perm(high, low, 0x5432) : __byte_perm(low, low_bias, 0x5432);
    }
    words = reinterpret_cast<unsigned*>(shared + memory.output);
    for (int k = threadIdx.x; k < units * 64 * (BLOCKS + 1); k += blockDim.x) {
        const int half = k & 1, thread = k / 2 & 31, tile = k / 64 % (BLOCKS + 1), group = k / 64 / (BLOCKS + 1);
        const int column = tile * 8 + thread / 4, unit = group * 16 + half * 8 + thread % 4 * 2;
        const float scale = 1.0f / unscale[column];
        unsigned* at = words + (k / 2) * 4 + half;
        split_half(weight_of_output(column, unit) * scale, weight_of_output(column, unit + 1) * scale, at[0], at[2]);
    }
}

// A coordinate within walls at plus and minus half a side that mirror it.
__device__ inline float mirrored(float x, float side)
{
    const float image = floorf(x / side + 0.5f);
    const float inside = x - side * image;
    return image != 2.0f * floorf(0.5f * image) ? -inside : inside;
}

// A group of threads that owns worlds, and access to its memory.
template <int N, int WARPS, int CLUSTER, int BLOCKS> struct WorldGroup {
    using Memory = WorldMemory<N, BLOCKS>;
    static constexpr int PARTS = 2 * BLOCKS;
    unsigned char* base;
    int number, warp, rank;
    unsigned across;  // From an address in this block to the same one in the cluster's other block.

    __device__ WorldGroup(unsigned char* groups)
    {
        number = (threadIdx.x >> 5) / WARPS;
        base = groups + number * Memory::bytes;
        rank = across = 0;
        if constexpr (CLUSTER == 2) {
            rank = blockIdx.x & 1;
            const unsigned own = (unsigned)__cvta_generic_to_shared(base);
            asm volatile("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(across) : "r"(own), "r"(rank ^ 1));
            across -= own;
        }
        warp = (threadIdx.x >> 5) % WARPS * CLUSTER + rank;
    }

    __device__ float2* places(int step) const
    {
        return reinterpret_cast<float2*>(base + Memory::places) + (step & 1) * (N + 8);
    }
    __device__ unsigned short* active() const { return reinterpret_cast<unsigned short*>(base + Memory::active); }
    __device__ unsigned short* original() const { return reinterpret_cast<unsigned short*>(base + Memory::number); }
    __device__ int* counts(int step) const { return reinterpret_cast<int*>(base + Memory::counts) + (step & 1) * 16; }
    __device__ unsigned* largest() const { return reinterpret_cast<unsigned*>(base + Memory::largest); }
    __device__ unsigned char* row(int i) const { return base + i * Memory::ROW; }

    // Four channels of a state; the order of a state's parts avoids bank conflicts.
    __device__ float4* state(int i, int part) const
    {
        const int turned = (part ^ (i >> (BLOCKS == 2 ? 1 : 2))) & (2 * BLOCKS - 1);
        return reinterpret_cast<float4*>(base + Memory::states + i * 32 * BLOCKS) + turned;
    }
    // Channels 8 block + 2 t and the next one.
    __device__ float2* channels(int i, int block, int t) const
    {
        return reinterpret_cast<float2*>(state(i, 2 * block + (t >> 1))) + (t & 1);
    }

    template <typename Value> __device__ void put(Value* at, Value value) const
    {
        *at = value;
        if constexpr (CLUSTER == 2) put_far((unsigned)__cvta_generic_to_shared(at) + across, value);
    }

    __device__ void enlarge(unsigned value) const
    {
        atomicMax(largest(), value);
        if constexpr (CLUSTER == 2) {
            asm volatile("red.shared::cluster.max.u32 [%0], %1;"
                :: "r"((unsigned)__cvta_generic_to_shared(largest()) + across), "r"(value) : "memory");
        }
    }

    __device__ void sync_in_block() const
    {
        __syncwarp();
        if constexpr (WARPS > 1) sync_threads<WARPS * 32>(number + 1);
    }
    __device__ void sync() const
    {
        if constexpr (CLUSTER == 2) {
            __syncwarp();
            asm volatile("barrier.cluster.arrive.release;\nbarrier.cluster.wait.acquire;" ::: "memory");
        } else {
            sync_in_block();
        }
    }
};

// Sort a world's particles along a Hilbert curve; those beyond `count` stay last.
template <int N, int WARPS, typename Group>
__device__ inline void sort_world(const Group& group, int step, int count, float cells)
{
    constexpr int OWN = (N + WARPS * 32 - 1) / (WARPS * 32);
    const int lane = threadIdx.x & 31, thread = threadIdx.x % (WARPS * 32);
    float2* places = group.places(step);
    unsigned short* original = group.original();
    unsigned* keys = reinterpret_cast<unsigned*>(group.base);  // Rows are not needed at this time.
    Bounds world;
    for (int i = lane; i < count; i += 32) world.include(places[i]);
    world.combine<1, 32>();
    const float x = 0.5f * (world.left + world.right), y = 0.5f * (world.low + world.high);
    unsigned key[OWN];
    int rank[OWN];
    float2 place[OWN];
    float4 state[OWN][Group::PARTS];
    unsigned short number[OWN];
    #pragma unroll
    for (int o = 0; o < OWN; ++o) {
        const int i = o * WARPS * 32 + thread;
        if (i >= N) continue;
        place[o] = places[i];
        number[o] = original[i];
        #pragma unroll
        for (int c = 0; c < Group::PARTS; ++c) state[o][c] = *group.state(i, c);
        const int column = min(max(__float2int_rd((place[o].x - x) * cells) + 128, 0), 255);
        const int line = min(max(__float2int_rd((place[o].y - y) * cells) + 128, 0), 255);
        key[o] = (i < count ? hilbert_place(column, line) : 65536u) << 9 | i;
        keys[i] = key[o];
        rank[o] = 0;
    }
    group.sync_in_block();
    for (int k = 0; k < N / 4; ++k) {
        const uint4 other = reinterpret_cast<const uint4*>(keys)[k];
        #pragma unroll
        for (int o = 0; o < OWN; ++o)
            rank[o] += (other.x < key[o]) + (other.y < key[o]) + (other.z < key[o]) + (other.w < key[o]);
    }
    group.sync_in_block();
    #pragma unroll
    for (int o = 0; o < OWN; ++o) {
        if (o * WARPS * 32 + thread >= N) continue;
        places[rank[o]] = place[o];
        original[rank[o]] = number[o];
        #pragma unroll
        for (int c = 0; c < Group::PARTS; ++c) *group.state(rank[o], c) = state[o][c];
    }
    group.sync_in_block();
}

// Constants of a rollout, in the order in which `run_whole_rollout` gives them.
struct RolloutNumbers {
    float inverse_eps, reach, dt, gradient_scale, density_scale, side_x, side_y;

    __device__ float2 within_walls(float2 p) const { return make_float2(mirrored(p.x, side_x), mirrored(p.y, side_y)); }
};
struct RolloutChoices {
    int steps, sort_interval;
    int inverse;  // 0: no correction of gradients; 1: the inverse with a threshold; 2: the smooth one.
    int reflecting, gradient_column, density_column;
};

// Densities of a warp's share of the particles, rows for their neighbours, the list of active ones.
template <int N, int WARPS, int CLUSTER, int BLOCKS>
struct DensityPhase {
    // Threads that share a particle, particles of a warp in a pass, and passes.
    static constexpr int ALL = WARPS * CLUSTER, THREADS = ALL * 32 > N ? ALL * 32 / N : 1,
        SHARE = 32 / THREADS, PASSES = N / (SHARE * ALL), PARTS = N / SHARE;
    using Group = WorldGroup<N, WARPS, CLUSTER, BLOCKS>;
    static_assert(THREADS <= 2 && PARTS <= 16);
    unsigned ballots[PASSES];

    // Which particles are active in a step; `mask` [N] in the caller's order, or null for all.
    __device__ void draw(const Group& group, int step, int count, const unsigned char* mask)
    {
        const int lane = threadIdx.x & 31;
        #pragma unroll
        for (int pass = 0; pass < PASSES; ++pass) {
            const int part = pass * ALL + group.warp, i = part * SHARE + (lane & (SHARE - 1));
            const bool on = lane < SHARE && i < count;
            ballots[pass] = __ballot_sync(~0u, on && (!mask || mask[group.original()[i]]));
            if (lane == 0) group.put(&group.counts(step)[part], __popc(ballots[pass]));
        }
    }

    // Returns the number of active particles. `noise` [N, 2] is in the caller's order, or null.
    __device__ int run(
        const Group& group, const RolloutNumbers& numbers, const RolloutChoices& choices, int step, int count,
        float reach, float state_scale, const float2* noise)
    {
        const int lane = threadIdx.x & 31;
        float2* places = group.places(step);
        int total = 0, first[PASSES] = {};
        #pragma unroll
        for (int k = 0; k < PARTS; ++k) {
            const int active = group.counts(step)[k];
            total += active;
            #pragma unroll
            for (int pass = 0; pass < PASSES; ++pass)
                if (k < pass * ALL + group.warp) first[pass] += active;
        }
        const float inverse_squared = numbers.inverse_eps * numbers.inverse_eps;
        #pragma unroll
        for (int pass = 0; pass < PASSES; ++pass) {
            const int i = (pass * ALL + group.warp) * SHARE + (lane & (SHARE - 1));
            const int side = THREADS == 2 ? lane >> 4 : 0;
            const float2 p = places[i];
            if (lane < SHARE) {
                float2 next = p;
                if (noise && i < count) {
                    const float2 moved = noise[group.original()[i]];
                    next = make_float2(p.x + moved.x, p.y + moved.y);
                }
                if (ballots[pass] >> lane & 1u) {
                    const int rank = first[pass] + __popc(ballots[pass] & ((1u << lane) - 1u));
                    group.put(&group.active()[rank], (unsigned short)i);
                } else if (choices.reflecting && i < count) {
                    next = numbers.within_walls(next);
                }
                group.put(&group.places(step + 1)[i], next);
            }
            Bounds bounds;
            if constexpr (N > 64) {
                bounds.include(p);
                bounds.template combine<1, SHARE>();
            }
            auto near = blocks_near<N>(places, bounds, reach);
            // Sums over halves of blocks, as two threads of a particle have them.
            float sums[2][2] = {};
            float4 pairs[4 / THREADS];
            auto fetch = [&] {
                const int block = near ? first_block(near) : N / 8;
                #pragma unroll
                for (int c = 0; c < 4 / THREADS; ++c)
                    pairs[c] = reinterpret_cast<const float4*>(places)[block * 4 + side * 2 + c];
            };
            fetch();
            while (near) {
                near &= near - 1;
                float4 now[4 / THREADS];
                #pragma unroll
                for (int c = 0; c < 4 / THREADS; ++c) now[c] = pairs[c];
                fetch();
                #pragma unroll
                for (int c = 0; c < 4 / THREADS; ++c) {
                    const float4 two = now[c];
                    const float ax = two.x - p.x, ay = two.y - p.y, bx = two.z - p.x, by = two.w - p.y;
                    const float a = falloff_within(fmaf(ax, ax, ay * ay), inverse_squared);
                    const float b = falloff_within(fmaf(bx, bx, by * by), inverse_squared);
                    sums[c / 2][0] = fmaf(a * a, a, sums[c / 2][0]);
                    sums[c / 2][1] = fmaf(b * b, b, sums[c / 2][1]);
                }
            }
            float density = sums[0][0] + sums[0][1];
            if constexpr (THREADS == 2) density += __shfl_xor_sync(~0u, density, 16);
            else density += sums[1][0] + sums[1][1];
            const float volume = __frcp_rn(density), scale = volume * state_scale;
            unsigned char* row = group.row(i);
            #pragma unroll
            for (int block = 0; block < BLOCKS; ++block) {
                if (THREADS == 2 && (block & 1) != side) continue;
                const float4 a = *group.state(i, 2 * block), b = *group.state(i, 2 * block + 1);
                uint4 high, low;
                split_half(a.x * scale, a.y * scale, high.x, low.x);
                split_half(a.z * scale, a.w * scale, high.y, low.y);
                split_half(b.x * scale, b.y * scale, high.z, low.z);
                split_half(b.z * scale, b.w * scale, high.w, low.w);
                group.put(reinterpret_cast<uint4*>(row + 16 * block), high);
                group.put(reinterpret_cast<uint4*>(row + 16 * (BLOCKS + block)), low);
            }
            if (side == 0)
                group.put(reinterpret_cast<float4*>(row + 32 * BLOCKS), make_float4(p.x, p.y, volume, 0.0f));
        }
        return total;
    }
};

// Perception of up to 16 active particles: sums over neighbours, then what the network reads.
// A lane 4 g + t has particles g and g + 8, and channels 2 t and 2 t + 1 of each block of 8.
template <int BLOCKS> struct Perception {
    float fields[4][BLOCKS][2][2];  // States, smoothed states, gradients along x and y.
    float density[2][2];            // Density gradients.

    template <int N, typename Group, typename Bits>
    __device__ void sum(
        const Group& group, const RolloutNumbers& numbers, const RolloutChoices& choices,
        const int (&index)[2], const float2 (&p)[2], Bits near, float state_unscale)
    {
        const int lane = threadIdx.x & 31, t = lane & 3;
        constexpr int ROW = Group::Memory::ROW;
        const unsigned rows = (unsigned)__cvta_generic_to_shared(group.base) + (lane & 7) * ROW + (lane >> 4) * 16;
        const float inverse_squared = numbers.inverse_eps * numbers.inverse_eps;
        const float slope = -SHARPNESS * numbers.inverse_eps;
        float total[3][BLOCKS][4] = {};
        // Of each particle: sums of K, of v K, and of v K_x x, v K_x y and v K_y y.
        float sums[2][7] = {};
        // The products of a pair of blocks run beside the weights of the next pair.
        unsigned left[3][4], rest[3][4], at = 0u, next = 0u;
        float4 neighbours[2][2];
        auto fetch = [&] {
            const int a = first_block(near);
            near &= near - 1;
            const int b = near ? first_block(near) : N / 8;
            near &= near - 1;
            next = rows + (lane & 8 ? b : a) * (8 * ROW);
            #pragma unroll
            for (int k = 0; k < 4; ++k)
                neighbours[k / 2][k % 2] = *reinterpret_cast<const float4*>(
                    group.row((k / 2 ? b : a) * 8 + 2 * t + k % 2) + 32 * BLOCKS);
        };
        auto weigh = [&] {
            at = next;
            float weight[3][2][2][2];
            #pragma unroll
            for (int q = 0; q < 2; ++q) {
                #pragma unroll
                for (int e = 0; e < 2; ++e) {
                    const float4 other = neighbours[q][e];
                    #pragma unroll
                    for (int r = 0; r < 2; ++r) {
                        const float x = other.x - p[r].x, y = other.y - p[r].y;
                        const float squared = fmaf(x, x, fmaf(y, y, 1.2e-38f));
                        const float inverse = rsqrt_fast(squared);
                        const float falloff = fmaxf(fmaf(squared * inverse, slope, SHARPNESS), 0.0f);
                        const float factor = falloff * falloff * inverse;
                        const float kx = factor * x, ky = factor * y, vx = other.z * kx, vy = other.z * ky;
                        sums[r][0] += kx; sums[r][1] += ky;
                        sums[r][2] += vx; sums[r][3] += vy;
                        sums[r][4] = fmaf(vx, x, sums[r][4]);
                        sums[r][5] = fmaf(vx, y, sums[r][5]);
                        sums[r][6] = fmaf(vy, y, sums[r][6]);
                        weight[0][q][r][e] = smoothing(squared, inverse_squared);
                        weight[1][q][r][e] = kx;
                        weight[2][q][r][e] = ky;
                    }
                }
            }
            #pragma unroll
            for (int k = 0; k < 12; ++k)
                split_half(weight[k / 4][k / 2 % 2][k % 2][0], weight[k / 4][k / 2 % 2][k % 2][1],
                    left[k / 4][k % 4], rest[k / 4][k % 4]);
        };
        auto multiply = [&] {
            unsigned high[4], low[4];
            load_transposed(high, at);
            if constexpr (BLOCKS == 2) load_transposed(low, at + 32);
            // With one block the same load has its high and its low parts.
            const unsigned* small = BLOCKS == 2 ? low : high + 2;
            float product[3][BLOCKS][4] = {};
            auto add = [&](const unsigned (&weights)[3][4], const unsigned* states) {
                #pragma unroll
                for (int k = 0; k < 3 * BLOCKS; ++k)
                    multiply_half(product[k % 3][k / 3], weights[k % 3], states[k / 3 * 2], states[k / 3 * 2 + 1]);
            };
            add(rest, high);
            add(left, small);
            add(left, high);
            #pragma unroll
            for (int k = 0; k < 12 * BLOCKS; ++k)
                total[k / 4 / BLOCKS][k / 4 % BLOCKS][k % 4] += product[k / 4 / BLOCKS][k / 4 % BLOCKS][k % 4];
        };
        if (near) {
            fetch();
            weigh();
            #pragma unroll 1
            while (near) {
                fetch();
                multiply();
                weigh();
            }
            multiply();
        }
        const float unsharpen = 1.0f / (SHARPNESS * SHARPNESS);
        #pragma unroll
        for (int r = 0; r < 2; ++r) {
            #pragma unroll
            for (int k = 0; k < 7; ++k) {
                sums[r][k] += __shfl_xor_sync(~0u, sums[r][k], 1);
                sums[r][k] += __shfl_xor_sync(~0u, sums[r][k], 2);
            }
            const float moment_scale = 7.5f * unsharpen * numbers.inverse_eps;
            const float xx = sums[r][4] * moment_scale, xy = sums[r][5] * moment_scale, yy = sums[r][6] * moment_scale;
            const float determinant = fmaf(xx, yy, -xy * xy);
            float ixx = 1.0f, ixy = 0.0f, iyy = 1.0f;
            if (choices.inverse == 1 && fabsf(determinant) >= 1e-3f) {
                const float quotient = 1.0f / determinant;
                ixx = yy * quotient; ixy = -xy * quotient; iyy = xx * quotient;
            } else if (choices.inverse == 2) {
                // (det M adj M + τ² I) / (det² M + τ²), τ = 0.01.
                const float quotient = 1.0f / fmaf(determinant, determinant, 1e-4f);
                ixx = fmaf(determinant, yy, 1e-4f) * quotient;
                ixy = -determinant * xy * quotient;
                iyy = fmaf(determinant, xx, 1e-4f) * quotient;
            }
            const float scale = numbers.gradient_scale * unsharpen;
            #pragma unroll
            for (int block = 0; block < BLOCKS; ++block) {
                const float2 own = *group.channels(index[r], block, t);
                #pragma unroll
                for (int e = 0; e < 2; ++e) {
                    const float value = e ? own.y : own.x;
                    const float gx = fmaf(total[1][block][2 * r + e], state_unscale, -value * sums[r][2]) * scale;
                    const float gy = fmaf(total[2][block][2 * r + e], state_unscale, -value * sums[r][3]) * scale;
                    const float x = fmaf(gx, ixx, gy * ixy), y = fmaf(gx, ixy, gy * iyy);
                    const float shorter = log_scale_of_square(fminf(fmaf(x, x, y * y), 3e38f));
                    fields[0][block][r][e] = value;
                    fields[1][block][r][e] = total[0][block][2 * r + e] * state_unscale;
                    fields[2][block][r][e] = x * shorter;
                    fields[3][block][r][e] = y * shorter;
                }
            }
            const float density_scale = numbers.density_scale * unsharpen;
            const float x = sums[r][0] * density_scale, y = sums[r][1] * density_scale;
            const float shorter = log_scale_of_square(fmaf(x, x, y * y));
            density[r][0] = x * shorter; density[r][1] = y * shorter;
        }
    }
};

// The network's updates of 16 particles.
template <int BLOCKS> struct Updates {
    float outputs[BLOCKS + 1][4];  // Changes of states by blocks of 8; then δ, in lanes with t = 0.

    __device__ void compute(const Perception<BLOCKS>& seen, const unsigned char* shared, int units)
    {
        const NetworkMemory<BLOCKS> memory(units);
        const int lane = threadIdx.x & 31, t = lane & 3;
        unsigned left[2 * BLOCKS][4], rest[2 * BLOCKS][4], extra[2];
        float unscale[2];
        #pragma unroll
        for (int r = 0; r < 2; ++r) {
            float size = fmaxf(1.0f, fmaxf(fabsf(seen.density[r][0]), fabsf(seen.density[r][1])));
            #pragma unroll
            for (int k = 0; k < 8 * BLOCKS; ++k)
                size = fmaxf(size, fabsf(seen.fields[k / 2 / BLOCKS][k / 2 % BLOCKS][r][k % 2]));
            size = fmaxf(size, __shfl_xor_sync(~0u, size, 1));
            size = fmaxf(size, __shfl_xor_sync(~0u, size, 2));
            const float scale = scale_to(size, 8);
            unscale[r] = __uint_as_float((scale_exponent(size, 8) - 8u) << 23);
            #pragma unroll
            for (int block = 0; block < 4 * BLOCKS; ++block) {
                const float (&values)[2] = seen.fields[block / BLOCKS][block % BLOCKS][r];
                split_half(values[0] * scale, values[1] * scale,
                    left[block / 2][block % 2 * 2 + r], rest[block / 2][block % 2 * 2 + r]);
            }
            unsigned high, low, one, none;
            split_half(seen.density[r][0] * scale, seen.density[r][1] * scale, high, low);
            split_half(scale, 0.0f, one, none);
            extra[r] = t == 0 ? high : t == 1 ? __byte_perm(one, low, 0x5410)
                : t == 2 ? __byte_perm(low, high, 0x5432) : __byte_perm(high, one, 0x5432);
        }

        float total[BLOCKS + 1][4] = {}, product[BLOCKS + 1][4];
        const uint4* hidden = reinterpret_cast<const uint4*>(shared + memory.hidden) + lane;
        const unsigned* extras = reinterpret_cast<const unsigned*>(shared + memory.extra) + lane;
        const uint4* output = reinterpret_cast<const uint4*>(shared + memory.output) + lane;
        #pragma unroll 1
        for (int unit = 0; unit < units; unit += 2) {
            #pragma unroll
            for (int k = 0; k < 4 * BLOCKS + 4; ++k) product[k / 4][k % 4] = 0.0f;
            #pragma unroll
            for (int half = 0; half < 2; ++half) {
                float sum[3][2][4] = {};
                #pragma unroll
                for (int k = 0; k < 4 * BLOCKS; ++k) {
                    const int side = k % 2;
                    const uint4 weight = hidden[(side * 2 * BLOCKS + k / 2) * 32];
                    multiply_half(sum[0][side], left[k / 2], weight.x, weight.y);
                    multiply_half(sum[1][side], rest[k / 2], weight.x, weight.y);
                    multiply_half(sum[2][side], left[k / 2], weight.z, weight.w);
                }
                multiply_half8(sum[1][0], extra, extras[0]);
                multiply_half8(sum[1][1], extra, extras[32]);
                unsigned high[4], low[4];
                #pragma unroll
                for (int k = 0; k < 4; ++k) {
                    float value[2];
                    #pragma unroll
                    for (int e = 0; e < 2; ++e) {
                        const int side = k / 2, entry = k % 2 * 2 + e;
                        value[e] = sum[0][side][entry] + (sum[1][side][entry] + sum[2][side][entry]);
                        // A hidden unit that is NaN stays so, as it does in torch.
                        if (value[e] <= 0.0f) value[e] = 0.0f;
                    }
                    split_half(value[0], value[1], high[k], low[k]);
                }
                #pragma unroll
                for (int tile = 0; tile <= BLOCKS; ++tile) {
                    const uint4 weight = output[tile * 32];
                    multiply_half(product[tile], low, weight.x, weight.y);
                    multiply_half(product[tile], high, weight.z, weight.w);
                    multiply_half(product[tile], high, weight.x, weight.y);
                }
                hidden += 4 * BLOCKS * 32;
                extras += 64;
                output += (BLOCKS + 1) * 32;
            }
            #pragma unroll
            for (int k = 0; k < 4 * BLOCKS + 4; ++k) total[k / 4][k % 4] += product[k / 4][k % 4];
        }

        const float* unscales = reinterpret_cast<const float*>(shared + memory.unscale) + 2 * t;
        #pragma unroll
        for (int k = 0; k < 4 * BLOCKS + 4; ++k)
            outputs[k / 4][k % 4] = total[k / 4][k % 4] * unscales[8 * (k / 4) + (k & 1)] * unscale[k % 4 / 2];
    }
};

template <int N, int WARPS, int CLUSTER, int BLOCKS, typename Tile>
__device__ inline void roll_worlds(
    const Tile& memory, const wp::vec_t<7, float>& number_list, const wp::vec_t<6, int>& choice_list,
    const wp::array_t<float>& hidden, const wp::array_t<float>& bias, const wp::array_t<float>& output,
    const wp::array_t<unsigned char>& masks, const wp::array_t<float>& noise, const wp::array_t<float>& x,
    const wp::array_t<float>& s, const wp::array_t<float>& new_x, const wp::array_t<float>& new_s)
{
    using Group = WorldGroup<N, WARPS, CLUSTER, BLOCKS>;
    unsigned char* shared = reinterpret_cast<unsigned char*>(memory.data.ptr);
    const RolloutNumbers numbers = reinterpret_cast<const RolloutNumbers&>(number_list);
    const RolloutChoices choices = reinterpret_cast<const RolloutChoices&>(choice_list);
    const int steps = choices.steps, sort_interval = choices.sort_interval;
    const int units = (hidden.shape[0] + 31) / 32 * 2, world_count = x.shape[0], count = x.shape[1];
    const int state_dim = s.shape[2], groups = blockDim.x / 32 / WARPS;
    const int lane = threadIdx.x & 31, g = lane >> 2, t = lane & 3, thread = threadIdx.x % (WARPS * 32);
    unsigned char* worlds = shared + NetworkMemory<BLOCKS>(units).bytes;
    arrange_network<BLOCKS>(shared, reinterpret_cast<float*>(worlds), units, state_dim,
        choices.gradient_column, choices.density_column, hidden, bias, output);
    __syncthreads();
    const Group group(worlds);
    // Rows and places that fill up the last pair of blocks; each row by one thread.
    if (thread < 8) {
        unsigned* row = reinterpret_cast<unsigned*>(group.row(N + thread));
        for (int k = 0; k < 8 * BLOCKS; ++k) row[k] = 0u;
        reinterpret_cast<float4*>(row + 8 * BLOCKS)[0] = make_float4(FAR_AWAY, FAR_AWAY, 0.0f, 0.0f);
        group.places(0)[N + thread] = group.places(1)[N + thread] = make_float2(FAR_AWAY, FAR_AWAY);
    }
    const float reach = 1.00001f / numbers.inverse_eps;
    const size_t particles = (size_t)world_count * count;
    DensityPhase<N, WARPS, CLUSTER, BLOCKS> density;

    for (int world = group.number * (gridDim.x / CLUSTER) + blockIdx.x / CLUSTER; world < world_count;
         world += gridDim.x / CLUSTER * groups) {
        if (thread == 0) *group.largest() = 0u;
        group.sync();
        const size_t begin = (size_t)world * count;
        for (int i = thread; i < N; i += WARPS * 32) {
            group.original()[i] = i;
            group.places(0)[i] = i < count ? reinterpret_cast<const float2*>(x.data)[begin + i]
                : make_float2(FAR_AWAY, FAR_AWAY);
        }
        unsigned size = 0u;
        for (int k = thread; k < N * 8 * BLOCKS; k += WARPS * 32) {
            const int i = k / (8 * BLOCKS), c = k % (8 * BLOCKS);
            const float value = i < count && c < state_dim ? s.data[(begin + i) * state_dim + c] : 0.0f;
            reinterpret_cast<float*>(group.state(i, c >> 2))[c & 3] = value;
            size = max(size, __float_as_uint(value) & 0x7fffffffu);
        }
        size = __reduce_max_sync(~0u, size);
        // Each block of a cluster reads all of the world.
        if (lane == 0) atomicMax(group.largest(), size);

        const unsigned char* mask = masks.data ? masks.data + begin : nullptr;
        const float2* moved = noise.data ? reinterpret_cast<const float2*>(noise.data) + begin : nullptr;
        for (int step = 0; step < steps; ++step) {
            if (step % sort_interval == 0) {
                group.sync_in_block();
                if constexpr (N > 64) sort_world<N, WARPS>(group, step, count, 4.0f * numbers.inverse_eps);
                density.draw(group, step, count, mask ? mask + step * particles : nullptr);
                group.sync();
            }
            // States are scaled by a power of two, below the largest float16.
            const unsigned exponent = min(max(*group.largest() >> 23, 40u), 250u);
            const float state_scale = __uint_as_float((268u - exponent) << 23);
            const float state_unscale = __uint_as_float((exponent - 14u) << 23);
            const int total = density.run(group, numbers, choices, step, count, reach, state_scale,
                moved ? moved + step * particles : nullptr);
            if (step + 1 < steps && (step + 1) % sort_interval != 0)
                density.draw(group, step + 1, count, mask ? mask + (step + 1) * particles : nullptr);
            group.sync();

            unsigned grown = 0u;
            const float2* places = group.places(step);
            float2* next = group.places(step + 1);
            // The warp with one tile more is another one in each step.
            const int first = (group.warp / CLUSTER + group.number + step) % WARPS * CLUSTER + group.rank;
            for (int tile = first; tile * 16 < total; tile += WARPS * CLUSTER) {
                int index[2];
                float2 p[2];
                Bounds bounds;
                #pragma unroll
                for (int r = 0; r < 2; ++r) {
                    index[r] = group.active()[min(tile * 16 + g + 8 * r, total - 1)];
                    p[r] = places[index[r]];
                    bounds.include(p[r]);
                }
                if constexpr (N > 64) bounds.template combine<4, 32>();
                Updates<BLOCKS> updates;
                {
                    Perception<BLOCKS> seen;
                    seen.template sum<N>(
                        group, numbers, choices, index, p, blocks_near<N>(places, bounds, reach), state_unscale);
                    updates.compute(seen, shared, units);
                }
                #pragma unroll
                for (int r = 0; r < 2; ++r) {
                    if (tile * 16 + g + 8 * r >= total) continue;
                    if (t == 0) {
                        const float ax = updates.outputs[BLOCKS][2 * r], ay = updates.outputs[BLOCKS][2 * r + 1];
                        const float length = numbers.reach / (1.0f + __fsqrt_rn(fmaf(ax, ax, ay * ay)));
                        float2 place = next[index[r]];
                        place.x = fmaf(length, ax, place.x);
                        place.y = fmaf(length, ay, place.y);
                        if (choices.reflecting) place = numbers.within_walls(place);
                        group.put(&next[index[r]], place);
                    }
                    #pragma unroll
                    for (int block = 0; block < BLOCKS; ++block) {
                        float2* at = group.channels(index[r], block, t);
                        float2 value = *at;
                        value.x = fmaf(updates.outputs[block][2 * r], numbers.dt, value.x);
                        value.y = fmaf(updates.outputs[block][2 * r + 1], numbers.dt, value.y);
                        group.put(at, value);
                        grown = max(grown, max(__float_as_uint(value.x) & 0x7fffffffu,
                            __float_as_uint(value.y) & 0x7fffffffu));
                    }
                }
            }
            grown = __reduce_max_sync(~0u, grown);
            if (lane == 0 && grown > *group.largest()) group.enlarge(grown);
            group.sync();
        }

        const int wide = group.warp * 32 + lane, all = WARPS * CLUSTER * 32;
        for (int i = wide; i < N; i += all) {
            const int number = group.original()[i];
            if (number < count) reinterpret_cast<float2*>(new_x.data)[begin + number] = group.places(steps)[i];
        }
        for (int k = wide; k < N * 8 * BLOCKS; k += all) {
            const int i = k / (8 * BLOCKS), c = k % (8 * BLOCKS), number = group.original()[i];
            if (number < count && c < state_dim)
                new_s.data[(begin + number) * state_dim + c] = reinterpret_cast<const float*>(group.state(i, c >> 2))[c & 3];
        }
        group.sync();
    }
}

}  // namespace npa
