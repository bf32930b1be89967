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

from npa_envs.kernels.access import (
    WARP,
    load_integer,
    make_read_channels,
    make_wide_load,
    make_wide_store,
    of_warp,
)
from npa_envs.kernels.cpu import PARTICLES, in_ranges
from npa_envs.kernels.domain import domain_types, kernel_module

store_integer = make_wide_store(wp.int32, wp.int32)
load_pair = make_wide_load(wp.vec2i, wp.int32)
store_pair = make_wide_store(wp.vec2i, wp.int32)


@functools.cache
def cell_kernels(space_dim: int, scalar: type, width: int, lanes: int) -> SimpleNamespace:
    """Return the kernels of one variant.

    Args:
        space_dim: Space dimension D, 2 or 3.
        scalar: `wp.float32` or `wp.float64`.
        width: Channels of a group: 4, 8 or 16.
        lanes: Threads that share a group, 1 on the CPU.
    """
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain
    cell_of, cell_index = types.cell_of, types.cell_index
    share = wp.types.vector(width // lanes, scalar)
    shares = wp.types.matrix((lanes, width // lanes), scalar)
    warp_size = WARP if lanes > 1 else 1
    read_channels = make_read_channels(share, scalar)
    store_vector = make_wide_store(vector, scalar)
    store_share = make_wide_store(share, scalar)
    module = kernel_module("cells", space_dim, scalar, width, lanes)

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
        mask: wp.array(dtype=wp.uint8),
        masked: wp.int32,
        cell: wp.array(dtype=wp.int32),
        arrival: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        # outputs
        arrived: wp.array(dtype=wp.vec2i),
    ):
        """List the particles of each cell in the order in which they were counted.

        Of each: twice its index, plus one if it is active, and its cell.
        """
        i = wp.tid()
        entry = 2 * i
        if masked == 0 or mask[i] != wp.uint8(0):
            entry += 1
        c = load_integer(cell, i)
        place = load_integer(starts, c) + load_integer(arrival, i)
        store_pair(arrived, place, wp.vec2i(entry, c))

    @in_ranges(PARTICLES)
    @wp.kernel(enable_backward=False, module=module)
    def order_particles(
        range_start: wp.int32,
        positions: wp.array(dtype=vector),
        state_dim: wp.int32,
        group_count: wp.int32,
        aligned: wp.int32,
        states: wp.array(dtype=scalar),
        active_offset: wp.int32,
        row_base: wp.int32,
        row_capacity: wp.int32,
        arrived: wp.array(dtype=wp.vec2i),
        starts: wp.array(dtype=wp.int32),
        # outputs
        source: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        row_of: wp.array(dtype=wp.int32),
        row_source: wp.array(dtype=wp.int32),
        row_place: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        row_positions: wp.array(dtype=vector),
        sorted_states: wp.array(dtype=share),
    ):
        """Move every particle to its rank by index within its cell; give active ones rows.

        States and rows are left out where their arrays are empty. Threads come in whole warps on
        CUDA, some of them beyond the last particle.
        """
        k = range_start + wp.tid()
        total = arrived.shape[0]
        own = load_pair(arrived, wp.min(k, total - 1))
        i = own[0] / 2
        c = own[1]
        begin = load_integer(starts, c)
        first_row = load_integer(starts, active_offset + c) - row_base
        position = positions[i]
        rank = wp.int32(0)
        active_rank = wp.int32(0)
        for other in range(begin, load_integer(starts, c + 1)):
            entry = load_pair(arrived, other)[0]
            if entry < own[0]:
                rank += 1
                active_rank += entry & 1
        place = begin + rank
        if k < total:
            store_integer(source, place, i)
            store_integer(sorted_cell, place, c)
            store_vector(sorted_positions, place, position)
            if row_of.shape[0] > 0:
                row = first_row + active_rank
                if own[0] & 1 == 0 or row >= row_capacity:
                    row = wp.int32(-1)
                store_integer(row_of, i, row)
                if row >= 0:
                    store_integer(row_source, row, i)
                    store_integer(row_place, row, place)
                    store_vector(row_positions, row, position)

        # A warp moves the states of its particles together: neighbouring threads, neighbouring
        # shares. All that is read is asked for before any of it is written.
        if sorted_states.shape[0] > 0:
            lane = k % wp.static(warp_size)
            parts = group_count * wp.static(lanes)
            for first_turn in range(0, parts, wp.static(lanes)):
                held = shares()
                for turn in range(wp.static(lanes)):
                    chunk = lane + (first_turn + turn) * wp.static(warp_size)
                    owner = chunk / parts
                    first = (chunk - owner * parts) * wp.static(width // lanes)
                    state = read_channels(states, state_dim, aligned, of_warp(i, owner), first)
                    for n in range(wp.static(width // lanes)):
                        held[turn, n] = state[n]
                for turn in range(wp.static(lanes)):
                    chunk = lane + (first_turn + turn) * wp.static(warp_size)
                    owner = chunk / parts
                    part = chunk - owner * parts
                    to = of_warp(place, owner) * parts + part
                    state = share()
                    for n in range(wp.static(width // lanes)):
                        state[n] = held[turn, n]
                    if k - lane + owner < total:
                        store_share(sorted_states, to, state)

    return SimpleNamespace(
        count_cells=count_cells,
        place_by_arrival=place_by_arrival,
        order_particles=order_particles,
    )
