"""Products of mixed vectors, which rotations do not change, and gated displacements.

`npa_envs/ops/equivariance.py` has the formulas, `kernels/portable/__init__.py` the arguments. A
thread computes a few numbers of a row.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.native_functions import ELEMENTS, in_ranges, namespace


@cached_under_lock()
def equivariance_kernels(space_dim: int, scalar: type) -> SimpleNamespace:
    """Return the forward and backward kernels of equivariant rules, by name."""
    vector = domain_types(space_dim, scalar).vector
    module = kernel_module("equivariance", space_dim, scalar)

    @wp.func
    def turned(u: vector):
        """Return a vector rotated by 90 degrees, in 2D."""
        result = vector()
        if wp.static(space_dim == 2):
            result[0] = -u[1]
            result[1] = u[0]
        return result

    types = space_dim, scalar, vector, turned, module
    return SimpleNamespace(**(vars(product_kernels(*types)) | vars(steering_kernels(*types))))


def product_kernels(
    space_dim: int, scalar: type, vector: type, turned: wp.Function, module: wp.Module
) -> SimpleNamespace:
    """Return the kernels of mixed vectors and of their products, the network's inputs."""

    @wp.func
    def pair_index(a: int, b: int, first: int, count: int):
        """Return the index of (a, b) among pairs of `count` vectors; `first` 1: without (a, a)."""
        return a * (count - first) - a * (a - 1) / 2 + b - a - first

    @in_ranges(ELEMENTS)
    @wp.kernel(module=module)
    def mix_vectors(
        range_start: int,
        scalars: int,
        rows: wp.array2d[scalar],
        mixing: wp.array2d[scalar],
        # outputs
        mixed: wp.array2d[vector],
    ):
        """Write the mixed vectors of each row: its perceived vectors times the mixing weights."""
        t = range_start + wp.tid()
        count = mixing.shape[1]
        row = t / count
        a = t - row * count
        total = vector()
        for i in range(mixing.shape[0]):
            weight = mixing[i, a]
            for d in range(wp.static(space_dim)):
                total[d] += weight * rows[row, scalars + i * wp.static(space_dim) + d]
        mixed[row, a] = total

    @in_ranges(ELEMENTS)
    @wp.kernel(module=module)
    def write_inputs(
        range_start: int,
        scalars: int,
        one: int,
        chiral: int,
        rows: wp.array2d[scalar],
        mixed: wp.array2d[vector],
        # outputs
        inputs: wp.array2d[scalar],
    ):
        """Write the network's inputs: scalars, products of mixed vectors, the constant, zeros.

        `one` is the column of the constant 1 in `rows`.
        """
        # A thread writes the pairs that end with its vector, and some scalars: adjacent threads
        # write adjacent entries.
        t = range_start + wp.tid()
        count = mixed.shape[1]
        row = t / count
        b = t - row * count
        u = mixed[row, b]
        for column in range(b, scalars, count):
            inputs[row, column] = rows[row, column]
        end = scalars + count * (count + 1) / 2
        for a in range(b + 1):
            other = mixed[row, a]
            inputs[row, scalars + pair_index(a, b, 0, count)] = wp.dot(other, u)
            if chiral != 0 and a < b:
                inputs[row, end + pair_index(a, b, 1, count)] = wp.dot(turned(other), u)
        if chiral != 0:
            end += count * (count - 1) / 2
        if b == 0:
            inputs[row, end] = rows[row, one]
            for column in range(end + 1, inputs.shape[1]):
                inputs[row, column] = scalar(0.0)

    @in_ranges(ELEMENTS)
    @wp.kernel(module=module)
    def pull_back_products(
        range_start: int,
        scalars: int,
        chiral: int,
        mixed: wp.array2d[vector],
        inputs_bar: wp.array2d[scalar],
        mixed_bar: wp.array2d[vector],
        # outputs
        whole_bar: wp.array2d[vector],
    ):
        """Write dL/d(mixed vectors): `mixed_bar` plus the part through the products."""
        t = range_start + wp.tid()
        count = mixed.shape[1]
        row = t / count
        a = t - row * count
        crosses = scalars + count * (count + 1) / 2
        total = mixed_bar[row, a]
        for b in range(count):
            other = mixed[row, b]
            bar = inputs_bar[row, scalars + pair_index(wp.min(a, b), wp.max(a, b), 0, count)]
            if a == b:
                bar += bar
            total += bar * other
            if chiral != 0 and a != b:
                cross = crosses + pair_index(wp.min(a, b), wp.max(a, b), 1, count)
                bar = inputs_bar[row, cross]
                if a < b:
                    bar = -bar
                total += bar * turned(other)
        whole_bar[row, a] = total

    @in_ranges(ELEMENTS)
    @wp.kernel(module=module)
    def pull_back_rows(
        range_start: int,
        scalars: int,
        mixing: wp.array2d[scalar],
        inputs_bar: wp.array2d[scalar],
        mixed_bar: wp.array2d[vector],
        # outputs
        rows_bar: wp.array2d[scalar],
    ):
        """Write dL/d(rows of perception), 0 for the constant 1 and the padding."""
        # A thread writes a perceived vector, and some scalars.
        t = range_start + wp.tid()
        count = mixing.shape[0]
        row = t / count
        i = t - row * count
        for column in range(i, scalars, count):
            rows_bar[row, column] = inputs_bar[row, column]
        total = vector()
        for a in range(mixing.shape[1]):
            total += mixing[i, a] * mixed_bar[row, a]
        for d in range(wp.static(space_dim)):
            rows_bar[row, scalars + i * wp.static(space_dim) + d] = total[d]
        if i == 0:
            for column in range(scalars + count * wp.static(space_dim), rows_bar.shape[1]):
                rows_bar[row, column] = scalar(0.0)

    return namespace(locals())


def steering_kernels(
    space_dim: int, scalar: type, vector: type, turned: wp.Function, module: wp.Module
) -> SimpleNamespace:
    """Return the kernel that turns gates into displacements, and its backward kernel."""

    @in_ranges(ELEMENTS)
    @wp.kernel(module=module)
    def steer(
        range_start: int,
        gate_count: int,
        output: wp.array2d[scalar],
        mixed: wp.array2d[vector],
        signs: wp.array[scalar],
        # outputs
        update: wp.array2d[scalar],
    ):
        """Write updates: displacements, sums of mixed vectors times gates; state changes; zeros."""
        t = range_start + wp.tid()
        # Directions come first, so that adjacent threads take the same branch.
        directions = update.shape[0] * wp.static(space_dim)
        turning = t < directions
        span = update.shape[1] - wp.static(space_dim)
        if turning:
            span = wp.int32(wp.static(space_dim))
        else:
            t -= directions
        row = t / span
        column = t - row * span
        count = mixed.shape[1]
        value = scalar(0.0)
        if turning:
            for g in range(gate_count):
                gate = wp.max(output[row, g], scalar(0.0)) * signs[g]
                if g < count:
                    value += gate * mixed[row, g][column]
                else:
                    value += gate * turned(mixed[row, g - count])[column]
        else:
            if gate_count + column < output.shape[1]:
                value = output[row, gate_count + column]
            column += wp.static(space_dim)
        update[row, column] = value

    @in_ranges(ELEMENTS)
    @wp.kernel(module=module)
    def pull_back_steering(
        range_start: int,
        gate_count: int,
        output: wp.array2d[scalar],
        mixed: wp.array2d[vector],
        signs: wp.array[scalar],
        update_bar: wp.array2d[scalar],
        # outputs
        output_bar: wp.array2d[scalar],
        mixed_bar: wp.array2d[vector],
    ):
        """Write dL/d(output) and dL/d(mixed vectors) from `update_bar` = dL/d(update)."""
        t = range_start + wp.tid()
        width = output.shape[1]
        row = t / width
        column = t - row * width
        count = mixed.shape[1]
        value = scalar(0.0)
        if column < gate_count:
            displacement_bar = vector()
            for d in range(wp.static(space_dim)):
                displacement_bar[d] = update_bar[row, d]
            gate = output[row, column]
            u = mixed[row, column % count]
            if column >= count:
                u = turned(u)
            if gate > scalar(0.0):
                value = signs[column] * wp.dot(u, displacement_bar)
            if column < count:
                total = wp.max(gate, scalar(0.0)) * signs[column] * displacement_bar
                if gate_count > count:
                    other = wp.max(output[row, count + column], scalar(0.0))
                    total -= other * signs[count + column] * turned(displacement_bar)
                mixed_bar[row, column] = total
        else:
            update_column = column - gate_count + wp.static(space_dim)
            if update_column < update_bar.shape[1]:
                value = update_bar[row, update_column]
        output_bar[row, column] = value

    return namespace(locals())
