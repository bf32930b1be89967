"""Kernels whose launch may be cut into ranges, which the CPU's threads run side by side.

The first argument of such a kernel, `range_start`, is where its range begins along the launch's
first dimension: 0 where it runs whole, as on CUDA. No range may read what another one writes, or
count in it: Warp's atomics on the CPU are for one thread.
"""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp

from npa_envs.kernels import native
from npa_envs.kernels.domain import domain_types

SMALLEST_RANGES: dict[Any, int] = {}
"""For each such kernel, how many indices of the first dimension are worth a thread of their own."""

PAIRS = 512
"""Smallest range of a kernel whose threads each go through a neighbourhood."""

WORLDS = 2
"""Smallest range of a kernel whose threads each go through a whole world."""

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


@functools.cache
def make_add_scaled(group: type, scalar: type) -> Any:
    """Return a Warp function for total + factor * value, rounded after each operation on the CPU.

    It uses vector registers of the CPU, where its compiler finds none by itself.

    Args:
        group: A vector type, of 4, 8 or 16 channels.
        scalar: The scalar type that it is made of.
    """

    @native.func_native()
    def add_scaled(total: group, factor: scalar, value: group) -> group: ...

    return add_scaled


@wp.func
def of_groups(thread: wp.int32, group_count: wp.int32):
    """Return the particle and the group of a thread, where adjacent ones have adjacent groups."""
    particle = wp.int32(wp.uint32(thread) / wp.uint32(group_count))
    return particle, thread - particle * group_count


# Sifting candidates on the CPU: first those that are near are listed, then they are summed over.
#
# About half of the candidates are near: a branch for each is often predicted wrongly, and keeps
# the sums in memory. On CUDA a sift takes a single candidate, so that this is such a branch.


SIFTED = 32
"""Candidates of a sift on the CPU."""


@functools.cache
def make_sift(space_dim: int, scalar: type, entry_type: type, lanes: int) -> tuple[Any, int]:
    """Return a Warp function that sifts a lane's candidates, and how far apart its sifts begin.

    Args:
        space_dim: Space dimension D, 2 or 3.
        scalar: `wp.float32` or `wp.float64`.
        entry_type: Vector type of what is sifted, which begins with a position.
        lanes: Threads that share a particle, 1 on the CPU.
    """
    types = domain_types(space_dim, scalar)
    vector, Domain, minimum_image = types.vector, types.Domain, types.minimum_image
    count_max = SIFTED if lanes == 1 else 1
    indices = wp.types.vector(count_max, wp.int32)

    @wp.func
    def is_near(domain: Domain, entries: wp.array(dtype=entry_type), position: vector, j: wp.int32):
        offset = vector()
        entry = entries[j]
        for d in range(wp.static(space_dim)):
            offset[d] = entry[d] - position[d]
        offset = minimum_image(domain, offset)
        return wp.where(wp.dot(offset, offset) < domain.squared_eps, 1, 0)

    @wp.func
    def sift(
        domain: Domain,
        entries: wp.array(dtype=entry_type),
        position: vector,
        begin: wp.int32,
        end: wp.int32,
    ):
        """Return which entries from `begin` on lie within eps of a position, and how many do."""
        near = indices()
        count = wp.int32(0)
        if wp.static(lanes == 1):
            for j in range(begin, wp.min(begin + wp.static(count_max), end)):
                near[count] = j
                count += is_near(domain, entries, position, j)
        else:
            near[0] = begin
            count = is_near(domain, entries, position, begin)
        return near, count

    return sift, count_max * lanes
