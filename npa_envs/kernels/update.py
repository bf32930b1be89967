"""One step's update of positions and states from the rule's outputs, and its adjoint.

A displacement is alpha eps delta / (1 + |delta|): it never exceeds alpha eps.
Source: arXiv 2601.16096, section 3.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import domain_types, kernel_module


@functools.cache
def update_kernels(space_dim: int, scalar: type) -> SimpleNamespace:
    """Return the kernels of one variant."""
    types = domain_types(space_dim, scalar)
    vector = types.vector
    wide = wp.types.vector(space_dim, wp.float64)
    module = kernel_module("update", space_dim, scalar)

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
                # In float64: the position is then rounded once, and rules amplify its rounding.
                delta = wide()
                for d in range(wp.static(space_dim)):
                    delta[d] = wp.float64(update[row, d])
                length = wp.length(delta)
                step = largest_step / (wp.float64(1.0) + length)
                for d in range(wp.static(space_dim)):
                    position[d] = scalar(wp.float64(position[d]) + step * delta[d])
                path += scalar(step * length)
            if periodic != 0:
                for d in range(wp.static(space_dim)):
                    position[d] -= box[d] * wp.floor(position[d] / box[d] + scalar(0.5))
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

    return SimpleNamespace(apply_update=apply_update, pull_back_update=pull_back_update)
