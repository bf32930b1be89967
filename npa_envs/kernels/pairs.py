"""Pairs of particles that never move: found and weighed once, then summed over in every step.

Centre i has an entry for each neighbour j, itself included: v_j W_ij, v_j K_ij and where j is in
the sorted order. A list that has no room for all neighbours is marked: its particle searches for
them, and weighs them again.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import (
    MOMENT_THRESHOLD,
    domain_types,
    kernel_module,
    log_scaled,
    scalar_name,
    smoothing,
    spiky_factor,
)
from npa_envs.kernels.moments import make_smooth_inverse
from npa_envs.kernels.ranges import PAIRS, in_ranges
from npa_envs.kernels.sifting import make_sift
from npa_envs.kernels.wide import make_wide_store

ENTRY_SIZE = 4
"""Numbers of an entry: weights of values and of differences along each axis, in 2D a place."""

SEARCHED = -1
"""Length of a list that has no room for all neighbours."""

_PACK = "union {{ {part} word; int number; }} both; both.word = 0; {do}"


@functools.cache
def packing(scalar: type) -> SimpleNamespace:
    """Return Warp functions that put an integer's bits into a scalar, and that read them there."""
    part = {"f32": "float", "f64": "double"}[scalar_name(scalar)]
    pack = _PACK.format(part=part, do="both.number = number; return both.word;")
    unpack = _PACK.format(part=part, do="both.word = word; return both.number;")

    @wp.func_native(pack)
    def packed(number: wp.int32) -> scalar: ...

    @wp.func_native(unpack)
    def unpacked(word: scalar) -> wp.int32: ...

    return SimpleNamespace(packed=packed, unpacked=unpacked)


@functools.cache
def make_weigh(space_dim: int, scalar: type) -> wp.Function:
    """Return a Warp function that weighs a pair, just as `perception` does."""
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain

    @wp.func
    def weigh(domain: Domain, offset: vector, volume: scalar):
        """Return v W and v K of a neighbour within eps, at an offset from the centre."""
        squared = wp.dot(offset, offset)
        weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
        kernel = offset * spiky_factor(wp.sqrt(squared), domain.inverse_eps, domain.spiky_norm)
        return volume * weight, volume * kernel

    return weigh


@functools.cache
def pair_kernels(
    space_dim: int, scalar: type, lanes: int, ahead: int, moment_inverse: str | None
) -> SimpleNamespace:
    """Return the kernels that make lists.

    Args:
        space_dim: Space dimension D.
        scalar: `wp.float32` or `wp.float64`.
        lanes: 1 on the CPU, more on CUDA.
        ahead: Lists are filled up to a multiple of this many entries.
        moment_inverse: How to invert moment matrices; None: not at all.
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
    square = wp.types.matrix((space_dim, space_dim), scalar)
    entry_type = wp.types.vector(ENTRY_SIZE, scalar)
    flat = space_dim == 2
    sift, stride = make_sift(space_dim, scalar, particle, lanes)
    # Here every particle has one thread, which takes all sifts.
    stride //= lanes
    weigh = make_weigh(space_dim, scalar)
    packed = packing(scalar).packed
    store_entry = make_wide_store(entry_type, scalar)
    smooth_inverse = make_smooth_inverse(space_dim, scalar)
    topic = "pairs" if moment_correction else "uncorrected_pairs"
    topic = "smoothly_corrected_pairs" if smooth else topic
    module = kernel_module(f"{topic}_{ahead}", space_dim, scalar, 0, lanes)

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def count_pairs(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        # outputs
        lengths: wp.array(dtype=wp.int32),
    ):
        """Write how many entries the list of each particle shall have."""
        k = range_start + wp.tid()
        position = position_of(particles[k])
        base = (k / particle_count) * domain.cell_count
        cell = cell_of(domain, position)
        length = wp.int32(0)
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            end = starts[base + last]
            for begin in range(starts[base + first], end, wp.static(stride)):
                _near, count = sift(domain, particles, position, begin, end)
                length += count
        lengths[k] = (length + wp.static(ahead - 1)) / wp.static(ahead) * wp.static(ahead)

    @wp.func
    def put(
        weights: wp.array(dtype=entry_type),
        neighbours: wp.array(dtype=wp.int32),
        place: wp.int32,
        weight: scalar,
        weighted: vector,
        j: wp.int32,
    ):
        entry = entry_type()
        entry[0] = weight
        for d in range(wp.static(space_dim)):
            entry[d + 1] = weighted[d]
        if wp.static(flat):
            entry[3] = packed(j)
        else:
            neighbours[place] = j
        store_entry(weights, place, entry)

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def list_pairs(
        range_start: wp.int32,
        domain: Domain,
        particle_count: wp.int32,
        capacity: wp.int32,
        density_gradient: wp.int32,
        density_scale: wp.float64,
        starts: wp.array(dtype=wp.int32),
        particles: wp.array(dtype=particle),
        gradients: wp.array(dtype=wide),
        ends: wp.array(dtype=wp.int32),
        # outputs
        weights: wp.array(dtype=entry_type),
        neighbours: wp.array(dtype=wp.int32),
        lengths: wp.array(dtype=wp.int32),
        kernel_sum: wp.array(dtype=vector),
        correction: wp.array(dtype=square),
        density_columns: wp.array(dtype=vector),
    ):
        """Write the list of each particle, and whatever else of it stays as it is.

        Lists have room for `capacity` entries each, or end where `ends` says unless it is empty.
        """
        k = range_start + wp.tid()
        position = position_of(particles[k])
        base = (k / particle_count) * domain.cell_count
        cell = cell_of(domain, position)
        first_place = k * capacity
        room = capacity
        if ends.shape[0] > 0:
            first_place = wp.int32(0)
            if k > 0:
                first_place = ends[k - 1]
            room = ends[k] - first_place
        length = wp.int32(0)
        total = vector()
        moment = square()
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            end = starts[base + last]
            for begin in range(starts[base + first], end, wp.static(stride)):
                near, count = sift(domain, particles, position, begin, end)
                for n in range(count):
                    j = near[n]
                    entry = particles[j]
                    offset = minimum_image(domain, position_of(entry) - position)
                    weight, weighted = weigh(domain, offset, entry[wp.static(space_dim)])
                    total += weighted
                    if wp.static(moment_correction):
                        moment += wp.outer(offset, weighted)
                    if length < room:
                        put(weights, neighbours, first_place + length, weight, weighted, j)
                    length += 1
        if length <= room:
            while length % wp.static(ahead) != 0:
                put(weights, neighbours, first_place + length, scalar(0.0), vector(), k)
                length += 1
        else:
            length = wp.int32(wp.static(SEARCHED))
        lengths[k] = length
        kernel_sum[k] = total
        if wp.static(moment_correction):
            inverse = square()
            if wp.static(smooth):
                inverse = smooth_inverse(moment)
            elif wp.abs(wp.determinant(moment)) >= scalar(wp.static(MOMENT_THRESHOLD)):
                inverse = wp.inverse(moment)
            else:
                for d in range(wp.static(space_dim)):
                    inverse[d, d] = scalar(1.0)
            correction[k] = inverse
        if density_gradient != 0:
            scaled = density_scale * gradients[k]
            scaled = log_scaled(scaled)
            columns = vector()
            for d in range(wp.static(space_dim)):
                columns[d] = scalar(scaled[d])
            density_columns[k] = columns

    return SimpleNamespace(count_pairs=count_pairs, list_pairs=list_pairs)
