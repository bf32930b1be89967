"""The search for neighbours: candidates in runs of cells, or a neighbour list.

On a CPU candidates are filtered in blocks: the near ones are collected, and then summed. About half
of the candidates are near, so a branch for each would often be predicted wrongly, and would keep
the sums in memory. On CUDA a block is one candidate: a branch for each.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels.domain import domain_types
from npa_envs.kernels.native_functions import namespace

FILTER_BLOCK = 32
"""Candidates of a block on a CPU."""


@cached_under_lock()
def make_search(
    space_dim: int, scalar: type, entry_type: type, on_cpu: bool, listed: bool = False
) -> SimpleNamespace:
    """Return the Warp functions that find the neighbours of a particle, in cells or in a list.

    `entries` are sorted vectors that begin with a position. For particle k in `cell`, of the world
    whose first cell is `base`, the first `count` of `near` are entries within eps. They are used as

        for r in range(run_count(domain, cell)):
            begin, end = run_range(domain, starts, ends, base, cell, k, r)
            for first in range(begin, end, stride):
                near, count = filter_near(domain, entries, neighbours, position, first, end)

    `listed`: `neighbours` holds the neighbours of each particle, up to its `ends`.
    """
    space = domain_types(space_dim, scalar)
    vector, cell_vector, Domain = space.vector, space.cell_vector, space.Domain
    stride = FILTER_BLOCK if on_cpu else 1
    indices = wp.types.vector(stride, wp.int32)

    @wp.func
    def run_count(domain: Domain, cell: cell_vector):
        """Return the number of runs of cells around a cell; with neighbour lists 1."""
        count = wp.int32(1)
        if wp.static(not listed):
            count = space.segment_count(domain, cell)
        return count

    @wp.func
    def run_range(
        domain: Domain,
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        base: int,
        cell: cell_vector,
        k: int,
        r: int,
    ):
        """Return k's first and last + 1 candidate in run r; `base`: first cell of its world."""
        begin = wp.int32(0)
        end = wp.int32(0)
        if wp.static(listed):
            if k > 0:
                begin = ends[k - 1]
            end = ends[k]
        else:
            first, last = space.segment_cells(domain, cell, r)
            begin = starts[base + first]
            end = starts[base + last]
        return begin, end

    @wp.func
    def filter_near(
        domain: Domain,
        entries: wp.array[entry_type],
        neighbours: wp.array[wp.int32],
        position: vector,
        first: int,
        end: int,
    ):
        """Return the candidates within eps in the block from `first` on, and their count."""
        near = indices()
        count = wp.int32(0)
        for c in range(first, wp.min(first + wp.static(stride), end)):
            if wp.static(listed):
                near[count] = neighbours[c]
                count += 1
            else:
                near[count] = c
                offset = vector()
                for d in range(wp.static(space_dim)):
                    offset[d] = entries[c][d] - position[d]
                offset = space.minimum_image(domain, offset)
                count += wp.where(wp.dot(offset, offset) < domain.squared_eps, 1, 0)
        return near, count

    return namespace(locals(), stride=stride)
