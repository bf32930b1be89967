// Whole rollouts of small worlds; test_emulated.py writes their sizes, and compares the results.

#include "cuda_on_cpu.h"

#include <algorithm>

struct alignas(8) uint2 { unsigned x, y; };
struct alignas(16) float4 { float x, y, z, w; };
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

unsigned char memory[256 * 1024] __attribute__((aligned(128)));

inline size_t __cvta_generic_to_shared(const void* at) { return (const unsigned char*)at - memory; }
inline int __float_as_int(float value) { return (int)__float_as_uint(value); }
inline float __int_as_float(int bits) { return __uint_as_float((unsigned)bits); }
inline float __frcp_rn(float value) { return 1.0f / value; }
inline float __fsqrt_rn(float value) { return sqrtf(value); }
inline int __float2int_rd(float value)
{
    return value != value ? 0 : (int)std::floor(std::clamp(value, -2e9f, 2e9f));
}
inline unsigned __byte_perm(unsigned a, unsigned b, unsigned selector)
{
    const unsigned long long bytes = (unsigned long long)b << 32 | a;
    unsigned result = 0;
    for (int k = 0; k < 4; ++k) result |= unsigned(bytes >> (selector >> 4 * k & 7) * 8 & 255) << 8 * k;
    return result;
}
inline unsigned __reduce_max_sync(unsigned, unsigned value)
{
    for (int bit = 1; bit < 32; bit *= 2) value = max(value, __shfl_xor_sync(~0u, value, bit));
    return value;
}
inline void atomicMax(unsigned* at, unsigned value) { *at = max(*at, value); }

namespace npa {

// float16 numbers as floats, and the nearest float16 of a float. The compiler would spend seconds on
// computing a lambda's result itself.
std::vector<float> every_half()
{
    std::vector<float> values;
    for (unsigned half = 0; half < 65536; ++half) {
        const int exponent = half >> 10 & 31, digits = half & 1023;
        const float size = exponent == 31 ? (digits ? NAN : INFINITY)
            : exponent ? std::ldexp(1024 + digits, exponent - 25) : std::ldexp(digits, -24);
        values.push_back(half & 0x8000 ? -size : size);
    }
    return values;
}
const std::vector<float> all_halves = every_half();
inline float widened(unsigned half) { return all_halves[half]; }
inline unsigned narrowed(float value)
{
    const unsigned sign = std::signbit(value) ? 0x8000 : 0;
    const float size = std::fabs(value);
    if (value != value) return 0x7fff;
    if (size >= 65520.0f) return sign | 0x7c00;
    if (size < std::ldexp(1.0f, -14)) return sign | unsigned(std::nearbyint(std::ldexp(size, 24)));
    const int exponent = std::ilogb(size);
    return sign | (unsigned(std::nearbyint(std::ldexp(size, 10 - exponent))) + (exponent + 14) * 1024);
}
inline void split_half(float a, float b, unsigned& high, unsigned& low)
{
    high = narrowed(a) | narrowed(b) << 16;
    low = narrowed(a - widened(high & 0xffff)) | narrowed(b - widened(high >> 16)) << 16;
}

// Numbers of all lanes for a product; tensor cores add exactly, and then cut the sum.
unsigned operands[1024][6];

inline float cut(double sum)
{
    const float rounded = sum;
    return std::fabs((double)rounded) > std::fabs(sum) ? std::nextafter(rounded, 0.0f) : rounded;
}
inline void multiply(float (&sum)[4], int words)
{
    const unsigned first = threadIdx.x & ~31u, g = threadIdx.x / 4 & 7, t = threadIdx.x & 3;
    block::meet();
    for (int entry = 0; entry < 4; ++entry) {
        double exact = sum[entry];
        for (int half = 0; half < words; ++half)
            for (unsigned k = 0; k < 4; ++k) {
                const unsigned a = operands[first + 4 * g + k][2 * half + entry / 2];
                const unsigned b = operands[first + 4 * (2 * t + entry % 2) + k][4 + half];
                for (int shift = 0; shift < 32; shift += 16)
                    exact += (double)widened(a >> shift & 0xffff) * widened(b >> shift & 0xffff);
            }
        sum[entry] = cut(exact);
    }
    block::meet();
}
inline void multiply_half(float (&sum)[4], const unsigned (&a)[4], unsigned b0, unsigned b1)
{
    unsigned* own = operands[threadIdx.x];
    std::copy(a, a + 4, own);
    own[4] = b0;
    own[5] = b1;
    multiply(sum, 2);
}
inline void multiply_half8(float (&sum)[4], const unsigned (&a)[2], unsigned b)
{
    unsigned* own = operands[threadIdx.x];
    std::copy(a, a + 2, own);
    own[4] = b;
    multiply(sum, 1);
}
inline void load_transposed(unsigned (&parts)[4], unsigned address)
{
    block::values[threadIdx.x] = address;
    block::meet();
    for (int matrix = 0; matrix < 4; ++matrix) {
        unsigned halves[2];
        for (int k = 0; k < 2; ++k) {
            const unsigned row = block::values[(threadIdx.x & ~31u) + 8 * matrix + threadIdx.x % 4 * 2 + k];
            halves[k] = reinterpret_cast<unsigned short*>(memory + row)[threadIdx.x / 4 & 7];
        }
        parts[matrix] = halves[0] | halves[1] << 16;
    }
    block::meet();
}
inline float rsqrt_fast(float value) { return 1.0f / sqrtf(value); }
template <int THREADS> inline void sync_threads(int) { __syncthreads(); }
template <typename, int, bool, int> float lane_sum(float value)
{
    for (int bit = 16; bit > 0; bit /= 2) value += __shfl_xor_sync(~0u, value, bit);
    return value;
}

}  // namespace npa

#include "native.h"
#include "sizes.h"

template <typename T> std::vector<T> read(std::FILE* file, size_t count)
{
    std::vector<T> values(count);
    if (std::fread(values.data(), sizeof(T), count, file) != count) std::abort();
    return values;
}

int main()
{
    std::FILE* file = std::fopen("in", "rb");
    const size_t particles = WORLDS * COUNT;
    auto hidden = read<float>(file, HIDDEN * WIDTH), bias = read<float>(file, HIDDEN);
    auto output = read<float>(file, (2 + CHANNELS) * HIDDEN), x = read<float>(file, particles * 2);
    auto s = read<float>(file, particles * CHANNELS);
    auto noise = read<float>(file, STEPS * particles * 2);
    auto masks = read<unsigned char>(file, STEPS * particles);
    std::vector<float> results[2] = {std::vector<float>(particles * (2 + CHANNELS))};
    const wp::vec_t<7, float> numbers = {NUMBERS};
    const wp::vec_t<6, int> choices = {CHOICES};
    struct { struct { unsigned char* ptr; } data; } tile = {{memory}};
    for (auto& result : results) {
        result = results[0];
        block::launch(1, 32 * WARPS * GROUPS, [&] {
            npa::roll_worlds<SIZE, WARPS, 1, (CHANNELS + 7) / 8>(
                tile, numbers, choices, wp::array_t<float>{hidden.data(), {HIDDEN, WIDTH}},
                wp::array_t<float>{bias.data(), {HIDDEN}},
                wp::array_t<float>{output.data(), {2 + CHANNELS, HIDDEN}},
                wp::array_t<unsigned char>{masks.data()}, wp::array_t<float>{noise.data()},
                wp::array_t<float>{x.data(), {WORLDS, COUNT, 2}},
                wp::array_t<float>{s.data(), {WORLDS, COUNT, CHANNELS}},
                wp::array_t<float>{result.data()}, wp::array_t<float>{result.data() + particles * 2});
        });
        block::backwards = true;
    }
    if (std::memcmp(results[0].data(), results[1].data(), 4 * results[0].size()) != 0) {
        std::puts("results depend on the order of threads");
        return 1;
    }
    file = std::fopen("out", "wb");
    std::fwrite(results[0].data(), 4, results[0].size(), file);
    return std::fclose(file);
}
