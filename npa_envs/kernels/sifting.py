"""Sifting candidates on the CPU: first those that are near are listed, then they are summed over.

About half of the candidates are near: a branch for each is often predicted wrongly, and keeps the
sums in memory. On CUDA a sift takes a single candidate, so that this is such a branch.
"""

import functools
from typing import Any

import warp as wp

from npa_envs.kernels.domain import domain_types

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
