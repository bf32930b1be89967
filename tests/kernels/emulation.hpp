// CUDA C++ on a CPU: a thread of the CPU for each thread of a block, block after block.
//
// What is shared by a block is static; barriers and shuffles wait for the threads that CUDA would
// wait for. It tells whether numbers are right, not whether a barrier is missing.

#include <algorithm>
#include <barrier>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <thread>
#include <vector>

using std::max;
using std::min;

struct Extent { int x; };
static thread_local Extent threadIdx, blockIdx;
static Extent blockDim, gridDim;

#define __device__
#define __shared__ static

constexpr int LANES = 32;
static std::unique_ptr<std::barrier<>> of_block;
static std::vector<std::unique_ptr<std::barrier<>>> of_warp;
static float shuffled[32][LANES];

static void __syncthreads() { of_block->arrive_and_wait(); }

static void __syncwarp() { of_warp[threadIdx.x / LANES]->arrive_and_wait(); }

static float __shfl_xor_sync(unsigned, float value, int offset)
{
    float* lanes = shuffled[threadIdx.x / LANES];
    lanes[threadIdx.x % LANES] = value;
    __syncwarp();
    const float other = lanes[threadIdx.x % LANES ^ offset];
    __syncwarp();
    return other;
}

template <typename Kernel> void launch(int blocks, int threads, Kernel kernel)
{
    gridDim.x = blocks;
    blockDim.x = threads;
    for (int block = 0; block < blocks; ++block) {
        of_block = std::make_unique<std::barrier<>>(threads);
        of_warp.clear();
        for (int warp = 0; warp < threads / LANES; ++warp) {
            of_warp.push_back(std::make_unique<std::barrier<>>(LANES));
        }
        std::vector<std::thread> running;
        for (int thread = 0; thread < threads; ++thread) {
            running.emplace_back([=] {
                threadIdx.x = thread;
                blockIdx.x = block;
                kernel();
            });
        }
        for (std::thread& each : running) each.join();
    }
}

namespace wp {

template <typename Value> struct array_t {
    Value* data;
    int shape[4];
};

}  // namespace wp

// An array of so many rows and columns, which is read from a file or written to one.
struct Table {
    std::vector<float> values;
    wp::array_t<float> array;

    Table(int rows, int columns) : values((size_t)rows * columns)
    {
        array.data = values.data();
        array.shape[0] = rows;
        array.shape[1] = columns;
    }

    void read(std::FILE* file)
    {
        if (std::fread(values.data(), 4, values.size(), file) != values.size()) std::abort();
    }

    void write(std::FILE* file) const { std::fwrite(values.data(), 4, values.size(), file); }
};
