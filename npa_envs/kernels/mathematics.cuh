// Formulas of `mathematics` in fewer instructions than Warp makes of them.

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

// 1 / sqrt(value), two units in the last place off at most.
__device__ inline float inverse_root(float value) { return rsqrtf(value); }

// The value clipped to plus and minus a limit; as it is if the limit is NaN: fminf and fmaxf
// return the other operand then.
__device__ inline float within(float value, float limit)
{
    return fminf(fmaxf(value, -limit), limit);
}

// Smoothing kernel W up to its norm, 0 beyond its support.
__device__ inline float smoothing(float squared, float inverse_squared_eps)
{
    const float falloff = __saturatef(fmaf(-squared, inverse_squared_eps, 1.0f));
    return falloff * falloff * falloff;
}

// Factor f of the spiky gradient kernel K(r) = f r up to its norm, 0 beyond its support.
__device__ inline float spiky_factor(float squared, float inverse_eps)
{
    float inverse;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(squared));
    const float near = __saturatef(fmaf(-squared * inverse, inverse_eps, 1.0f));
    return near * near * inverse;
}

// L(v) / v of the logarithmic scaling, from v . v: log(1 + |v|) / |v|.
__device__ inline float log_scale_of_square(float squared)
{
    float length, inverse;
    asm("sqrt.rn.f32 %0, %1;" : "=f"(length) : "f"(squared));
    const float one_plus = 1.0f + length;
    const float excess = one_plus - 1.0f;
    asm("rcp.rn.f32 %0, %1;" : "=f"(inverse) : "f"(excess));
    return excess > 0.0f ? logf(one_plus) * inverse : 1.0f;
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
__device__ inline Vector log_scale_pull(Vector scaled, Vector cotangent)
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
