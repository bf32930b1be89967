"""Density, volumes, density gradients and neighbour lists of sorted particles; fields of species.

Sums run over sorted particles, one contiguous run of cells after the other.

Source: arXiv 2601.16096, section 3. Arguments: see `kernels/portable/__init__.py`.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels.domain import TERMS_PER_SUM, domain_types, kernel_module
from npa_envs.kernels.mathematics import log_scaled, smoothing, spiky_factor, spiky_factor_f64
from npa_envs.kernels.native_functions import PAIRS, in_ranges, namespace
from npa_envs.kernels.portable.search import make_search


@cached_under_lock()
def density_kernels(space_dim: int, scalar: type, on_cpu: bool) -> SimpleNamespace:
    """Return the kernels `compute_density` and `list_neighbours`, with one thread per particle."""
    space = domain_types(space_dim, scalar)
    vector, particle, Domain = space.vector, space.particle, space.Domain
    vector_f64, search = space.vector_f64, make_search(space_dim, scalar, particle, on_cpu)
    module = kernel_module("density", space_dim, scalar, on_cpu=on_cpu)

    @wp.func
    def spiky_f64(domain: Domain, centre: vector, neighbour: vector):
        """Return the spiky gradient kernel K of a pair in float64 [1 / length^(D+1)]."""
        kernel = vector_f64()
        r = space.difference_f64(domain, centre, neighbour)
        exact = wp.dot(r, r)
        # The start must be near this very distance: across a seam that of the float32 positions
        # may be off by a rounding of the box's size.
        rounded = scalar(exact)
        if rounded > scalar(0.0):
            start = scalar(1.0) / wp.sqrt(rounded)
            kernel = spiky_factor_f64(exact, start, domain.inverse_eps, domain.spiky_norm) * r
        return kernel

    @in_ranges(PAIRS)
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
        k = range_start + wp.tid()
        position = sorted_positions[k]
        row = wp.int32(-1)
        if density_gradient != 0:
            row = row_of[original_index[k]]
        base = (k / particle_count) * domain.cell_count
        cell = space.cell_of(domain, position)
        density = scalar(0.0)
        earlier = scalar(0.0)
        counted = wp.int32(0)
        gradient = vector_f64()
        for segment in range(space.segment_count(domain, cell)):
            first, last = space.segment_cells(domain, cell, segment)
            end = starts[base + last]
            for block in range(starts[base + first], end, wp.static(TERMS_PER_SUM)):
                stop = wp.min(block + wp.static(TERMS_PER_SUM), end)
                for j in range(block, stop):
                    neighbour = sorted_positions[j]
                    offset = space.minimum_image(domain, neighbour - position)
                    squared = wp.dot(offset, offset)
                    is_near = squared < domain.squared_eps and j != k
                    weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
                    density += wp.where(is_near, weight, scalar(0.0))
                    if row >= 0 and is_near:
                        gradient += spiky_f64(domain, position, neighbour)
                counted += stop - block
                if counted >= wp.static(TERMS_PER_SUM):
                    earlier += density
                    density = scalar(0.0)
                    counted = wp.int32(0)
        # Its own term is added without a search, so that rho is not 0 for positions that are NaN.
        entry = particle()
        for d in range(wp.static(space_dim)):
            entry[d] = position[d]
        entry[wp.static(space_dim)] = scalar(1.0) / (domain.smoothing_norm + (earlier + density))
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
        k = range_start + wp.tid()
        position = space.position_of(particles[k])
        base = (k / particle_count) * domain.cell_count
        cell = space.cell_of(domain, position)
        begin = wp.int32(0)
        if k > 0 and neighbours.shape[0] > 0:
            begin = ends[k - 1]
        next_entry = begin
        for r in range(search.run_count(domain, cell)):
            first, end = search.run_range(domain, starts, ends, base, cell, k, r)
            for candidate in range(first, end, wp.static(search.stride)):
                near, count = search.filter_near(
                    domain, particles, neighbours, position, candidate, end
                )
                if neighbours.shape[0] > 0:
                    for n in range(count):
                        neighbours[next_entry + n] = near[n]
                next_entry += count
        counts[k] = next_entry - begin

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
