"""Whether numbers are finite, without waiting for the answer."""

import functools

import warp as wp

from npa_envs.kernels.domain import scalar_name
from npa_envs.kernels.wide import make_read_at

QUAD = 4
"""Values that a thread reads at once."""

VALUES_PER_THREAD = 8
"""Values that a thread looks at."""


@functools.cache
def find_not_finite(scalar: type) -> wp.Kernel:
    """Return the kernel of one scalar type."""
    module = wp.get_module(f"npa_envs.kernels.finite_{scalar_name(scalar)}")
    read_quad = make_read_at(wp.types.vector(QUAD, scalar), scalar, 16)

    @wp.kernel(enable_backward=False, module=module)
    def find(
        thread_count: wp.int32,
        values: wp.array(dtype=scalar),
        # outputs
        finite: wp.array(dtype=wp.uint8),
    ):
        """Write 0 where a value, aligned to 16 bytes in memory, is infinite or not a number."""
        t = wp.tid()
        found = wp.int32(0)
        for k in range(wp.static(VALUES_PER_THREAD // QUAD)):
            first = (t + k * thread_count) * wp.static(QUAD)
            if first <= values.shape[0] - wp.static(QUAD):
                together = read_quad(values, first)
                for c in range(wp.static(QUAD)):
                    if not wp.isfinite(together[c]):
                        found = wp.int32(1)
            else:
                for i in range(first, values.shape[0]):
                    if not wp.isfinite(values[i]):
                        found = wp.int32(1)
        if found != 0:
            finite[0] = wp.uint8(0)

    return find
