"""Cell lists by counting sort, in an order that depends on the particles alone.

Particles are sorted by world, then cell, then index. A row of cells is contiguous, so that the
neighbourhood of a cell is a few contiguous runs of particles. The particles whose update mask is
set ("active") get a second, compact order of the same kind: their rows. Integer atomics hand out
provisional places; the last kernel replaces them by ranks among indices, which makes every later
sum run in the same order on every run and device.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import domain_types, kernel_module


@functools.cache
def cell_kernels(space_dim: int, scalar: type, share: int) -> SimpleNamespace:
    """Return the kernels of one variant; a thread moves `share` channels of a particle."""
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain
    cell_of, cell_index = types.cell_of, types.cell_index
    module = kernel_module("cells", space_dim, scalar, share)

    @wp.kernel(enable_backward=False, module=module)
    def count_cells(
        domain: Domain,
        positions: wp.array(dtype=vector),
        mask: wp.array(dtype=wp.uint8),
        masked: wp.int32,
        particle_count: wp.int32,
        active_offset: wp.int32,
        # outputs
        cell: wp.array(dtype=wp.int32),
        arrival: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
    ):
        """Count the particles, and the active ones, of each cell; counts[0] stays zero."""
        i = wp.tid()
        index = (i / particle_count) * domain.cell_count
        index += cell_index(domain, cell_of(domain, positions[i]))
        cell[i] = index
        arrival[i] = wp.atomic_add(counts, index + 1, 1)
        if masked != 0 and mask[i] != wp.uint8(0):
            wp.atomic_add(counts, active_offset + index + 1, 1)

    @wp.kernel(enable_backward=False, module=module)
    def place_by_arrival(
        cell: wp.array(dtype=wp.int32),
        arrival: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        # outputs
        arrived: wp.array(dtype=wp.int32),
    ):
        """List the particles of each cell in the order in which they were counted."""
        i = wp.tid()
        arrived[starts[cell[i]] + arrival[i]] = i

    @wp.kernel(enable_backward=False, module=module)
    def order_particles(
        positions: wp.array(dtype=vector),
        states: wp.array(dtype=scalar, ndim=2),
        mask: wp.array(dtype=wp.uint8),
        masked: wp.int32,
        active_offset: wp.int32,
        row_base: wp.int32,
        row_capacity: wp.int32,
        cell: wp.array(dtype=wp.int32),
        arrived: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        # outputs
        source: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        row_of: wp.array(dtype=wp.int32),
        row_source: wp.array(dtype=wp.int32),
        row_place: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        row_positions: wp.array(dtype=vector),
        sorted_states: wp.array(dtype=scalar, ndim=2),
    ):
        """Move every particle to its rank by index within its cell; give active ones rows.

        States and rows are left out where their arrays are empty.
        """
        k, part = wp.tid()
        i = arrived[k]
        c = cell[i]
        begin = starts[c]
        active = masked == 0 or mask[i] != wp.uint8(0)
        rank = wp.int32(0)
        active_rank = wp.int32(0)
        for other in range(begin, starts[c + 1]):
            j = arrived[other]
            if j < i:
                rank += 1
                if masked == 0 or mask[j] != wp.uint8(0):
                    active_rank += 1
        place = begin + rank

        if sorted_states.shape[0] > 0:
            for c_local in range(wp.static(share)):
                channel = part * wp.static(share) + c_local
                state = scalar(0.0)
                if channel < states.shape[1]:
                    state = states[i, channel]
                sorted_states[place, channel] = state
        if part == 0:
            source[place] = i
            sorted_cell[place] = c
            sorted_positions[place] = positions[i]
        if part == 0 and row_of.shape[0] > 0:
            row = wp.int32(-1)
            if active:
                row = starts[active_offset + c] + active_rank - row_base
                if row >= row_capacity:
                    row = wp.int32(-1)
            if row >= 0:
                row_source[row] = i
                row_place[row] = place
                row_positions[row] = positions[i]
            row_of[i] = row

    return SimpleNamespace(
        count_cells=count_cells,
        place_by_arrival=place_by_arrival,
        order_particles=order_particles,
    )
