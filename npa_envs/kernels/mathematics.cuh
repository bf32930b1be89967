// For mathematics.py and pictures/*.py: formulas of perception, and exp2, in few instructions.

namespace npa {

CUDA_CALLABLE inline float fast_exp2(float value)
{
#if defined(__CUDA_ARCH__)
    float power;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(power) : "f"(value));
    return power;
#else
    return wp::exp(value * 0.69314718f);
#endif
}

CUDA_CALLABLE inline double fast_exp2(double value)
{
#if defined(__CUDA_ARCH__)
    return ::exp2(value);
#else
    return wp::exp(value * 0.69314718055994530942);
#endif
}

#if defined(__CUDA_ARCH__)

__device__ inline float inverse_root(float value) { return rsqrtf(value); }

// If the limit is NaN, fminf and fmaxf return the other operand.
__device__ inline float within(float value, float limit)
{
    return fminf(fmaxf(value, -limit), limit);
}

__device__ inline float falloff_within(float squared, float inverse_squared_eps)
{
    return __saturatef(fmaf(-squared, inverse_squared_eps, 1.0f));
}

// Smoothing kernel W without its norm, 0 beyond its support.
__device__ inline float smoothing(float squared, float inverse_squared_eps)
{
    const float falloff = falloff_within(squared, inverse_squared_eps);
    return falloff * falloff * falloff;
}

// Factor f of the spiky gradient kernel K(r) = f r without its norm, 0 beyond its support.
__device__ inline float spiky_factor(float squared, float inverse_eps)
{
    float inverse;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(squared));
    const float near = __saturatef(fmaf(-squared * inverse, inverse_eps, 1.0f));
    return near * near * inverse;
}

// log(value) of a value of at least 1, with an error of at most one unit in the last place.
__device__ inline float log_above_one(float value)
{
    const int bits = __float_as_int(value);
    const int exponent = (bits - 0x3f2aaaab) & 0xff800000;
    const float rest = __int_as_float(bits - exponent) - 1.0f;
    const float square = rest * rest;
    float even = fmaf(square, -0.130310059f, -0.121483512f);
    float odd = fmaf(square, 0.140869141f, 0.139814854f);
    even = fmaf(even, square, -0.166846126f);
    odd = fmaf(odd, square, 0.200120345f);
    float series = fmaf(odd, rest, fmaf(even, square, -0.249996200f));
    series = fmaf(fmaf(series, rest, 0.333331972f), rest, -0.5f);
    series = fmaf(series, square, rest);
    return fmaf((float)exponent, 0.693147182f * 0x1p-23f, series);
}

// Without branches: those of several vectors overlap.
__device__ inline float log_scale_of_square(float squared)
{
    float inverse, quotient;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(squared + 1e-37f));
    float length = squared * inverse;
    length = fmaf(fmaf(-length, length, squared), 0.5f * inverse, length);
    // For shorter vectors the result is 1 up to rounding.
    const float excess = fmaxf((1.0f + length) - 1.0f, 0x1p-23f);
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(quotient) : "f"(excess));
    quotient = fmaf(fmaf(-excess, quotient, 1.0f), quotient, quotient);
    return log_above_one(1.0f + excess) * quotient;
}

// |L| / (exp|L| - 1), given exp(-|L|); by its series below 1.
__device__ inline float log_scale_tangential(float length, float radial)
{
    const float squared = length * length;
    float series = squared * (1.0f / 30240.0f - squared * (1.0f / 1209600.0f));
    series = squared * (1.0f / 12.0f - squared * (1.0f / 720.0f - series));
    series = 1.0f - 0.5f * length + series;
    const float quotient = __fdividef(length * radial, 1.0f - radial);
    return length < 1.0f ? series : quotient;
}

// Pulls a cotangent of L(v) back to v, given L(v).
template <typename Vector>
__device__ inline Vector log_scale_cotangent(Vector scaled, Vector cotangent)
{
    const float squared = wp::dot(scaled, scaled) + 1e-37f;  // which has an inverse root
    const float inverse = inverse_root(squared);
    const float length = squared * inverse;
    const float radial = fast_exp2(-1.44269504f * length);
    const float tangential = log_scale_tangential(length, radial);
    const float along = (radial - tangential) * inverse * (inverse * wp::dot(scaled, cotangent));
    return tangential * cotangent + along * scaled;
}

#endif

}  // namespace npa
