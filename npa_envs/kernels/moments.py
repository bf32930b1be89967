"""The smooth inverse of moment matrices, an alternative to inverting them above a threshold.

Kernels take the choice as a compile-time constant.
"""

import functools

import warp as wp

MOMENT_SOFTENING = 1e-2
"""τ: the smooth inverse is half way between M^-1 and I at this det M, dimensionless."""


@functools.cache
def make_smooth_inverse(space_dim: int, scalar: type) -> wp.Function:
    """Return a Warp function of symmetric M: (det M adj M + τ² I) / (det² M + τ²).

    It is w M^-1 + (1 - w) I with w = det² M / (det² M + τ²), and has no singularity.
    """
    square = wp.types.matrix((space_dim, space_dim), scalar)

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
        determinant = wp.determinant(moment)
        softening = scalar(wp.static(MOMENT_SOFTENING * MOMENT_SOFTENING))
        factor = scalar(1.0) / (determinant * determinant + softening)
        result = (factor * determinant) * adjugate(moment)
        for d in range(wp.static(space_dim)):
            result[d, d] += factor * softening
        return result

    return smooth_inverse
