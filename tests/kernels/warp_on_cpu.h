// The 32 threads of a CUDA warp on a CPU, in turn from one meeting to the next: what CUDA C++ of
// whole warps needs to run without a GPU. It shows what such code computes, not its races.

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
struct Thread { unsigned x; };

inline float2 make_float2(float x, float y) { return {x, y}; }
template <typename T> T min(T a, T b) { return b < a ? b : a; }
template <typename T> T max(T a, T b) { return a < b ? b : a; }

inline Thread threadIdx;

namespace warp {

// A thread begins in a context with a stack of its own; afterwards jumps are faster.
inline ucontext_t beginning[32];
inline jmp_buf outside, inside[32];
inline bool over[32];
inline unsigned long long told[32];
inline std::function<void()> body;

inline void meet()
{
    if (_setjmp(inside[threadIdx.x]) == 0) _longjmp(outside, 1);
}

// Let a thread go on to its next meeting.
inline void go_on(unsigned lane, bool begins)
{
    threadIdx.x = lane;
    if (_setjmp(outside) != 0) return;
    if (begins) setcontext(&beginning[lane]);
    _longjmp(inside[lane], 1);
}

inline void begin()
{
    body();
    over[threadIdx.x] = true;
    meet();
}

// Run a function by all threads of a warp.
inline void run(std::function<void()> function)
{
    static std::vector<std::vector<char>> stacks(32, std::vector<char>(1 << 18));
    body = std::move(function);
    for (unsigned lane = 0; lane < 32; ++lane) {
        over[lane] = false;
        getcontext(&beginning[lane]);
        beginning[lane].uc_stack.ss_sp = stacks[lane].data();
        beginning[lane].uc_stack.ss_size = stacks[lane].size();
        beginning[lane].uc_link = nullptr;
        makecontext(&beginning[lane], begin, 0);
    }
    bool begins = true;
    for (int left = 32; left > 0;) {
        int ended = 0;
        for (unsigned lane = 0; lane < 32; ++lane) {
            go_on(lane, begins);
            ended += over[lane];
        }
        begins = false;
        if (ended != 0 && ended != 32) {
            std::puts("the threads of a warp went different ways");
            std::exit(1);
        }
        left = 32 - ended;
    }
}

template <typename T> T of_lane(T value, unsigned lane)
{
    std::memcpy(&told[threadIdx.x], &value, sizeof value);
    meet();
    T result;
    std::memcpy(&result, &told[lane & 31u], sizeof result);
    meet();
    return result;
}

}  // namespace warp

inline void __syncwarp() { warp::meet(); }
inline void __syncthreads() { warp::meet(); }  // of a block of one warp
template <typename T> T __shfl_sync(unsigned, T value, int lane, int width = 32)
{
    return warp::of_lane(value, threadIdx.x / width * width + lane % width);
}
template <typename T> T __shfl_up_sync(unsigned, T value, int offset, int width = 32)
{
    const bool there = int(threadIdx.x % width) >= offset;
    return warp::of_lane(value, there ? threadIdx.x - offset : threadIdx.x);
}
template <typename T> T __shfl_xor_sync(unsigned, T value, int offset)
{
    return warp::of_lane(value, threadIdx.x ^ offset);
}
inline unsigned __ballot_sync(unsigned, bool condition)
{
    warp::told[threadIdx.x] = condition;
    warp::meet();
    unsigned votes = 0;
    for (unsigned lane = 0; lane < 32; ++lane) votes |= unsigned(warp::told[lane]) << lane;
    warp::meet();
    return votes;
}
inline int __popc(unsigned bits) { return std::popcount(bits); }
inline int __clz(unsigned bits) { return std::countl_zero(bits); }
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
template <typename T> struct array_t { T* data; };
template <int N, typename T> struct vec_t {
    T c[N];
    T operator[](int i) const { return c[i]; }
};
}  // namespace wp
