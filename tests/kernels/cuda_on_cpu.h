// The threads of a CUDA block on a CPU, in turn from one meeting to the next: what CUDA C++ needs
// to run without a GPU. It shows what such code computes. Results that differ when threads take turns
// `backwards` show a race.

#pragma once

#include <setjmp.h>
#include <ucontext.h>

#include <bit>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __device__
#define __shared__ static

struct float2 { float x, y; };
struct int4 { int x, y, z, w; };
struct uint4 { unsigned x, y, z, w; };
struct Index { unsigned x; };

inline float2 make_float2(float x, float y) { return {x, y}; }
template <typename T> T min(T a, T b) { return b < a ? b : a; }
template <typename T> T max(T a, T b) { return a < b ? b : a; }

inline Index threadIdx, blockIdx, blockDim, gridDim;

namespace block {

constexpr unsigned WARP = 32, MOST = 1024;

enum State { RUNS, WAITS, ENDED };  // WAITS: for all threads of the block

// A thread begins in a context with a stack of its own; afterwards jumps are faster.
inline ucontext_t beginning[MOST];
inline jmp_buf outside, inside[MOST];
inline State state[MOST];
inline unsigned long long values[MOST];
inline std::function<void()> body;
inline bool backwards = false;  // The last thread, and the last warp, comes first.

inline void meet(State next = RUNS)
{
    state[threadIdx.x] = next;
    if (_setjmp(inside[threadIdx.x]) == 0) _longjmp(outside, 1);
}

inline void begin()
{
    body();
    meet(ENDED);
}

// Let a thread go on to its next meeting.
inline void go_on(unsigned thread, bool begins)
{
    threadIdx.x = thread;
    if (_setjmp(outside) != 0) return;
    if (begins) setcontext(&beginning[thread]);
    _longjmp(inside[thread], 1);
}

// Let all threads of a warp go on; return whether they have ended.
inline bool go_on_together(unsigned first, bool begins)
{
    for (unsigned lane = 0; lane < WARP; ++lane) go_on(first + (backwards ? 31 - lane : lane), begins);
    for (unsigned thread = first; thread < first + WARP; ++thread) {
        if (state[thread] != state[first]) {
            std::puts("the threads of a warp went different ways");
            std::exit(1);
        }
    }
    return state[first] == ENDED;
}

// Run a function by all threads of a block.
inline void run(unsigned threads, std::function<void()> function)
{
    static std::vector<std::vector<char>> stacks;
    while (stacks.size() < threads) stacks.emplace_back(1 << 18);
    body = std::move(function);
    for (unsigned thread = 0; thread < threads; ++thread) {
        state[thread] = RUNS;
        getcontext(&beginning[thread]);
        beginning[thread].uc_stack.ss_sp = stacks[thread].data();
        beginning[thread].uc_stack.ss_size = stacks[thread].size();
        beginning[thread].uc_link = nullptr;
        makecontext(&beginning[thread], begin, 0);
    }
    bool begins = true;
    for (unsigned left = threads; left > 0; begins = false) {
        bool all_wait = true;
        for (unsigned warp = 0; warp < threads; warp += WARP) {
            const unsigned first = backwards ? threads - WARP - warp : warp;
            if (state[first] != RUNS) continue;
            all_wait = false;
            if (go_on_together(first, begins)) left -= WARP;
        }
        for (unsigned thread = 0; all_wait && thread < threads; ++thread) {
            if (state[thread] == WAITS) state[thread] = RUNS;
        }
    }
}

template <typename Kernel> void launch(unsigned blocks, unsigned threads, Kernel kernel)
{
    gridDim.x = blocks;
    blockDim.x = threads;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) run(threads, kernel);
}

inline unsigned thread_of(unsigned lane) { return threadIdx.x / WARP * WARP + lane % WARP; }

template <typename T> T of_lane(T value, unsigned lane)
{
    std::memcpy(&values[threadIdx.x], &value, sizeof value);
    meet();
    T result;
    std::memcpy(&result, &values[thread_of(lane)], sizeof result);
    meet();
    return result;
}

}  // namespace block

inline void __syncwarp() { block::meet(); }
inline void __syncthreads() { block::meet(block::WAITS); }
template <typename T> T __shfl_sync(unsigned, T value, int lane, int width = 32)
{
    return block::of_lane(value, threadIdx.x / width * width + lane % width);
}
template <typename T> T __shfl_up_sync(unsigned, T value, int offset, int width = 32)
{
    const bool there = int(threadIdx.x % width) >= offset;
    return block::of_lane(value, there ? threadIdx.x - offset : threadIdx.x);
}
template <typename T> T __shfl_xor_sync(unsigned, T value, int offset)
{
    return block::of_lane(value, threadIdx.x ^ offset);
}
inline unsigned __ballot_sync(unsigned, bool condition)
{
    block::values[threadIdx.x] = condition;
    block::meet();
    unsigned votes = 0;
    for (unsigned lane = 0; lane < 32; ++lane) {
        votes |= unsigned(block::values[block::thread_of(lane)]) << lane;
    }
    block::meet();
    return votes;
}
inline int __popc(unsigned bits) { return std::popcount(bits); }
inline int __clz(unsigned bits) { return std::countl_zero(bits); }
inline int __ffsll(unsigned long long bits) { return bits ? std::popcount(bits ^ (bits - 1)) : 0; }
inline int __ffs(unsigned bits) { return bits ? std::popcount(bits ^ (bits - 1)) : 0; }
inline unsigned __funnelshift_l(unsigned low, unsigned high, unsigned shift)
{
    return shift ? high << shift | low >> (32 - shift) : high;
}
inline unsigned __float_as_uint(float value)
{
    // A GPU has one NaN, without a sign.
    return value != value ? 0x7fffffffu : std::bit_cast<unsigned>(value);
}
inline float __uint_as_float(unsigned bits) { return std::bit_cast<float>(bits); }
inline float __saturatef(float value) { return value > 0.0f ? min(value, 1.0f) : 0.0f; }

namespace wp {
using int16 = short;
template <typename T> struct array_t { T* data; int shape[4]; };
template <int N, typename T> struct vec_t {
    T c[N];
    T operator[](int i) const { return c[i]; }
};
}  // namespace wp
