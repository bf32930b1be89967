"""Rows of perception brought back into the order of the particles."""

from __future__ import annotations

from torch import Tensor

from npa_envs.kernels.rows import row_kernels
from npa_envs.sph.bridge import launch, scalar_type


def gather_rows(rows: Tensor, row_of: Tensor, limit: float, out: Tensor) -> None:
    """Write the row of every particle, clipped; not differentiable.

    Args:
        rows: Rows, dimensionless, shape [K, P], contiguous.
        row_of: Row of each particle, int32, shape [M].
        limit: Entries are clipped to plus and minus this.
        out: Where to write, shape [M, P], contiguous.
    """
    kernels = row_kernels(scalar_type(rows.dtype))
    launch(kernels.gather_rows, tuple(out.shape), rows.device, rows, row_of, limit, out)
