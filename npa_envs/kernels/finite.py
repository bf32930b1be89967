"""Copying numbers, and whether they are finite, without waiting for the answer."""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.wide import make_read_at, make_write_at

QUAD = 4
"""Values that a thread looks at."""


@functools.cache
def finite_kernels(scalar: type) -> SimpleNamespace:
    """Return the kernel of one scalar type."""
    module = wp.get_module(f"npa_envs.kernels.finite_{scalar_name(scalar)}")

    quad = wp.types.vector(QUAD, scalar)
    read_quad = make_read_at(quad, scalar, 16)
    write_quad = make_write_at(quad, scalar)

    @wp.kernel(enable_backward=False, module=module)
    def copy_finding_not_finite(
        values: wp.array(dtype=scalar),
        # outputs
        copy: wp.array(dtype=scalar),
        finite: wp.array(dtype=wp.uint8),
    ):
        """Copy values, four for each thread, aligned in memory; write 0 where one is not finite."""
        first = wp.tid() * wp.static(QUAD)
        found = wp.int32(0)
        if first <= values.shape[0] - wp.static(QUAD):
            together = read_quad(values, first)
            for c in range(wp.static(QUAD)):
                if not wp.isfinite(together[c]):
                    found = wp.int32(1)
            write_quad(copy, first, together)
        else:
            for i in range(first, values.shape[0]):
                if not wp.isfinite(values[i]):
                    found = wp.int32(1)
                copy[i] = values[i]
        if found != 0:
            finite[0] = wp.uint8(0)

    return SimpleNamespace(copy_finding_not_finite=copy_finding_not_finite)
