"""Updates of positions and states, from a rule's outputs or from actions, with the adjoint.

A displacement is alpha eps delta / (1 + |delta|): it never exceeds alpha eps. Actions are fractions
of alpha eps.
Source: arXiv 2601.16096, section 3. Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import domain_types, kernel_module, scalar_name
from npa_envs.kernels.lanes_and_memory import (
    allow_next_launch,
    load_integer,
    make_read_at,
    make_wide_load,
    wait_for_previous_kernel,
    write_at,
)
from npa_envs.kernels.native_functions import ELEMENTS, in_ranges, namespace

THREAD_CHANNELS = 4
"""Adjacent channels of a particle, or columns of a row, that one thread changes."""

UPDATE_ALIGNMENT = {2: 8, 3: 4}
"""Alignment [bytes] of the state part of an update in float32, by space dimension."""

OPEN, PERIODIC, REFLECTING = range(3)
"""Kinds of boundaries, as kernels read them."""

MOVED_TOGETHER = 32
"""Particles whose positions a warp updates; the warps after it update their states."""


@cached_under_lock()
def motion_functions(space_dim: int, scalar: type) -> SimpleNamespace:
    """Return the Warp functions that move a position and keep it within the boundary."""
    space = domain_types(space_dim, scalar)
    vector, vector_f64 = space.vector, space.vector_f64

    @wp.func
    def displaced(position: vector, factor: wp.float64, direction: vector_f64):
        """Return position + factor * direction; in float64, to round it only once."""
        result = position
        for d in range(wp.static(space_dim)):
            result[d] = scalar(wp.float64(position[d]) + factor * direction[d])
        return result

    @wp.func
    def bounded(position: vector, boundary: int, box: vector):
        """Return a position's image in the box around 0; reflecting walls mirror odd images."""
        result = position
        if boundary != wp.static(OPEN):
            for d in range(wp.static(space_dim)):
                image = wp.floor(position[d] / box[d] + scalar(0.5))
                result[d] -= box[d] * image
                odd = image != scalar(2.0) * wp.floor(scalar(0.5) * image)
                if odd and boundary == wp.static(REFLECTING):
                    result[d] = -result[d]
        return result

    return namespace(locals())


@cached_under_lock()
def update_kernels(space_dim: int, scalar: type, on_cpu: bool) -> SimpleNamespace:
    """Return `apply_update`, which moves particles and changes states, and its backward kernel."""
    space = domain_types(space_dim, scalar)
    vector, vector_f64 = space.vector, space.vector_f64
    channels = wp.types.vector(THREAD_CHANNELS, scalar)
    motion = motion_functions(space_dim, scalar)
    load_scalar = make_wide_load(scalar)
    read_states = make_read_at(channels, 16)
    read_change = make_read_at(channels, UPDATE_ALIGNMENT[space_dim])
    module = kernel_module("update", space_dim, scalar, on_cpu=on_cpu)

    @in_ranges(ELEMENTS // MOVED_TOGETHER if on_cpu else ELEMENTS)
    @wp.kernel(module=module)
    def apply_update(
        range_start: int,
        largest_step: wp.float64,
        dt: scalar,
        boundary: int,
        box: vector,
        moving: int,
        state_dim: int,
        update_width: int,
        aligned: int,
        row_of: wp.array[wp.int32],
        update: wp.array[scalar],
        positions: wp.array[vector],
        states: wp.array[scalar],
        path_length: wp.array[scalar],
        # outputs
        new_positions: wp.array[vector],
        new_states: wp.array[scalar],
        new_path_length: wp.array[scalar],
    ):
        """Write new positions, states and path lengths; a particle without a row keeps its own."""
        wait_for_previous_kernel()
        # Of the threads of a group of particles, the first move one particle each, and the others
        # change some channels each. On a CPU, which divides slowly, a thread has the whole group.
        chunks = (state_dim + wp.static(THREAD_CHANNELS - 1)) / wp.static(THREAD_CHANNELS)
        t = range_start + wp.tid()
        begin = t * wp.static(MOVED_TOGETHER)
        count = wp.int32(MOVED_TOGETHER)
        first_part = wp.int32(0)
        parts = 1 + chunks
        if wp.static(not on_cpu):
            group = t / (wp.static(MOVED_TOGETHER) * (1 + chunks))
            thread = t - group * (wp.static(MOVED_TOGETHER) * (1 + chunks))
            begin = group * wp.static(MOVED_TOGETHER) + thread
            if thread >= wp.static(MOVED_TOGETHER):
                channel_thread = thread - wp.static(MOVED_TOGETHER)
                member = channel_thread / chunks
                begin = group * wp.static(MOVED_TOGETHER) + member
                first_part = 1 + channel_thread - member * chunks
            count = wp.int32(1)
            parts = wp.int32(1)
        for i in range(begin, wp.min(begin + count, positions.shape[0])):
            row = load_integer(row_of, i)
            row_begin = row * update_width
            for part in range(first_part, first_part + parts):
                if part == 0:
                    position = positions[i]
                    path = path_length[i]
                    if row >= 0 and moving != 0:
                        delta = vector_f64()
                        for d in range(wp.static(space_dim)):
                            delta[d] = wp.float64(load_scalar(update, row_begin + d))
                        length = wp.length(delta)
                        step = largest_step / (wp.float64(1.0) + length)
                        position = motion.displaced(position, step, delta)
                        path += scalar(step * length)
                    position = motion.bounded(position, boundary, box)
                    new_positions[i] = position
                    new_path_length[i] = path
                else:
                    first = (part - 1) * wp.static(THREAD_CHANNELS)
                    states_begin = i * state_dim + first
                    change_begin = row_begin + first
                    if moving != 0:
                        change_begin += wp.static(space_dim)
                    if aligned != 0:
                        state = read_states(states, states_begin)
                        if row >= 0:
                            change = read_change(update, change_begin)
                            for k in range(wp.static(THREAD_CHANNELS)):
                                state[k] += dt * change[k]
                        write_at(new_states, states_begin, state)
                    else:
                        for k in range(wp.min(wp.static(THREAD_CHANNELS), state_dim - first)):
                            value = states[states_begin + k]
                            if row >= 0:
                                value += dt * update[change_begin + k]
                            new_states[states_begin + k] = value

    @in_ranges(ELEMENTS)
    @wp.kernel(module=module)
    def pull_back_update(
        range_start: int,
        largest_step: scalar,
        dt: scalar,
        moving: int,
        row_base: int,
        state_dim: int,
        update_width: int,
        aligned: int,
        starts: wp.array[wp.int32],
        row_particle: wp.array[wp.int32],
        update: wp.array[scalar],
        new_positions_bar: wp.array[vector],
        new_states_bar: wp.array[scalar],
        new_path_bar: wp.array[scalar],
        # outputs
        update_bar: wp.array[scalar],
    ):
        """Write dL/d(update) of every row; 0 beyond the last active row."""
        wait_for_previous_kernel()
        allow_next_launch()
        # A thread writes some adjacent columns of a row.
        chunks = (update_width + wp.static(THREAD_CHANNELS - 1)) / wp.static(THREAD_CHANNELS)
        t = range_start + wp.tid()
        row = t / chunks
        first = (t - row * chunks) * wp.static(THREAD_CHANNELS)
        row_begin = row * update_width
        i = load_integer(row_particle, row)
        bar = channels()
        if row < load_integer(starts, starts.shape[0] - 1) - row_base:
            offset = wp.int32(0)
            if moving != 0:
                offset = wp.int32(wp.static(space_dim))
            for k in range(wp.static(THREAD_CHANNELS)):
                # Updates may have padding columns.
                c = first + k - offset
                index = i * state_dim + wp.clamp(c, 0, state_dim - 1)
                state_bar = load_scalar(new_states_bar, index)
                if c >= 0 and c < state_dim:
                    bar[k] = dt * state_bar
            if first < offset:
                delta = vector()
                for d in range(wp.static(space_dim)):
                    delta[d] = load_scalar(update, row_begin + d)
                length = wp.length(delta)
                shrink = scalar(1.0) / (scalar(1.0) + length)
                moved_bar = new_positions_bar[i]
                radial = scalar(0.0)
                if length > scalar(0.0):
                    radial = (new_path_bar[i] - wp.dot(moved_bar, delta)) * shrink * shrink / length
                for d in range(wp.static(space_dim)):
                    bar[d] = largest_step * (shrink * moved_bar[d] + radial * delta[d])
        if aligned != 0:
            write_at(update_bar, row_begin + first, bar)
        else:
            for k in range(wp.static(THREAD_CHANNELS)):
                if first + k < update_width:
                    update_bar[row_begin + first + k] = bar[k]

    return namespace(locals())


@cached_under_lock()
def action_kernel(space_dim: int, scalar: type) -> wp.Kernel:
    """Return the kernel that moves particles and changes states by actions."""
    space = domain_types(space_dim, scalar)
    vector, vector_f64 = space.vector, space.vector_f64
    channels = wp.types.vector(THREAD_CHANNELS, scalar)
    motion = motion_functions(space_dim, scalar)
    read_states = make_read_at(channels, 16)
    read_actions = make_read_at(channels, 8)

    @wp.func
    def clipped(value: scalar, limit: scalar):
        """Return a value clipped to plus and minus a limit (NaN: 0), and whether it changed."""
        result = value
        changed = wp.int32(0)
        if wp.isnan(value):
            result = scalar(0.0)
            changed = wp.int32(1)
        elif value > limit:
            result = limit
            changed = wp.int32(1)
        elif value < -limit:
            result = -limit
            changed = wp.int32(1)
        return result, changed

    @wp.func
    def acted_state(state: scalar, action: scalar, largest_change: wp.float64):
        """Return a state plus `largest_change` times an action, which is clipped to [-1, 1]."""
        # Comparisons keep NaN; a clamp would not.
        part = action
        if part > scalar(1.0):
            part = scalar(1.0)
        if part < scalar(-1.0):
            part = scalar(-1.0)
        return scalar(wp.float64(state) + largest_change * wp.float64(part))

    @wp.func
    def acted_position(position: vector, action: vector_f64, largest_step: wp.float64):
        """Return a position moved by `largest_step` times an action, shortened to at most 1."""
        length = wp.length(action)
        step = largest_step
        # Written in this way, one NaN coordinate makes all of them NaN.
        if not (length <= wp.float64(1.0)):
            step = largest_step / length
        return motion.displaced(position, step, action)

    @in_ranges(ELEMENTS)
    @wp.kernel(module=kernel_module("actions", space_dim, scalar))
    def apply_actions(
        range_start: int,
        particle_count: int,
        largest_step: wp.float64,
        largest_change: wp.float64,
        boundary: int,
        box: vector,
        moving: int,
        position_limit: scalar,
        state_limit: scalar,
        mask: wp.array[wp.uint8],
        noise: wp.array[vector],
        enabled: wp.array[wp.uint8],
        state_dim: int,
        aligned: int,
        actions: wp.array[scalar],
        # changed in place
        positions: wp.array[vector],
        states: wp.array[scalar],
        # outputs
        diverged: wp.array[wp.uint8],
    ):
        """Apply actions of active particles in place; `diverged`: worlds with clipped values."""
        wait_for_previous_kernel()
        # All loads are issued before any value is used, as the kernel waits for memory.
        chunks = (state_dim + wp.static(THREAD_CHANNELS - 1)) / wp.static(THREAD_CHANNELS)
        t = range_start + wp.tid()
        i = t / chunks
        chunk = t - i * chunks
        happens = wp.uint8(1)
        if enabled.shape[0] > 0:
            happens = enabled[0]
        acting = wp.uint8(1)
        if mask.shape[0] > 0:
            acting = mask[i]
        # A thread has some adjacent channels of a particle, if it reads and writes them at once, or
        # channels at a constant stride, so that adjacent threads access adjacent numbers.
        first = chunk
        stride = chunks
        if aligned != 0:
            first = chunk * wp.static(THREAD_CHANNELS)
            stride = wp.int32(1)
        states_begin = i * state_dim
        actions_begin = states_begin
        if moving != 0:
            actions_begin += (i + 1) * wp.static(space_dim)
        before = channels()
        change = channels()
        if aligned != 0:
            before = read_states(states, states_begin + first)
            change = read_actions(actions, actions_begin + first)
        else:
            for k in range(wp.static(THREAD_CHANNELS)):
                # The last thread of a particle may have fewer channels, and then repeats its first.
                c = wp.where(first + k * stride < state_dim, first + k * stride, first)
                before[k] = states[states_begin + c]
                change[k] = actions[actions_begin + c]
        position = vector()
        push = vector()
        direction = vector_f64()
        # A particle's first thread also moves it.
        if chunk == 0:
            position = positions[i]
            if noise.shape[0] > 0:
                push = noise[i]
            if moving != 0:
                for d in range(wp.static(space_dim)):
                    own = actions_begin - wp.static(space_dim) + d
                    direction[d] = wp.float64(actions[own])
        clipped_count = wp.int32(0)
        if happens != wp.uint8(0):
            after = channels()
            changed = wp.int32(0)
            for k in range(wp.static(THREAD_CHANNELS)):
                state = before[k]
                if acting != wp.uint8(0):
                    state = acted_state(state, change[k], largest_change)
                state, state_clipped = clipped(state, state_limit)
                after[k] = state
                if first + k * stride < state_dim:
                    changed += state_clipped
            clipped_count += changed
            if acting != wp.uint8(0) or changed != 0:
                if aligned != 0:
                    write_at(states, states_begin + first, after)
                else:
                    for k in range(wp.static(THREAD_CHANNELS)):
                        c = first + k * stride
                        if c < state_dim:
                            states[states_begin + c] = after[k]
            if chunk == 0:
                if noise.shape[0] > 0:
                    position += push
                if moving != 0 and acting != wp.uint8(0):
                    position = acted_position(position, direction, largest_step)
                position = motion.bounded(position, boundary, box)
                for d in range(wp.static(space_dim)):
                    coordinate, coordinate_clipped = clipped(position[d], position_limit)
                    position[d] = coordinate
                    clipped_count += coordinate_clipped
                positions[i] = position
        if clipped_count != 0:
            diverged[i / particle_count] = wp.uint8(1)

    return apply_actions


QUAD, VALUES_PER_THREAD = 4, 8
"""Values that a thread of `flag_not_finite` reads at once, and values that it checks."""


@cached_under_lock()
def flag_not_finite(scalar: type) -> wp.Kernel:
    """Return the kernel that checks whether all numbers of an array are finite."""
    module = native.module(f"npa_envs.kernels.finite_{scalar_name(scalar)}")
    read_quad = make_read_at(wp.types.vector(QUAD, scalar), 16)

    @wp.kernel(module=module)
    def flag_not_finite(
        thread_count: int,
        values: wp.array[scalar],
        # outputs
        finite: wp.array[wp.uint8],
    ):
        """Write 0 to `finite` if a value is infinite or NaN; values are aligned to 16 bytes."""
        wait_for_previous_kernel()
        t = wp.tid()
        wild = wp.int32(0)
        for k in range(wp.static(VALUES_PER_THREAD // QUAD)):
            first = (t + k * thread_count) * wp.static(QUAD)
            if first <= values.shape[0] - wp.static(QUAD):
                together = read_quad(values, first)
                for c in range(wp.static(QUAD)):
                    if not wp.isfinite(together[c]):
                        wild = wp.int32(1)
            else:
                for i in range(first, values.shape[0]):
                    if not wp.isfinite(values[i]):
                        wild = wp.int32(1)
        if wild != 0:
            finite[0] = wp.uint8(0)

    return flag_not_finite


@cached_under_lock()
def report_finite(scalar: type) -> wp.Kernel:
    """Return the kernel whose threads report whether the numbers that each has read are finite."""
    module = native.module(f"npa_envs.kernels.finite_reports_{scalar_name(scalar)}")
    read_quad = make_read_at(wp.types.vector(QUAD, scalar), 16)

    @wp.kernel(module=module, grid_stride=False)
    def report_finite(
        thread_count: int,
        finite: int,
        values: wp.array[scalar],
        # outputs
        reports: wp.array[wp.uint8],
    ):
        """Write `finite` or `finite` + 1 for each thread; values are aligned to 16 bytes."""
        wait_for_previous_kernel()
        t = wp.tid()
        if t >= thread_count:
            return
        report = finite
        for first in range(wp.static(QUAD) * t, values.shape[0], wp.static(QUAD) * thread_count):
            if first <= values.shape[0] - wp.static(QUAD):
                together = read_quad(values, first)
                for c in range(wp.static(QUAD)):
                    if not wp.isfinite(together[c]):
                        report = finite + 1
            else:
                for i in range(first, values.shape[0]):
                    if not wp.isfinite(values[i]):
                        report = finite + 1
        reports[t] = wp.uint8(report)

    return report_finite
