"""The formulas of perception, each once: kernels W and K, the scaling L, the inverse of moments.

Sources: arXiv 2601.16096, section 3 and appendix; `npa_envs.reference` has the same in torch.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native

MOMENT_THRESHOLD = 1e-3
"""Smallest |det M| that is inverted, dimensionless; below it the gradient is not corrected."""

SMALL_LOG = 5e-2
"""Below this |z| the ratio |z| / (exp|z| - 1) is computed by its series: the quotient cancels."""

MOMENT_SOFTENING = 1e-2
"""τ, the det M at which the smooth inverse is half way between M^-1 and I, dimensionless."""


@wp.func
def smoothing_falloff(squared_distance: Any, inverse_squared_eps: Any):
    """1 - r^2 / eps^2; the smoothing kernel is its cube. Negative beyond eps."""
    return type(squared_distance)(1.0) - squared_distance * inverse_squared_eps


@wp.func
def smoothing_of(falloff: Any, norm: Any):
    """Poly6 smoothing kernel W, from 1 - r^2 / eps^2 [1 / length^D]."""
    return norm * falloff * falloff * falloff


@wp.func
def smoothing(squared_distance: Any, inverse_squared_eps: Any, norm: Any):
    """Poly6 smoothing kernel W, for distances below eps [1 / length^D]."""
    return smoothing_of(smoothing_falloff(squared_distance, inverse_squared_eps), norm)


@wp.func
def smoothing_slope(squared_distance: Any, inverse_squared_eps: Any, norm: Any):
    """Factor g of the gradient dW/dr = g r of the smoothing kernel [1 / length^(D+2)]."""
    falloff = smoothing_falloff(squared_distance, inverse_squared_eps)
    return type(norm)(-6.0) * norm * inverse_squared_eps * falloff * falloff


@wp.func
def spiky_factor(distance: Any, inverse_eps: Any, norm: Any):
    """Factor f of the spiky gradient kernel K(r) = f r; zero at r = 0 [1 / length^(D+2)]."""
    falloff = type(norm)(1.0) - distance * inverse_eps
    factor = norm * falloff * falloff / distance
    # Not by a branch: several are computed together.
    return wp.where(distance > type(norm)(0.0), factor, type(norm)(0.0))


@wp.func
def spiky_factor_f64(exact: wp.float64, start: Any, inverse_eps: Any, norm: Any):
    """Factor f of the spiky gradient kernel in float64, from `exact` = r · r [1 / length^(D+2)].

    A Newton step refines `start`, about 1 / |r|. In float64, because sums of spiky kernels cancel
    almost fully where particles are dense.
    """
    inverse = wp.float64(start)
    inverse *= wp.float64(1.5) - wp.float64(0.5) * exact * inverse * inverse
    falloff = wp.float64(1.0) - exact * inverse * wp.float64(inverse_eps)
    return wp.float64(norm) * falloff * falloff * inverse


@wp.func
def spiky_radial_slope(distance: Any, inverse_eps: Any, norm: Any):
    """Derivative of the spiky kernel's length f |r| by |r|, for its adjoint [1 / length^(D+2)]."""
    falloff = type(norm)(1.0) - distance * inverse_eps
    return -type(norm)(2.0) * norm * falloff * inverse_eps


@wp.func
def log_scale_of(length: Any, logarithm: Any):
    """Factor L(v) / v of the logarithmic scaling, from |v| and log(1 + |v|) without its rounding.

    `logarithm` is log(1 + |v|) of the rounded sum; the factor is accurate also for |v| near 0.
    """
    one = type(length)(1.0)
    one_plus = one + length
    exact = logarithm * (length / (one_plus - one))
    return wp.where(one_plus > one, exact / length, one)


@wp.func
def log_scaled_huge(v: Any):
    """Logarithmic scaling L(v) of a vector whose squared length overflows."""
    largest = wp.max(wp.abs(v))
    direction = v / largest
    length = wp.length(direction)
    return ((wp.log(largest) + wp.log(length)) / length) * direction


@wp.func
def log_scaled(v: Any):
    """Logarithmic scaling L(v) = log(1 + |v|) v / |v| of a vector, 0 at 0."""
    length = wp.length(v)
    result = log_scale_of(length, wp.log(type(length)(1.0) + length)) * v
    if wp.isinf(length):
        result = log_scaled_huge(v)
    return result


@cached_under_lock()
def make_log_scaled(space_dim: int, scalar: type, width: int) -> Any:
    """Return a Warp function for L(`scale` times gradient) of `width` gradients, [D, width]."""
    vector, numbers = wp.types.vector(space_dim, scalar), wp.types.vector(width, scalar)
    gradient_type = wp.types.matrix((space_dim, width), scalar)

    @wp.func
    def log_scaled_gradient(scale: scalar, gradient: gradient_type):
        scaled = gradient_type()
        lengths = numbers()
        logarithms = numbers()
        longest = scalar(0.0)
        # Loops of one operation for all, which a CPU's compiler puts in vector registers.
        c = wp.int32(0)
        while c < wp.static(width):
            squared = scalar(0.0)
            for d in range(wp.static(space_dim)):
                scaled[d, c] = scale * gradient[d, c]
                squared += scaled[d, c] * scaled[d, c]
            lengths[c] = wp.sqrt(squared)
            longest = wp.max(longest, lengths[c])
            c += 1
        c = wp.int32(0)
        while c < wp.static(width):
            logarithms[c] = wp.log(scalar(1.0) + lengths[c])
            c += 1
        c = wp.int32(0)
        while c < wp.static(width):
            factor = log_scale_of(lengths[c], logarithms[c])
            for d in range(wp.static(space_dim)):
                scaled[d, c] *= factor
            c += 1
        if wp.isinf(longest):
            for c in range(wp.static(width)):
                if wp.isinf(lengths[c]):
                    along = vector()
                    for d in range(wp.static(space_dim)):
                        along[d] = scale * gradient[d, c]
                    along = log_scaled_huge(along)
                    for d in range(wp.static(space_dim)):
                        scaled[d, c] = along[d]
        return scaled

    return log_scaled_gradient


@wp.func
def log_scale_tangential(length: Any):
    """Derivative |L| / |v| of L(v) for changes of v perpendicular to v, from `length` = |L|."""
    ratio = type(length)(1.0)
    if length < type(length)(SMALL_LOG):
        series = type(length)(1.0)
        for k in range(6):
            series = type(length)(1.0) + series * length / type(length)(7 - k)
        ratio = type(length)(1.0) / series
    else:
        ratio = length / (wp.exp(length) - type(length)(1.0))
    return ratio


@wp.func
def log_scale_adjoint(scaled: Any, cotangent: Any):
    """Loss gradient with respect to v; `cotangent` is that with respect to `scaled` = L(v)."""
    length = wp.length(scaled)
    tangential = log_scale_tangential(length)
    result = tangential * cotangent
    if length > type(length)(0.0):
        radial = wp.exp(-length)
        direction = scaled / length
        result += (radial - tangential) * wp.dot(direction, cotangent) * direction
    return result


def perception_module_name(state_gradient: bool, moment_inverse: str | None) -> str:
    """Return the part of a perception module's name that says which state gradient it has."""
    if not state_gradient:
        return "smoothing"
    corrections = {None: "uncorrected_", "threshold": "", "smooth": "smoothly_corrected_"}
    return corrections[moment_inverse] + "perception"


@cached_under_lock()
def make_corrected(space_dim: int, scalar: type, width: int, moment_inverse: str | None) -> Any:
    """Return a Warp function that multiplies state gradients [D, width] by an inverse of moments M.

    The inverse is "smooth", or "threshold", which leaves gradients as they are where M is singular.
    """
    square = wp.types.matrix((space_dim, space_dim), scalar)
    gradient_type = wp.types.matrix((space_dim, width), scalar)

    @wp.func
    def adjugate(moment: square):
        result = square()
        if wp.static(space_dim == 2):
            result[0, 0] = moment[1, 1]
            result[1, 1] = moment[0, 0]
            result[0, 1] = -moment[0, 1]
            result[1, 0] = -moment[1, 0]
        else:
            for row in range(3):
                a = (row + 1) % 3
                b = (row + 2) % 3
                for column in range(3):
                    c = (column + 1) % 3
                    d = (column + 2) % 3
                    cofactor = moment[a, c] * moment[b, d] - moment[a, d] * moment[b, c]
                    result[column, row] = cofactor
        return result

    @wp.func
    def smooth_inverse(moment: square):
        """Return (det M adj M + τ² I) / (det² M + τ²) of symmetric M, which has no singularity.

        It is w M^-1 + (1 - w) I with w = det² M / (det² M + τ²).
        """
        determinant = wp.determinant(moment)
        softening = scalar(wp.static(MOMENT_SOFTENING * MOMENT_SOFTENING))
        factor = scalar(1.0) / (determinant * determinant + softening)
        result = (factor * determinant) * adjugate(moment)
        for d in range(wp.static(space_dim)):
            result[d, d] += factor * softening
        return result

    @wp.func
    def corrected(gradient: gradient_type, moment: square):
        result = gradient
        if wp.static(moment_inverse == "smooth"):
            result = smooth_inverse(moment) * gradient
        elif wp.abs(wp.determinant(moment)) >= scalar(wp.static(MOMENT_THRESHOLD)):
            result = wp.inverse(moment) * gradient
        return result

    return corrected


# The same formulas in C++ for CUDA, with fewer instructions.

falloff_within = native.function(
    "falloff_within", squared=float, inverse_squared_eps=float, returns=float
)
"""1 - r^2 / eps^2, 0 beyond eps and for NaN."""

log_scale_of_square = native.function("log_scale_of_square", squared=float, returns=float)
"""Factor L(v) / v of the logarithmic scaling, from v . v: log(1 + |v|) / |v|."""

inverse_root = native.function("inverse_root", value=float, returns=float)
"""1 / sqrt(value), with an error of at most two units in the last place."""

within = native.function("within", value=float, limit=float, returns=float)
"""The value clipped to plus and minus a limit; unchanged if the limit is NaN."""


def scaling_functions(space: SimpleNamespace) -> SimpleNamespace:
    """Return the functions for logarithmic scaling L on CUDA, with the types of `group_types`."""
    space_dim, width, scalar = space.space_dim, space.width, space.scalar
    vector, gradient_type = space.vector, space.group_gradient
    rows_type = wp.types.vector(width * space_dim, scalar)

    @wp.func
    def scale_huge(gradient_scale: scalar, gradient: gradient_type, scaled: rows_type):
        """Return `scaled`, computed again for gradients whose squared length overflows."""
        result = scaled
        for c in range(wp.static(width)):
            along = vector()
            for d in range(wp.static(space_dim)):
                along[d] = gradient_scale * gradient[d, c]
            if wp.isinf(wp.dot(along, along)):
                along = log_scaled_huge(along)
                for d in range(wp.static(space_dim)):
                    result[c * wp.static(space_dim) + d] = along[d]
        return result

    @wp.func
    def scaled_gradient(gradient_scale: scalar, gradient: gradient_type):
        """Return L(`gradient_scale` times gradient) of each channel, one after the other."""
        scaled = rows_type()
        largest_square = scalar(0.0)
        for c in range(wp.static(width)):
            along = vector()
            for d in range(wp.static(space_dim)):
                along[d] = gradient_scale * gradient[d, c]
            squared = wp.dot(along, along)
            largest_square = wp.max(largest_square, squared)
            along *= log_scale_of_square(squared)
            for d in range(wp.static(space_dim)):
                scaled[c * wp.static(space_dim) + d] = along[d]
        if wp.isinf(largest_square):
            scaled = scale_huge(gradient_scale, gradient, scaled)
        return scaled

    @wp.func
    def scaled_vector(v: vector):
        result = v
        squared = wp.dot(v, v)
        if wp.isinf(squared):
            result = log_scaled_huge(v)
        else:
            result *= log_scale_of_square(squared)
        return result

    return native.namespace(locals())
