"""Density and the fused perception pass: what a particle sees of its neighbourhood.

One particle is served by a few lanes (one on the CPU), which split the candidates between them, for
each group of state channels. Sums run over sorted particles, run by run of cells, and lanes are
added in a fixed order.

Sources: arXiv 2601.16096, section 3 (density, smoothing, gradients, moment matrix, scaling).
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.access import make_lane_scatter, make_lane_sum, make_wide_load, share_type
from npa_envs.kernels.cpu import PAIRS, in_ranges, make_add_scaled, make_sift
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.mathematics import (
    log_scaled,
    make_corrected,
    smoothing,
    spiky_factor,
    spiky_factor_wide,
)

CUDA_REGISTERS = 128
"""Registers of a thread of the perception pass: more threads in flight are worth a few spills."""


@functools.cache
def perception_kernels(
    space_dim: int,
    scalar: type,
    width: int,
    lanes: int,
    state_gradient: bool,
    moment_inverse: str | None,
) -> SimpleNamespace:
    """Return the kernels of one variant: groups of `width` channels, `lanes` to a particle.

    A variant without `state_gradient`, or without a correction of it by a `moment_inverse`, neither
    sums nor holds what only that needs.
    """
    moment_correction = moment_inverse is not None
    smooth = moment_inverse == "smooth"
    types = domain_types(space_dim, scalar)
    vector, particle, Domain = types.vector, types.particle, types.Domain
    cell_of, segment_count, segment_cells = (
        types.cell_of,
        types.segment_count,
        types.segment_cells,
    )
    minimum_image, position_of = types.minimum_image, types.position_of
    wide = wp.types.vector(space_dim, wp.float64)
    group = wp.types.vector(width, scalar)
    group_gradient = wp.types.matrix((space_dim, width), scalar)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    share = width // lanes
    topic = "smoothing"
    if state_gradient:
        topic = "perception" if moment_correction else "uncorrected_perception"
        topic = "smoothly_corrected_perception" if smooth else topic
    module = kernel_module(topic, space_dim, scalar, width, lanes)
    sift, sift_stride = make_sift(space_dim, scalar, particle, lanes)
    add_scaled = make_add_scaled(group, scalar)
    load_group = make_wide_load(group, scalar)
    add_scalar = make_lane_sum(scalar, scalar, lanes)
    add_wide = make_lane_sum(wide, wp.float64, lanes)
    add_vector = make_lane_sum(vector, scalar, lanes)
    add_square = make_lane_sum(square, scalar, lanes)
    scatter_group = make_lane_scatter(group, scalar, lanes)
    scatter_gradient = make_lane_scatter(group_gradient, scalar, lanes)
    gradient_share = share_type(group_gradient, scalar, lanes)
    corrected = make_corrected(space_dim, scalar, share, moment_inverse)

    @wp.func
    def spiky_wide(domain: Domain, centre: vector, neighbour: vector):
        """Spiky gradient kernel of a pair in float64: a Newton step refines 1 / distance."""
        kernel = wide()
        r = wide()
        for d in range(wp.static(space_dim)):
            r[d] = wp.float64(neighbour[d]) - wp.float64(centre[d])
            if domain.periodic != 0:
                images = wp.round((neighbour[d] - centre[d]) * domain.inverse_box[d])
                r[d] -= wp.float64(images) * wp.float64(domain.box[d])
        exact = wp.dot(r, r)
        # The start must be near this very distance: across a seam that of the float32 positions
        # may be off by a rounding of the box's size.
        rounded = scalar(exact)
        if rounded > scalar(0.0):
            start = scalar(1.0) / wp.sqrt(rounded)
            kernel = spiky_factor_wide(exact, start, domain.inverse_eps, domain.spiky_norm) * r
        return kernel

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def compute_density(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        density_gradient: wp.int32,
        starts: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.int32),
        row_of: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        # outputs
        particles: wp.array(dtype=particle),
        row_density_gradient: wp.array(dtype=wide),
    ):
        """Write every particle's position and volume 1 / rho, and every row's density gradient.

        The density gradient cancels almost fully where particles are dense, and rules amplify its
        rounding error: it stays in float64 up to its scaling, which costs little.
        """
        k, lane = wp.tid()
        k += range_start
        position = sorted_positions[k]
        row = wp.int32(-1)
        if density_gradient != 0:
            row = row_of[source[k]]
        base = (k / particle_count) * domain.cell_count
        cell = cell_of(domain, position)
        density = scalar(0.0)
        gradient = wide()
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            for j in range(starts[base + first] + lane, starts[base + last], wp.static(lanes)):
                neighbour = sorted_positions[j]
                offset = minimum_image(domain, neighbour - position)
                squared = wp.dot(offset, offset)
                seen = squared < domain.squared_eps and j != k
                weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
                density += wp.where(seen, weight, scalar(0.0))
                if row >= 0 and seen:
                    gradient += spiky_wide(domain, position, neighbour)
        # A particle always sees itself: a position that is not finite would otherwise have rho 0.
        density = domain.smoothing_norm + add_scalar(density)
        gradient = add_wide(gradient)
        if lane == 0:
            entry = particle()
            for d in range(wp.static(space_dim)):
                entry[d] = position[d]
            entry[wp.static(space_dim)] = scalar(1.0) / density
            particles[k] = entry
            if row >= 0:
                row_density_gradient[row] = gradient

    @wp.func
    def sum_neighbours(
        domain: Domain,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        states: wp.array(dtype=group),
        world: wp.int32,
        g: wp.int32,
        group_count: wp.int32,
        lane: wp.int32,
        position: vector,
        own: group,
    ):
        """Return this lane's share of the smoothed state and of the state gradient, and the sums
        of v K and of the moment matrix."""
        blur = group()
        gradient = group_gradient()
        kernel_sum = vector()
        moment = square()
        base = world * domain.cell_count
        cell = cell_of(domain, position)
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            end = starts[base + last]
            for begin in range(starts[base + first] + lane, end, wp.static(sift_stride)):
                near, count = sift(domain, particles, position, begin, end)
                for n in range(count):
                    j = near[n]
                    entry = particles[j]
                    offset = minimum_image(domain, position_of(entry) - position)
                    squared = wp.dot(offset, offset)
                    volume = entry[wp.static(space_dim)]
                    state = load_group(states, j * group_count + g)
                    weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
                    blur = add_scaled(blur, volume * weight, state)
                    if wp.static(state_gradient):
                        kernel = offset * spiky_factor(
                            wp.sqrt(squared), domain.inverse_eps, domain.spiky_norm
                        )
                        weighted = volume * kernel
                        kernel_sum += weighted
                        for d in range(wp.static(space_dim)):
                            gradient[d] = add_scaled(gradient[d], weighted[d], state - own)
                        if wp.static(moment_correction):
                            moment += wp.outer(offset, weighted)
        gradients = gradient_share()
        if wp.static(state_gradient):
            gradients = scatter_gradient(gradient)
            kernel_sum = add_vector(kernel_sum)
            if wp.static(moment_correction):
                moment = add_square(moment)
        return scatter_group(blur), gradients, kernel_sum, moment

    @wp.func
    def clipped(value: scalar, limit: scalar):
        result = value
        if limit > scalar(0.0):
            result = wp.clamp(value, -limit, limit)
        return result

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module, cuda_max_registers=CUDA_REGISTERS)
    def perceive(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        state_dim: wp.int32,
        density_gradient: wp.int32,
        gradient_scale: scalar,
        density_scale: wp.float64,
        row_base: wp.int32,
        group_count: wp.int32,
        limit: scalar,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        states: wp.array(dtype=group),
        flat_states: wp.array(dtype=scalar, ndim=2),
        row_place: wp.array(dtype=wp.int32),
        row_destination: wp.array(dtype=wp.int32),
        row_density_gradient: wp.array(dtype=wide),
        # outputs
        perception: wp.array(dtype=scalar, ndim=2),
        row_kernel_sum: wp.array(dtype=vector),
    ):
        """Write the perception vector of each row, a one and zeros up to the row's width.

        Rows beyond the last active one are zero. Rows are written where `row_destination` says, or
        in their own order if it is empty; clipped to plus and minus `limit` unless that is zero.
        """
        row, g, lane = wp.tid()
        row += range_start
        if row >= starts[starts.shape[0] - 1] - row_base:
            for column in range(
                g * wp.static(lanes) + lane, perception.shape[1], group_count * wp.static(lanes)
            ):
                perception[row, column] = scalar(0.0)
            return
        k = row
        if row_place.shape[0] > 0:
            k = row_place[row]
        to = row
        if row_destination.shape[0] > 0:
            to = row_destination[row]
        blur, gradient, kernel_sum, moment = sum_neighbours(
            domain,
            starts,
            particles,
            states,
            k / particle_count,
            g,
            group_count,
            lane,
            position_of(particles[k]),
            load_group(states, k * group_count + g),
        )
        if wp.static(state_gradient and moment_correction):
            gradient = corrected(gradient, moment)
        mine = g * wp.static(width) + lane * wp.static(share)
        for c in range(wp.static(share)):
            channel = mine + c
            if channel < state_dim:
                perception[to, channel] = clipped(flat_states[k, channel], limit)
                perception[to, state_dim + channel] = clipped(blur[c], limit)
                if wp.static(state_gradient):
                    along = vector()
                    for d in range(wp.static(space_dim)):
                        along[d] = gradient_scale * gradient[d, c]
                    along = log_scaled(along)
                    place = 2 * state_dim + channel * wp.static(space_dim)
                    for d in range(wp.static(space_dim)):
                        perception[to, place + d] = clipped(along[d], limit)
        if g == 0 and lane == 0:
            if row_kernel_sum.shape[0] > 0:
                row_kernel_sum[row] = kernel_sum
            column = 2 * state_dim
            if wp.static(state_gradient):
                column += state_dim * wp.static(space_dim)
            if density_gradient != 0:
                scaled = density_scale * row_density_gradient[row]
                scaled = log_scaled(scaled)
                for d in range(wp.static(space_dim)):
                    perception[to, column + d] = clipped(scalar(scaled[d]), limit)
                column += wp.static(space_dim)
            for padding in range(column, perception.shape[1]):
                perception[to, padding] = wp.where(padding == column, scalar(1.0), scalar(0.0))

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def gather_fields(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        state_dim: wp.int32,
        group_count: wp.int32,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        states: wp.array(dtype=group),
        source: wp.array(dtype=wp.int32),
        # outputs
        density: wp.array(dtype=scalar),
        blur_field: wp.array(dtype=scalar, ndim=2),
        gradient_field: wp.array(dtype=scalar, ndim=3),
        moment_field: wp.array(dtype=square),
        corrected_field: wp.array(dtype=scalar, ndim=3),
    ):
        """Write the unscaled fields of every particle, in the caller's order."""
        k, g, lane = wp.tid()
        k += range_start
        i = source[k]
        entry = particles[k]
        blur, gradient, _kernel_sum, moment = sum_neighbours(
            domain,
            starts,
            particles,
            states,
            k / particle_count,
            g,
            group_count,
            lane,
            position_of(entry),
            load_group(states, k * group_count + g),
        )
        straight = corrected(gradient, moment)
        mine = g * wp.static(width) + lane * wp.static(share)
        for c in range(wp.static(share)):
            if mine + c < state_dim:
                blur_field[i, mine + c] = blur[c]
                for d in range(wp.static(space_dim)):
                    gradient_field[i, mine + c, d] = gradient[d, c]
                    corrected_field[i, mine + c, d] = straight[d, c]
        if g == 0 and lane == 0:
            density[i] = scalar(1.0) / entry[wp.static(space_dim)]
            moment_field[i] = moment

    return SimpleNamespace(
        compute_density=compute_density, perceive=perceive, gather_fields=gather_fields
    )
