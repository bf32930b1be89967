"""Density, volumes, density gradients and neighbour lists of sorted particles; fields of species.

Sums run over sorted particles, one contiguous run of cells after the other.

Source: arXiv 2601.16096, section 3. Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels.domain import TERMS_PER_SUM, domain_types, kernel_module
from npa_envs.kernels.lanes_and_memory import make_wide_load
from npa_envs.kernels.mathematics import log_scaled, smoothing, spiky_factor, spiky_factor_f64
from npa_envs.kernels.native_functions import PAIRS, in_ranges, namespace
from npa_envs.kernels.portable.search import lowest_bit, make_search


@cached_under_lock()
def density_kernels(space_dim: int, scalar: type, on_cpu: bool) -> SimpleNamespace:
    """Return the kernels of densities by name."""
    space = domain_types(space_dim, scalar)
    vector, particle, Domain = space.vector, space.particle, space.Domain
    vector_f64 = space.vector_f64
    at_positions = make_search(space_dim, scalar, vector, on_cpu)
    search = make_search(space_dim, scalar, particle, on_cpu)
    block, room, together, numbers = search.block, search.room, search.together, search.numbers
    vectors_f64 = wp.types.matrix((space_dim, block), wp.float64)
    load_scalar, load_index = make_wide_load(scalar), make_wide_load(wp.int32)
    module = kernel_module("density", space_dim, scalar, on_cpu=on_cpu)

    @wp.func
    def spiky_f64(domain: Domain, centre: vector, neighbour: vector):
        """Return the spiky gradient kernel K of a pair in float64 [1 / length^(D+1)]."""
        r = space.difference_f64(domain, centre, neighbour)
        exact = wp.dot(r, r)
        # The start must be near this very distance: across a seam that of the float32 positions
        # may be off by a rounding of the box's size.
        rounded = scalar(exact)
        start = scalar(1.0) / wp.sqrt(rounded)
        factor = spiky_factor_f64(exact, start, domain.inverse_eps, domain.spiky_norm)
        return wp.where(rounded > scalar(0.0), factor, wp.float64(0.0)) * r

    @in_ranges(PAIRS // together)
    @wp.kernel(module=module)
    def compute_density(
        range_start: int,
        domain: Domain,
        particle_count: int,
        density_gradient: int,
        starts: wp.array[wp.int32],
        original_index: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        # outputs
        particles: wp.array[particle],
        density_gradients: wp.array[vector_f64],
    ):
        """Write each particle's position and volume 1 / rho, and density gradients of active ones.

        The density gradient cancels almost fully where particles are dense, and rules amplify its
        rounding error. So it stays in float64 up to its scaling, which costs little.
        """
        candidates = wp.zeros(shape=(wp.static(search.memory),), dtype=scalar)
        indices = wp.zeros(shape=(wp.static(room),), dtype=wp.int32)
        cursor = at_positions.Cursor()
        begin_k = (range_start + wp.tid()) * wp.static(together)
        end_k = wp.min(begin_k + wp.static(together), sorted_positions.shape[0])
        for k in range(begin_k, end_k):
            position = sorted_positions[k]
            row = wp.int32(-1)
            if density_gradient != 0:
                row = row_of[original_index[k]]
            base = (k / particle_count) * domain.cell_count
            density = scalar(0.0)
            earlier = scalar(0.0)
            counted = wp.int32(0)
            gradient = vector_f64()
            cursor = at_positions.restart(cursor)
            while cursor.more != 0:
                cursor = at_positions.collect(
                    domain, starts, starts, starts, starts, 0, 0, sorted_positions, base, position,
                    k, cursor, candidates, indices,
                )  # fmt: skip
                for first in range(0, cursor.count, wp.static(block)):
                    _, squared = at_positions.distances(domain, candidates, position, first)
                    weights = numbers()
                    c = wp.int32(0)
                    while c < wp.static(block):
                        is_self = load_index(indices, first + c) == k
                        squared[c] = wp.where(is_self, domain.squared_eps, squared[c])
                        weight = smoothing(
                            squared[c], domain.inverse_squared_eps, domain.smoothing_norm
                        )
                        is_near = squared[c] < domain.squared_eps
                        weights[c] = wp.where(is_near, weight, scalar(0.0))
                        c += 1
                    for c in range(wp.static(block)):
                        density += weights[c]
                    if row >= 0:
                        kernels = vectors_f64()
                        c = wp.int32(0)
                        while c < wp.static(block):
                            neighbour = vector()
                            for d in range(wp.static(space_dim)):
                                neighbour[d] = load_scalar(
                                    candidates, wp.static(d * room) + first + c
                                )
                            kernel = spiky_f64(domain, position, neighbour)
                            is_near = squared[c] < domain.squared_eps
                            for d in range(wp.static(space_dim)):
                                kernels[d, c] = wp.where(is_near, kernel[d], wp.float64(0.0))
                            c += 1
                        for c in range(wp.static(block)):
                            for d in range(wp.static(space_dim)):
                                gradient[d] += kernels[d, c]
                counted += cursor.count
                if counted >= wp.static(TERMS_PER_SUM):
                    earlier += density
                    density = scalar(0.0)
                    counted = wp.int32(0)
            # Its own term is added without a search, so that rho is not 0 for positions that are
            # NaN.
            entry = particle()
            for d in range(wp.static(space_dim)):
                entry[d] = position[d]
            entry[wp.static(space_dim)] = scalar(1.0) / (
                domain.smoothing_norm + (earlier + density)
            )
            particles[k] = entry
            if row >= 0:
                density_gradients[k] = gradient

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def list_neighbours(
        range_start: int,
        domain: Domain,
        particle_count: int,
        starts: wp.array[wp.int32],
        particles: wp.array[particle],
        ends: wp.array[wp.int32],
        # outputs
        counts: wp.array[wp.int32],
        neighbours: wp.array[wp.int32],
    ):
        """Write each particle's number of neighbours, itself included, and their sorted indices.

        No indices are written if `neighbours` is empty. Those of particle k end at `ends[k]`.
        """
        candidates = wp.zeros(shape=(wp.static(search.memory),), dtype=scalar)
        indices = wp.zeros(shape=(wp.static(room),), dtype=wp.int32)
        k = range_start + wp.tid()
        position = space.position_of(particles[k])
        base = (k / particle_count) * domain.cell_count
        begin_list = wp.int32(0)
        if k > 0 and neighbours.shape[0] > 0:
            begin_list = ends[k - 1]
        next_entry = begin_list
        cursor = search.restart(search.Cursor())
        while cursor.more != 0:
            cursor = search.collect(
                domain, starts, starts, starts, starts, 0, 0, particles, base, position, k, cursor,
                candidates, indices,
            )  # fmt: skip
            for first in range(0, cursor.count, wp.static(block)):
                _, squared = search.distances(domain, candidates, position, first)
                near = search.below(squared, domain.squared_eps)
                while near != wp.uint32(0):
                    if neighbours.shape[0] > 0:
                        neighbours[next_entry] = indices[first + lowest_bit(near)]
                    next_entry += 1
                    near = near & (near - wp.uint32(1))
        counts[k] = next_entry - begin_list

    return namespace(locals())


@cached_under_lock()
def species_kernel(space_dim: int, scalar: type, species_count: int) -> wp.Kernel:
    """Return the kernel of each species' density and density gradient at each particle.

    A thread runs through a particle's neighbourhood once, for all species. Sums are in float64:
    gradients cancel almost fully where particles are dense.
    """
    space = domain_types(space_dim, scalar)
    vector, vector_f64, Domain = space.vector, space.vector_f64, space.Domain
    densities_type = wp.types.vector(species_count, wp.float64)
    gradients_type = wp.types.matrix((species_count, space_dim), wp.float64)
    module = kernel_module("species", space_dim, scalar, species=species_count)

    @in_ranges(PAIRS)
    @wp.kernel(module=module)
    def gather_species(
        range_start: int,
        domain: Domain,
        particle_count: int,
        density_scale: wp.float64,
        gradient_scale: wp.float64,
        logarithmic: int,
        starts: wp.array[wp.int32],
        original_index: wp.array[wp.int32],
        sorted_species: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        # outputs
        density: wp.array2d[scalar],
        gradient: wp.array3d[scalar],
    ):
        """Write each species' scaled density and density gradient, in the caller's order."""
        k = wp.tid()
        k += range_start
        position = sorted_positions[k]
        base = (k / particle_count) * domain.cell_count
        cell = space.cell_of(domain, position)
        densities = densities_type()
        gradients = gradients_type()
        for segment in range(space.segment_count(domain, cell)):
            first, last = space.segment_cells(domain, cell, segment)
            for j in range(starts[base + first], starts[base + last]):
                neighbour = sorted_positions[j]
                offset = space.minimum_image(domain, neighbour - position)
                squared = wp.dot(offset, offset)
                if squared < domain.squared_eps and j != k:
                    species = sorted_species[j]
                    weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
                    densities[species] += wp.float64(weight)
                    away = space.difference_f64(domain, position, neighbour)
                    factor = spiky_factor(
                        wp.length(away),
                        wp.float64(domain.inverse_eps),
                        wp.float64(domain.spiky_norm),
                    )
                    for d in range(wp.static(space_dim)):
                        gradients[species, d] += factor * away[d]
        # A particle always counts itself.
        densities[sorted_species[k]] += wp.float64(domain.smoothing_norm)
        i = original_index[k]
        for q in range(wp.static(species_count)):
            density[i, q] = scalar(density_scale * densities[q])
            sum = vector_f64()
            for d in range(wp.static(space_dim)):
                sum[d] = gradient_scale * gradients[q, d]
            if logarithmic != 0:
                sum = log_scaled(sum)
            for d in range(wp.static(space_dim)):
                gradient[i, q, d] = scalar(sum[d])

    return gather_species
