"""Aids of the CPU: launches cut into ranges for its threads, sums in vector registers.

The first argument of a kernel that may be cut, `range_start`, is where its range begins along the
launch's first dimension: 0 where it runs whole, as on CUDA. No range may read what another one
writes, or count in it: Warp's atomics on the CPU are for one thread.
"""

from collections.abc import Callable
from typing import Any

from npa_envs.kernels import native
from npa_envs.once import made_once

SMALLEST_RANGES: dict[Any, int] = {}
"""For each such kernel, how many indices of the first dimension are worth a thread of their own."""

PAIRS = 512
"""Smallest range of a kernel whose threads each go through a neighbourhood."""

WORLDS = 2
"""Smallest range of a kernel whose threads each go through a whole world."""

CAMERAS = 1
"""Smallest range of a kernel whose threads each draw all that a camera sees."""

TILES = 4
"""Smallest range of a kernel whose threads each go through a tile of a picture."""

PARTICLES = 4096
"""Smallest range of a kernel whose threads each move a particle with its state."""

ELEMENTS = 16384
"""Smallest range of a kernel whose threads each change a few numbers."""


def in_ranges(smallest: int) -> Callable[[Any], Any]:
    """Return a decorator for a Warp kernel that takes `range_start`.

    Args:
        smallest: Indices of the first dimension that take about 0.15 ms: a cut costs half of that.
    """

    def mark(kernel: Any) -> Any:
        assert kernel.adj.args[0].label == "range_start"
        SMALLEST_RANGES[kernel] = smallest
        return kernel

    return mark


@made_once()
def make_add_scaled(group: type, scalar: type) -> Any:
    """Return a Warp function for total + factor * value, rounded after each operation on the CPU.

    It uses vector registers of the CPU, where its compiler finds none by itself.

    Args:
        group: A vector type, of 4, 8 or 16 channels.
    """

    @native.func_native()
    def add_scaled(total: group, factor: scalar, value: group) -> group: ...

    return add_scaled
