"""Rows of perception brought back into the order of the particles."""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import scalar_name


@functools.cache
def row_kernels(scalar: type) -> SimpleNamespace:
    """Return the kernel of one scalar type."""
    module = wp.get_module(f"npa_envs.kernels.rows_{scalar_name(scalar)}")

    @wp.kernel(enable_backward=False, module=module)
    def gather_rows(
        rows: wp.array(dtype=scalar, ndim=2),
        row_of: wp.array(dtype=wp.int32),
        limit: scalar,
        # outputs
        gathered: wp.array(dtype=scalar, ndim=2),
    ):
        """Write the row of every particle, clipped to plus and minus a limit."""
        i, p = wp.tid()
        gathered[i, p] = wp.clamp(rows[row_of[i], p], -limit, limit)

    return SimpleNamespace(gather_rows=gather_rows)
