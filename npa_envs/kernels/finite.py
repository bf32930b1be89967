"""Whether numbers are finite, without waiting for the answer."""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.wide import make_read_at

VALUES_PER_THREAD = 8
"""Values that a thread looks at."""

QUAD = 4
"""Values that it reads at once, where their places are aligned in memory."""


@functools.cache
def finite_kernels(scalar: type) -> SimpleNamespace:
    """Return the kernel of one scalar type."""
    module = wp.get_module(f"npa_envs.kernels.finite_{scalar_name(scalar)}")

    quad = wp.types.vector(QUAD, scalar)
    read_quad = make_read_at(quad, scalar, 16)

    @wp.kernel(enable_backward=False, module=module)
    def find_not_finite(
        thread_count: wp.int32,
        aligned: wp.int32,
        values: wp.array(dtype=scalar),
        # outputs
        finite: wp.array(dtype=wp.uint8),
    ):
        """Write 0 where a value is infinite or not a number; leave the flag alone otherwise."""
        t = wp.tid()
        found = wp.int32(0)
        for k in range(wp.static(VALUES_PER_THREAD // QUAD)):
            first = (t + k * thread_count) * wp.static(QUAD)
            if aligned != 0 and first <= values.shape[0] - wp.static(QUAD):
                together = read_quad(values, first)
                for c in range(wp.static(QUAD)):
                    if not wp.isfinite(together[c]):
                        found = wp.int32(1)
            else:
                for c in range(wp.static(QUAD)):
                    if first + c < values.shape[0] and not wp.isfinite(values[first + c]):
                        found = wp.int32(1)
        if found != 0:
            finite[0] = wp.uint8(0)

    return SimpleNamespace(find_not_finite=find_not_finite)
