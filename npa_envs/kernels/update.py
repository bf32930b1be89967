"""One step's update of positions and states: from a rule's outputs, with its adjoint, or actions.

A displacement is alpha eps delta / (1 + |delta|): it never exceeds alpha eps. An action gives it
as a fraction of alpha eps.
Source: arXiv 2601.16096, section 3.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.wide import make_read_at, make_write_at

CHANNEL_SHARE = 4
"""Channels of a particle that one thread of `apply_actions` changes."""


@functools.cache
def update_kernels(space_dim: int, scalar: type) -> SimpleNamespace:
    """Return the kernels of one variant."""
    types = domain_types(space_dim, scalar)
    vector = types.vector
    wide = wp.types.vector(space_dim, wp.float64)
    share = wp.types.vector(CHANNEL_SHARE, scalar)
    read_states = make_read_at(share, scalar, 16)
    read_actions = make_read_at(share, scalar, 8)
    write_states = make_write_at(share, scalar)
    module = kernel_module("update", space_dim, scalar)

    @wp.func
    def displaced(position: vector, factor: wp.float64, direction: wide):
        """Return a position moved by factor times direction.

        In float64: the position is then rounded once, and rules amplify its rounding.
        """
        result = position
        for d in range(wp.static(space_dim)):
            result[d] = scalar(wp.float64(position[d]) + factor * direction[d])
        return result

    @wp.func
    def wrapped(position: vector, box: vector):
        """Return a position's image in the periodic box around the origin."""
        result = position
        for d in range(wp.static(space_dim)):
            result[d] -= box[d] * wp.floor(position[d] / box[d] + scalar(0.5))
        return result

    @wp.func
    def held(value: scalar, limit: scalar):
        """Return a value within its limit, 0 where it is not a number, and whether it was moved."""
        result = value
        moved = wp.int32(0)
        if wp.isnan(value):
            result = scalar(0.0)
            moved = wp.int32(1)
        elif value > limit:
            result = limit
            moved = wp.int32(1)
        elif value < -limit:
            result = -limit
            moved = wp.int32(1)
        return result, moved

    @wp.kernel(enable_backward=False, module=module)
    def apply_update(
        largest_step: wp.float64,
        dt: scalar,
        periodic: wp.int32,
        box: vector,
        moving: wp.int32,
        row_of: wp.array(dtype=wp.int32),
        update: wp.array(dtype=scalar, ndim=2),
        positions: wp.array(dtype=vector),
        states: wp.array(dtype=scalar, ndim=2),
        path_length: wp.array(dtype=scalar),
        # outputs
        new_positions: wp.array(dtype=vector),
        new_states: wp.array(dtype=scalar, ndim=2),
        new_path_length: wp.array(dtype=scalar),
    ):
        """Move and change the particles that have a row; copy the others."""
        t = wp.tid()
        total = positions.shape[0]
        if t >= total:
            # The threads after the first B N: one for each state channel.
            i = (t - total) / states.shape[1]
            c = (t - total) % states.shape[1]
            row = row_of[i]
            state = states[i, c]
            if row >= 0:
                offset = wp.int32(0)
                if moving != 0:
                    offset = wp.int32(wp.static(space_dim))
                state += dt * update[row, offset + c]
            new_states[i, c] = state
        else:
            row = row_of[t]
            position = positions[t]
            path = path_length[t]
            if row >= 0 and moving != 0:
                delta = wide()
                for d in range(wp.static(space_dim)):
                    delta[d] = wp.float64(update[row, d])
                length = wp.length(delta)
                step = largest_step / (wp.float64(1.0) + length)
                position = displaced(position, step, delta)
                path += scalar(step * length)
            if periodic != 0:
                position = wrapped(position, box)
            new_positions[t] = position
            new_path_length[t] = path

    @wp.kernel(enable_backward=False, module=module)
    def pull_back_update(
        largest_step: scalar,
        dt: scalar,
        moving: wp.int32,
        row_base: wp.int32,
        starts: wp.array(dtype=wp.int32),
        row_source: wp.array(dtype=wp.int32),
        update: wp.array(dtype=scalar, ndim=2),
        new_positions_bar: wp.array(dtype=vector),
        new_states_bar: wp.array(dtype=scalar, ndim=2),
        new_path_bar: wp.array(dtype=scalar),
        # outputs
        update_bar: wp.array(dtype=scalar, ndim=2),
    ):
        """Write the cotangent of every row's update, zero beyond the last active row."""
        row, a = wp.tid()
        bar = scalar(0.0)
        if row < starts[starts.shape[0] - 1] - row_base:
            i = row_source[row]
            offset = wp.int32(0)
            if moving != 0:
                offset = wp.int32(wp.static(space_dim))
            if a >= offset:
                # Updates may be padded with columns that nothing reads.
                if a - offset < new_states_bar.shape[1]:
                    bar = dt * new_states_bar[i, a - offset]
            else:
                delta = vector()
                for d in range(wp.static(space_dim)):
                    delta[d] = update[row, d]
                length = wp.length(delta)
                shrink = scalar(1.0) / (scalar(1.0) + length)
                pull = new_positions_bar[i]
                radial = scalar(0.0)
                if length > scalar(0.0):
                    radial = (new_path_bar[i] - wp.dot(pull, delta)) * shrink * shrink / length
                bar = largest_step * (shrink * pull[a] + radial * delta[a])
        update_bar[row, a] = bar

    @wp.kernel(enable_backward=False, module=module)
    def apply_actions(
        particle_count: wp.int32,
        largest_step: wp.float64,
        largest_change: wp.float64,
        periodic: wp.int32,
        box: vector,
        moving: wp.int32,
        position_limit: scalar,
        state_limit: scalar,
        masked: wp.int32,
        mask: wp.array(dtype=wp.uint8),
        noisy: wp.int32,
        noise: wp.array(dtype=vector),
        switched: wp.int32,
        enabled: wp.array(dtype=wp.uint8),
        state_dim: wp.int32,
        aligned: wp.int32,
        actions: wp.array(dtype=scalar),
        # changed in place
        positions: wp.array(dtype=vector),
        states: wp.array(dtype=scalar),
        # outputs
        diverged: wp.array(dtype=wp.uint8),
    ):
        """Move and change the particles that act, and mark the worlds that had to be held back."""
        # All that is read is asked for before any of it is used: the kernel waits for memory.
        sharers = (state_dim + wp.static(CHANNEL_SHARE - 1)) / wp.static(CHANNEL_SHARE)
        t = wp.tid()
        i = t / sharers
        sharer = t - i * sharers
        happens = wp.uint8(1)
        if switched != 0:
            happens = enabled[0]
        acting = wp.uint8(1)
        if masked != 0:
            acting = mask[i]
        # A thread has some adjacent channels of a particle, which it reads and writes at once, or
        # every so-manyth of them, so that neighbouring threads touch neighbouring numbers.
        first = sharer
        stride = sharers
        if aligned != 0:
            first = sharer * wp.static(CHANNEL_SHARE)
            stride = wp.int32(1)
        states_begin = i * state_dim
        actions_begin = states_begin
        if moving != 0:
            actions_begin += (i + 1) * wp.static(space_dim)
        before = share()
        change = share()
        if aligned != 0:
            before = read_states(states, states_begin + first)
            change = read_actions(actions, actions_begin + first)
        else:
            for k in range(wp.static(CHANNEL_SHARE)):
                # The last thread of a particle may have fewer channels, and repeats its first.
                c = wp.where(first + k * stride < state_dim, first + k * stride, first)
                before[k] = states[states_begin + c]
                change[k] = actions[actions_begin + c]
        position = vector()
        push = vector()
        direction = wide()
        # A particle's first thread moves it, too.
        if sharer == 0:
            position = positions[i]
            if noisy != 0:
                push = noise[i]
            if moving != 0:
                for d in range(wp.static(space_dim)):
                    own = actions_begin - wp.static(space_dim) + d
                    direction[d] = wp.float64(actions[own])
        held_back = wp.int32(0)
        if happens != wp.uint8(0):
            after = share()
            changed = wp.int32(0)
            for k in range(wp.static(CHANNEL_SHARE)):
                state = before[k]
                if acting != wp.uint8(0):
                    # Comparisons let a value through that is not a number; a clamp would not.
                    part = change[k]
                    if part > scalar(1.0):
                        part = scalar(1.0)
                    if part < scalar(-1.0):
                        part = scalar(-1.0)
                    state = scalar(wp.float64(state) + largest_change * wp.float64(part))
                state, state_held = held(state, state_limit)
                after[k] = state
                if first + k * stride < state_dim:
                    changed += state_held
            held_back += changed
            if acting != wp.uint8(0) or changed != 0:
                if aligned != 0:
                    write_states(states, states_begin + first, after)
                else:
                    for k in range(wp.static(CHANNEL_SHARE)):
                        c = first + k * stride
                        if c < state_dim:
                            states[states_begin + c] = after[k]
            if sharer == 0:
                if noisy != 0:
                    position += push
                if moving != 0 and acting != wp.uint8(0):
                    length = wp.length(direction)
                    step = largest_step
                    if length > wp.float64(1.0):
                        step = largest_step / length
                    position = displaced(position, step, direction)
                if periodic != 0:
                    position = wrapped(position, box)
                for d in range(wp.static(space_dim)):
                    coordinate, coordinate_held = held(position[d], position_limit)
                    position[d] = coordinate
                    held_back += coordinate_held
                positions[i] = position
        if held_back != 0:
            diverged[i / particle_count] = wp.uint8(1)

    return SimpleNamespace(
        apply_update=apply_update, pull_back_update=pull_back_update, apply_actions=apply_actions
    )
