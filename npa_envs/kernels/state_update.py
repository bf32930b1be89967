"""Steps of particles that never move: which of them have rows, and the update of their states."""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import kernel_module
from npa_envs.kernels.groups import of_groups
from npa_envs.kernels.lanes import make_wide_load
from npa_envs.kernels.ranges import PARTICLES, in_ranges
from npa_envs.kernels.warps import load_integer
from npa_envs.kernels.wide import make_read_channels, make_wide_store, make_write_at


@functools.cache
def state_update_kernels(scalar: type, width: int) -> SimpleNamespace:
    """Return the kernels of one variant, for groups of `width` channels."""
    group = wp.types.vector(width, scalar)
    load_group = make_wide_load(group, scalar)
    store_group = make_wide_store(group, scalar)
    write_group = make_write_at(group, scalar)
    read_channels = make_read_channels(group, scalar)
    module = kernel_module("state_update", 0, scalar, width)

    @in_ranges(PARTICLES)
    @wp.kernel(enable_backward=False, module=module)
    def give_rows(
        range_start: wp.int32,
        total: wp.int32,
        row_capacity: wp.int32,
        active_before: wp.array(dtype=wp.int32),
        # outputs
        row_of: wp.array(dtype=wp.int32),
        row_place: wp.array(dtype=wp.int32),
    ):
        """Give the active particles of each step rows in their order.

        `active_before` counts each active particle itself.
        """
        t = range_start + wp.tid()
        step = t / total
        k = t - step * total
        count = load_integer(active_before, t)
        before = wp.int32(0)
        if k > 0:
            before = load_integer(active_before, t - 1)
        row = wp.int32(-1)
        if count > before and before < row_capacity:
            row = before
            row_place[step * row_capacity + row] = k
        row_of[t] = row

    @in_ranges(PARTICLES)
    @wp.kernel(enable_backward=False, module=module)
    def update_states(
        range_start: wp.int32,
        dt: scalar,
        state_dim: wp.int32,
        group_count: wp.int32,
        update_width: wp.int32,
        aligned: wp.int32,
        row_of: wp.array(dtype=wp.int32),
        update: wp.array(dtype=scalar),
        states: wp.array(dtype=group),
        # outputs
        new_states: wp.array(dtype=group),
    ):
        """Change the states of the particles that have a row; copy the others."""
        k, g = of_groups(range_start + wp.tid(), group_count)
        place = k * group_count + g
        state = load_group(states, place)
        row = k
        if row_of.shape[0] > 0:
            row = load_integer(row_of, k)
        if row >= 0:
            change = read_channels(update, update_width, aligned, row, g * wp.static(width))
            for c in range(wp.static(width)):
                # Updates may be padded with columns that nothing reads.
                if g * wp.static(width) + c < state_dim:
                    state[c] += dt * change[c]
        store_group(new_states, place, state)

    @in_ranges(PARTICLES)
    @wp.kernel(enable_backward=False, module=module)
    def pull_back_update(
        range_start: wp.int32,
        dt: scalar,
        state_dim: wp.int32,
        group_count: wp.int32,
        update_width: wp.int32,
        aligned: wp.int32,
        row_place: wp.array(dtype=wp.int32),
        active_before: wp.array(dtype=wp.int32),
        new_states_bar: wp.array(dtype=group),
        # outputs
        update_bar: wp.array(dtype=scalar),
    ):
        """Write the cotangent of every row's update, zero beyond the last active row."""
        parts = (update_width + wp.static(width - 1)) / wp.static(width)
        row, part = of_groups(range_start + wp.tid(), parts)
        k = row
        active = part < group_count
        if row_place.shape[0] > 0:
            active = active and row < load_integer(active_before, active_before.shape[0] - 1)
            if active:
                k = load_integer(row_place, row)
        first = part * wp.static(width)
        bar = group()
        if active:
            state_bar = load_group(new_states_bar, k * group_count + part)
            for c in range(wp.static(width)):
                if first + c < state_dim:
                    bar[c] = dt * state_bar[c]
        place = row * update_width + first
        if aligned != 0:
            write_group(update_bar, place, bar)
        else:
            for c in range(wp.static(width)):
                if first + c < update_width:
                    update_bar[place + c] = bar[c]

    return SimpleNamespace(
        give_rows=give_rows, update_states=update_states, pull_back_update=pull_back_update
    )
