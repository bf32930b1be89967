"""Cell lists by counting sort, in an order that depends only on the particles.

Particles are sorted by world, then cell, then index. A row of cells is contiguous, so that the
neighbourhood of a cell is a few contiguous runs of particles. The particles whose update mask is
set ("active") get a second, compact order of the same kind: their rows. Integer atomics assign
provisional positions; the last kernel replaces them by ranks among indices, so that every later
sum has the same order on every run and device. Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.lanes_and_memory import (
    load_integer,
    make_read_channels,
    wait_for_previous_kernel,
    wide_store,
)
from npa_envs.kernels.native_functions import PARTICLES, WORLDS, in_ranges, namespace

sum_of_first = native.function("sum_of_first", values=wp.array[wp.uint8], count=int, returns=int)
"""The sum of the first `count` values of a contiguous array."""


@cached_under_lock()
def sort_kernels(space_dim: int, scalar: type, width: int) -> SimpleNamespace:
    """Return the kernels that sort particles by cell: three in a row, or only `sort_worlds`."""
    space = domain_types(space_dim, scalar)
    vector, Domain = space.vector, space.Domain
    group = wp.types.vector(width, scalar)
    read_channels = make_read_channels(group)
    module = kernel_module("sort", space_dim, scalar, width=width)

    @wp.kernel(module=module)
    def count_cells(
        domain: Domain,
        positions: wp.array[vector],
        mask: wp.array[wp.uint8],
        particle_count: int,
        active_offset: int,
        # outputs
        cell: wp.array[wp.int32],
        arrival: wp.array[wp.int32],
        counts: wp.array[wp.int32],
    ):
        """Count particles, and the active ones, of cell c at counts[c + 1]; counts[0] stays 0."""
        wait_for_previous_kernel()
        i = wp.tid()
        index = (i / particle_count) * domain.cell_count
        index += space.cell_index(domain, space.cell_of(domain, positions[i]))
        cell[i] = index
        arrival[i] = wp.atomic_add(counts, index + 1, 1)
        if mask.shape[0] > 0 and mask[i] != wp.uint8(0):
            wp.atomic_add(counts, active_offset + index + 1, 1)

    @wp.kernel(module=module)
    def place_by_arrival(
        mask: wp.array[wp.uint8],
        cell: wp.array[wp.int32],
        arrival: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        # outputs
        arrived: wp.array[wp.vec2i],
    ):
        """List the particles by cell, in the order in which atomics counted them.

        An entry is twice the particle's index, plus one if it is active; then its cell.
        """
        wait_for_previous_kernel()
        i = wp.tid()
        entry = 2 * i
        if mask.shape[0] == 0 or mask[i] != wp.uint8(0):
            entry += 1
        c = load_integer(cell, i)
        target = load_integer(starts, c) + load_integer(arrival, i)
        wide_store(arrived, target, wp.vec2i(entry, c))

    @in_ranges(PARTICLES)
    @wp.kernel(module=module)
    def order_particles(
        range_start: int,
        positions: wp.array[vector],
        state_dim: int,
        group_count: int,
        aligned: int,
        states: wp.array[scalar],
        active_offset: int,
        row_base: int,
        row_capacity: int,
        arrived: wp.array[wp.vec2i],
        starts: wp.array[wp.int32],
        # outputs
        original_index: wp.array[wp.int32],
        sorted_cell: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        row_particle: wp.array[wp.int32],
        row_index: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        row_positions: wp.array[vector],
        sorted_states: wp.array[group],
    ):
        """Write particles sorted by cell, then index, and number the rows of active ones."""
        wait_for_previous_kernel()
        k = range_start + wp.tid()
        entry = arrived[k]
        i = entry[0] / 2
        c = entry[1]
        target = starts[c]
        row = starts[active_offset + c] - row_base
        for j in range(starts[c], starts[c + 1]):
            other = arrived[j][0]
            if other < entry[0]:
                target += 1
                row += other & 1
        original_index[target] = i
        sorted_cell[target] = c
        sorted_positions[target] = positions[i]
        if row_of.shape[0] > 0:
            if entry[0] & 1 == 0 or row >= row_capacity:
                row = wp.int32(-1)
            row_of[i] = row
            if row >= 0:
                row_particle[row] = i
                row_index[row] = target
                row_positions[row] = positions[i]
        if sorted_states.shape[0] > 0:
            for g in range(group_count):
                state = read_channels(states, state_dim, aligned, i, g * wp.static(width))
                sorted_states[target * group_count + g] = state

    @in_ranges(WORLDS)
    @wp.kernel(module=module)
    def sort_worlds(
        range_start: int,
        domain: Domain,
        positions: wp.array[vector],
        mask: wp.array[wp.uint8],
        particle_count: int,
        state_dim: int,
        group_count: int,
        aligned: int,
        states: wp.array[scalar],
        active_offset: int,
        row_base: int,
        row_capacity: int,
        # outputs
        cell: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        original_index: wp.array[wp.int32],
        sorted_cell: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        row_particle: wp.array[wp.int32],
        row_index: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        row_positions: wp.array[vector],
        sorted_states: wp.array[group],
    ):
        """Sort a world by cell, then index, in one thread: same result as the kernels above."""
        world = range_start + wp.tid()
        first = world * particle_count
        end = first + particle_count
        first_cell = world * domain.cell_count
        end_cell = first_cell + domain.cell_count
        first_row = row_base
        masked = mask.shape[0] > 0
        if masked:
            first_row += sum_of_first(mask, first)
        for c in range(first_cell, end_cell):
            starts[c] = 0
            if masked:
                starts[active_offset + c] = 0
        for i in range(first, end):
            c = first_cell + space.cell_index(domain, space.cell_of(domain, positions[i]))
            cell[i] = c
            starts[c] = starts[c] + 1
            if masked:
                starts[active_offset + c] = starts[active_offset + c] + wp.int32(mask[i])
        target = first
        row = first_row
        for c in range(first_cell, end_cell):
            count = starts[c]
            starts[c] = target
            target += count
            if masked:
                count = starts[active_offset + c]
                starts[active_offset + c] = row
                row += count
        if end == positions.shape[0]:
            starts[starts.shape[0] - 1] = wp.where(masked, row, target)

        # Each start is increased with every particle placed, up to the next cell's start.
        for i in range(first, end):
            c = cell[i]
            target = starts[c]
            starts[c] = target + 1
            original_index[target] = i
            sorted_cell[target] = c
            sorted_positions[target] = positions[i]
            row = target
            if masked:
                row = starts[active_offset + c] - row_base
                active = wp.int32(mask[i])
                starts[active_offset + c] = row + row_base + active
                row = wp.where(active != 0, row, row_capacity)
            if row_of.shape[0] > 0:
                row_of[i] = wp.where(row < row_capacity, row, wp.int32(-1))
                if row < row_capacity:
                    row_particle[row] = i
                    row_index[row] = target
                    row_positions[row] = positions[i]
            if sorted_states.shape[0] > 0:
                for g in range(group_count):
                    state = read_channels(states, state_dim, aligned, i, g * wp.static(width))
                    sorted_states[target * group_count + g] = state
        for back in range(end_cell - first_cell - 1):
            c = end_cell - 1 - back
            starts[c] = starts[c - 1]
            if masked:
                starts[active_offset + c] = starts[active_offset + c - 1]
        starts[first_cell] = first
        if masked:
            starts[active_offset + first_cell] = first_row

    return namespace(locals())


@cached_under_lock()
def give_rows(space_dim: int, scalar: type) -> wp.Kernel:
    """Return the kernel that numbers the rows of the active particles of sorted worlds."""
    vector = wp.types.vector(space_dim, scalar)

    @wp.kernel(module=kernel_module("rows", space_dim, scalar))
    def give_rows(
        total: int,
        active_offset: int,
        active_before: wp.array[wp.int32],
        cell_starts: wp.array[wp.int32],
        positions: wp.array[vector],
        # outputs
        row_of: wp.array2d[wp.int32],
        row_particle: wp.array2d[wp.int32],
        starts: wp.array2d[wp.int32],
        row_positions: wp.array2d[vector],
    ):
        """Write the row of each particle, the particle of each row, and starts of cells and rows.

        It does so for several steps of the same sorted worlds; a step has a thread for each
        particle or start, whichever are more. `active_before` is the number of active particles up
        to and with each particle, accumulated over all steps.
        """
        wait_for_previous_kernel()
        step, t = wp.tid()
        earlier = wp.int32(0)
        if step > 0:
            earlier = active_before[step * total - 1]
        if t < starts.shape[1]:
            if t < active_offset:
                starts[step, t] = cell_starts[t]
            else:
                first = cell_starts[t - active_offset]
                before = wp.int32(0)
                if first > 0:
                    before = active_before[step * total + first - 1] - earlier
                starts[step, t] = total + before
        if t < total:
            before = wp.int32(0)
            if t > 0:
                before = active_before[step * total + t - 1] - earlier
            active = active_before[step * total + t] - earlier > before
            row = wp.int32(-1)
            if active and before < row_particle.shape[1]:
                row = before
                row_particle[step, row] = t
                row_positions[step, row] = positions[t]
            row_of[step, t] = row

    return give_rows
