"""Cell lists of small worlds on CUDA, also of splats: a block sorts a world in shared memory.

The order is that of the portable kernels, in one launch instead of six: particles are counted by
cell, the counts are added up, particles get provisional positions in order of arrival, and ranks
among indices replace these. Several blocks share a world if worlds are few: each writes a slice.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.lanes_and_memory import (
    CUDA_LANES,
    WARP,
    block_number,
    load_integer,
    make_read_channels,
    make_wide_load,
    of_warp,
    sync_block,
    thread_of_block,
    wait_for_previous_kernel,
    wide_store,
)
from npa_envs.kernels.pictures.splat import splat_functions, splat_types
from npa_envs.kernels.portable.world_mean import CHUNK

load_pair = make_wide_load(wp.vec2i)

BLOCKS = {1024: 256, 4096: 1024}
"""Threads of a block by its capacity in particles."""

RESIDENT_THREADS, MAX_GRID = 1024, 4096
"""Threads for which a multiprocessor has registers; maximum cells of a world that a block sorts."""

THREAD_CHANNELS = 4
"""Adjacent channels that a thread moves."""

count_active = native.function("count_active", mask=wp.array[wp.uint8], count=int, returns=int)
"""The number of active particles in this thread's part of `mask`, up to `count`."""


@cached_under_lock()
def block_functions(capacity: int) -> SimpleNamespace:
    """Return the C++ functions with which a block sorts a world of up to `capacity` particles."""
    sizes = capacity, BLOCKS[capacity], MAX_GRID

    def of_block(name: str, returns: Any = None, **arguments: Any) -> Any:
        """Return a Warp function for the C++ function `name` of a `block_memory`."""
        return native.function(name, *sizes, address=wp.uint64, **arguments, returns=returns)

    return SimpleNamespace(
        block_memory=native.function("block_memory", *sizes, returns=wp.uint64),
        clear_counts=of_block("clear_counts", cell_count=int, earlier=int),
        count_particle=of_block("count_particle", particle=int, cell=int, active=bool),
        add_up_counts=of_block("add_up_counts", cell_count=int),
        start_of=of_block("start_of", wp.vec2i, cell=int),
        place_arrived=of_block("place_arrived", particle=int),
        span_of_slice=of_block("span_of_slice", wp.vec2i, begin=int, end=int),
        ranked_at=of_block("ranked_at", wp.vec3i, provisional=int, unordered=int),
        member_at=of_block("member_at", int, provisional=int),
    )


@cached_under_lock()
def sort_small_worlds(space_dim: int, capacity: int) -> wp.Kernel:
    """Return the kernel that sorts float32 worlds of up to `capacity` particles, by blocks."""
    scalar = wp.float32
    block = BLOCKS[capacity]
    rounds = capacity // block
    space = domain_types(space_dim, scalar)
    vector, Domain = space.vector, space.Domain
    channels = wp.types.vector(THREAD_CHANNELS, scalar)
    positions_ahead = wp.types.matrix((rounds, space_dim), scalar)
    flags_ahead = wp.types.vector(rounds, wp.int32)
    load_vector = make_wide_load(vector)
    read_channels = make_read_channels(channels)
    sorting = block_functions(capacity)
    module = kernel_module("small_worlds", space_dim, scalar, capacity=capacity)

    @wp.kernel(module=module, launch_bounds=(block, RESIDENT_THREADS // block))
    def sort_worlds(
        domain: Domain,
        particle_count: int,
        slice_count: int,
        positions: wp.array[vector],
        state_dim: int,
        parts: int,
        aligned: int,
        states: wp.array[scalar],
        mask: wp.array[wp.uint8],
        active_offset: int,
        row_base: int,
        row_capacity: int,
        # outputs
        starts: wp.array[wp.int32],
        original_index: wp.array[wp.int32],
        sorted_cell: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        row_particle: wp.array[wp.int32],
        row_index: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        row_positions: wp.array[vector],
        sorted_states: wp.array[channels],
    ):
        """Sort a world by cell, then index: each of its blocks sorts it and writes a slice."""
        wait_for_previous_kernel()
        world = block_number() / slice_count
        slice_number = block_number() - world * slice_count
        lane = thread_of_block()
        first_particle = world * particle_count
        first_cell = world * domain.cell_count
        masked = mask.shape[0] > 0
        ahead = positions_ahead()
        acting = flags_ahead()
        for r in range(wp.static(rounds)):
            i = wp.min(lane + r * wp.static(block), particle_count - 1)
            position = load_vector(positions, first_particle + i)
            for d in range(wp.static(space_dim)):
                ahead[r, d] = position[d]
            acting[r] = wp.int32(1)
            if masked:
                acting[r] = wp.int32(mask[first_particle + i])
        earlier = wp.int32(0)
        if masked:
            earlier = count_active(mask, first_particle)
        elif lane == 0:
            earlier = first_particle
        memory = sorting.block_memory()
        sorting.clear_counts(memory, domain.cell_count, earlier)
        for r in range(wp.static(rounds)):
            i = lane + r * wp.static(block)
            if i < particle_count:
                position = vector()
                for d in range(wp.static(space_dim)):
                    position[d] = ahead[r, d]
                cell = space.cell_index(domain, space.cell_of(domain, position))
                sorting.count_particle(memory, i, cell, acting[r] != 0)
        sorting.add_up_counts(memory, domain.cell_count)

        slice_cells = (domain.cell_count + slice_count - 1) / slice_count
        from_cell = slice_number * slice_cells
        to_cell = wp.min(from_cell + slice_cells, domain.cell_count)
        for cell in range(from_cell + lane, to_cell, wp.static(block)):
            start = sorting.start_of(memory, cell)
            wide_store(starts, first_cell + cell, first_particle + start[0])
            if masked:
                wide_store(starts, active_offset + first_cell + cell, row_base + start[1])
        is_last_world = first_particle + particle_count == positions.shape[0]
        if lane == 0 and slice_number == 0 and is_last_world:
            end_of_all = sorting.start_of(memory, domain.cell_count)
            starts[starts.shape[0] - 1] = row_base + end_of_all[1]
        for i in range(lane, particle_count, wp.static(block)):
            sorting.place_arrived(memory, i)
        sync_block()

        slice_size = (particle_count + slice_count - 1) / slice_count
        begin = slice_number * slice_size
        end = wp.min(begin + slice_size, particle_count)
        if begin < end:
            span = sorting.span_of_slice(memory, begin, end)
            for chunk in range(span[0] * parts + lane, span[1] * parts, wp.static(block)):
                k = chunk / parts
                part = chunk - k * parts
                i = first_particle + sorting.member_at(memory, k)
                position = load_vector(positions, i)
                state = channels()
                if sorted_states.shape[0] > 0:
                    first = part * wp.static(THREAD_CHANNELS)
                    state = read_channels(states, state_dim, aligned, i, first)
                ranked = sorting.ranked_at(memory, k, wp.int32(-1))
                inside = ranked[0] >= begin and ranked[0] < end
                target = first_particle + ranked[0]
                if inside and sorted_states.shape[0] > 0:
                    wide_store(sorted_states, target * parts + part, state)
                if inside and part == 0:
                    wide_store(original_index, target, i)
                    wide_store(sorted_cell, target, first_cell + ranked[1])
                    wide_store(sorted_positions, target, position)
                    if row_of.shape[0] > 0:
                        row = wp.where(ranked[2] < row_capacity, ranked[2], wp.int32(-1))
                        wide_store(row_of, i, row)
                        if row >= 0:
                            wide_store(row_particle, row, i)
                            wide_store(row_index, row, target)
                            wide_store(row_positions, row, position)

    return sort_worlds


@cached_under_lock()
def sort_small_splats(capacity: int) -> wp.Kernel:
    """Return the kernel that sorts the footprints of small worlds' particles on pictures.

    Footprints and order are those of `pictures/splat.py`. A block also computes its world's mean.
    """
    scalar = wp.float32
    block = BLOCKS[capacity]
    types, splat = splat_types(scalar), splat_functions(scalar)
    View, vector, footprint_type = types.View, types.vector, types.footprint
    load_vector = make_wide_load(vector)
    sorting = block_functions(capacity)
    world = {"positions": wp.array[vector], "first": int, "count": int}
    mean_of_world = native.function("mean_of_world", capacity, CHUNK, **world, returns=vector)
    module = native.module(f"npa_envs.kernels.small_splats_{capacity}")

    @wp.kernel(module=module, launch_bounds=(block, RESIDENT_THREADS // block))
    def sort_splats(
        view: View,
        slice_count: int,
        particle_count: int,
        positions: wp.array[vector],
        states: wp.array2d[scalar],
        shift: scalar,
        goal: wp.array[vector],
        # outputs
        starts: wp.array[wp.int32],
        footprints: wp.array[footprint_type],
        original_index: wp.array[wp.int32],
    ):
        """Write the footprints of a world, sorted by cell, then index; a block writes a slice."""
        wait_for_previous_kernel()
        world = block_number() / slice_count
        slice_number = block_number() - world * slice_count
        lane = thread_of_block()
        first_particle = world * particle_count
        mean = vector()
        if goal.shape[0] > 0:
            mean = mean_of_world(positions, first_particle, particle_count)
        memory = sorting.block_memory()
        sorting.clear_counts(memory, view.cell_count, wp.int32(0))
        for i in range(lane, particle_count, wp.static(block)):
            position = load_vector(positions, first_particle + i)
            position = splat.pixel_position(view, position, mean, goal)
            cell = splat.cell_of_centre(view, splat.patch_centre(position))
            sorting.count_particle(memory, i, cell, False)
        sorting.add_up_counts(memory, view.cell_count)
        first_cell = world * view.cell_count
        stride = slice_count * wp.static(block)
        for cell in range(slice_number * wp.static(block) + lane, view.cell_count, stride):
            start = first_particle + sorting.start_of(memory, cell)[0]
            wide_store(starts, first_cell + cell, start)
        if lane == 0 and first_particle + particle_count == positions.shape[0]:
            starts[starts.shape[0] - 1] = positions.shape[0]
        for i in range(lane, particle_count, wp.static(block)):
            sorting.place_arrived(memory, i)
        sync_block()

        slice_size = (particle_count + slice_count - 1) / slice_count
        begin = slice_number * slice_size
        # Invisible splats, which may be many, can have any order. As it differs among the blocks of
        # a world, the last block writes all of them.
        hidden = sorting.start_of(memory, view.cell_count - 1)[0]
        end = wp.min(begin + slice_size, hidden)
        if slice_number == slice_count - 1:
            begin = wp.min(begin, hidden)
            end = particle_count
        if begin < end:
            span = sorting.span_of_slice(memory, begin, end)
            for k in range(span[0] + lane, span[1], wp.static(block)):
                target = sorting.ranked_at(memory, k, view.cell_count - 1)[0]
                if target >= begin and target < end:
                    i = first_particle + sorting.member_at(memory, k)
                    position = splat.pixel_position(view, load_vector(positions, i), mean, goal)
                    target += first_particle
                    footprint = splat.footprint_of(view, position, i, states, shift)
                    wide_store(footprints, target, footprint)
                    wide_store(original_index, target, i)

    return sort_splats


@cached_under_lock()
def order_particles(space_dim: int, width: int) -> wp.Kernel:
    """Return the last kernel that sorts large worlds; a warp moves states of 32 particles."""
    scalar = wp.float32
    vector = domain_types(space_dim, scalar).vector
    thread_width = width // CUDA_LANES
    channels = wp.types.vector(thread_width, scalar)
    held_type = wp.types.matrix((CUDA_LANES, thread_width), scalar)
    read_channels = make_read_channels(channels)

    @wp.kernel(module=kernel_module("order", space_dim, scalar, width=width))
    def order_particles(
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
        sorted_states: wp.array[channels],
    ):
        """Write particles sorted by cell, then index, and number the rows of active ones.

        Launched with whole warps; threads beyond the last particle help to move states.
        """
        wait_for_previous_kernel()
        k = wp.tid()
        total = arrived.shape[0]
        entry = load_pair(arrived, wp.min(k, total - 1))
        i = entry[0] / 2
        c = entry[1]
        begin = load_integer(starts, c)
        first_row = load_integer(starts, active_offset + c) - row_base
        position = positions[i]
        rank = wp.int32(0)
        active_rank = wp.int32(0)
        for j in range(begin, load_integer(starts, c + 1)):
            other = load_pair(arrived, j)[0]
            if other < entry[0]:
                rank += 1
                active_rank += other & 1
        target = begin + rank
        if k < total:
            wide_store(original_index, target, i)
            wide_store(sorted_cell, target, c)
            wide_store(sorted_positions, target, position)
            if row_of.shape[0] > 0:
                row = first_row + active_rank
                if entry[0] & 1 == 0 or row >= row_capacity:
                    row = wp.int32(-1)
                wide_store(row_of, i, row)
                if row >= 0:
                    wide_store(row_particle, row, i)
                    wide_store(row_index, row, target)
                    wide_store(row_positions, row, position)

        # A warp moves the states of its particles together, adjacent threads adjacent channels. All
        # loads come before the first store.
        if sorted_states.shape[0] > 0:
            lane = k % wp.static(WARP)
            parts = group_count * wp.static(CUDA_LANES)
            for first_round in range(0, parts, wp.static(CUDA_LANES)):
                held = held_type()
                for r in range(wp.static(CUDA_LANES)):
                    chunk = lane + (first_round + r) * wp.static(WARP)
                    owner = chunk / parts
                    first = (chunk - owner * parts) * wp.static(thread_width)
                    state = read_channels(states, state_dim, aligned, of_warp(i, owner), first)
                    for n in range(wp.static(thread_width)):
                        held[r, n] = state[n]
                for r in range(wp.static(CUDA_LANES)):
                    chunk = lane + (first_round + r) * wp.static(WARP)
                    owner = chunk / parts
                    part = chunk - owner * parts
                    to = of_warp(target, owner) * parts + part
                    state = channels()
                    for n in range(wp.static(thread_width)):
                        state[n] = held[r, n]
                    if k - lane + owner < total:
                        wide_store(sorted_states, to, state)

    return order_particles
