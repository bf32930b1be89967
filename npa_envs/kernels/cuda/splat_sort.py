"""Splats of small worlds on CUDA: a block sorts those of a world, in one launch.

The same footprints in the same order as in `pictures/splat.py`. The block also computes its world's
mean. If worlds are few, several blocks sort the same world, and each writes a slice.
"""

import warp as wp

from npa_envs.kernels import native_functions as native
from npa_envs.kernels.cuda.sort import BLOCKS, RESIDENT_THREADS, block_functions, store_integer
from npa_envs.kernels.pictures.splat import splat_functions, splat_types
from npa_envs.kernels.portable.world_mean import CHUNK
from npa_envs.kernels.primitives import (
    await_earlier,
    block_number,
    make_wide_load,
    make_wide_store,
    sync_block,
    thread_of_block,
)
from npa_envs.thread_lock import cached_under_lock


@cached_under_lock()
def sort_small_splats(capacity: int) -> wp.Kernel:
    """Return the kernel that sorts splats of float32, of worlds of up to `capacity` particles."""
    scalar = wp.float32
    block = BLOCKS[capacity]
    types, splat = splat_types(scalar), splat_functions(scalar)
    View, vector, footprint_type = types.View, types.vector, types.footprint
    load_vector = make_wide_load(vector)
    store_footprint = make_wide_store(footprint_type)
    sorting = block_functions(capacity)

    @native.func_native(capacity, CHUNK)
    def mean_of_world(positions: wp.array[vector], first: int, count: int) -> vector:
        """Return the mean of a world's positions; the whole block calls it."""

    @wp.kernel(
        enable_backward=False,
        launch_bounds=(block, RESIDENT_THREADS // block),
        module=native.module(f"npa_envs.kernels.small_splats_{capacity}"),
    )
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
        source: wp.array[wp.int32],
    ):
        """Sort every world's splats by cell, then index; write one slice of them."""
        await_earlier()
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
            sorting.arrive(memory, i, cell, False)
        sorting.add_up_counts(memory, view.cell_count)
        first_cell = world * view.cell_count
        stride = slice_count * wp.static(block)
        for cell in range(slice_number * wp.static(block) + lane, view.cell_count, stride):
            start = first_particle + sorting.start_of(memory, cell)[0]
            store_integer(starts, first_cell + cell, start)
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
                    store_footprint(footprints, target, footprint)
                    store_integer(source, target, i)

    return sort_splats
