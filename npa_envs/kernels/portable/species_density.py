"""Density and density gradient of each species at every particle.

One thread runs through a particle's neighbourhood once, for all species. Sums run over sorted
particles, one run of cells after the other, in float64: gradients cancel almost fully where
particles are dense.

Sources: kernels of arXiv 2601.16096, section 3, summed over the particles of one species.
"""

import warp as wp

from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.mathematics import log_scaled, smoothing, spiky_factor
from npa_envs.kernels.native_functions import PAIRS, in_ranges
from npa_envs.thread_lock import cached_under_lock


@cached_under_lock()
def species_kernel(space_dim: int, scalar: type, species_count: int) -> wp.Kernel:
    """Return the kernel of one variant."""
    space = domain_types(space_dim, scalar)
    vector, Domain = space.vector, space.Domain
    vector_f64 = wp.types.vector(space_dim, wp.float64)
    densities_type = wp.types.vector(species_count, wp.float64)
    gradients_type = wp.types.matrix((species_count, space_dim), wp.float64)
    module = kernel_module(f"species_{species_count}", space_dim, scalar)

    @in_ranges(PAIRS)
    @wp.kernel(enable_backward=False, module=module)
    def gather_species(
        range_start: int,
        domain: Domain,
        particle_count: int,
        density_scale: wp.float64,
        gradient_scale: wp.float64,
        logarithmic: int,
        starts: wp.array[wp.int32],
        source: wp.array[wp.int32],
        sorted_species: wp.array[wp.int32],
        sorted_positions: wp.array[vector],
        # outputs
        density: wp.array2d[scalar],
        gradient: wp.array3d[scalar],
    ):
        """Write each particle's scaled densities and density gradients, in the caller's order."""
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
                    own = sorted_species[j]
                    weight = smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
                    densities[own] += wp.float64(weight)
                    away = vector_f64()
                    for d in range(wp.static(space_dim)):
                        away[d] = wp.float64(neighbour[d]) - wp.float64(position[d])
                        if domain.periodic != 0:
                            images = wp.round((neighbour[d] - position[d]) * domain.inverse_box[d])
                            away[d] -= wp.float64(images) * wp.float64(domain.box[d])
                    factor = spiky_factor(
                        wp.length(away),
                        wp.float64(domain.inverse_eps),
                        wp.float64(domain.spiky_norm),
                    )
                    for d in range(wp.static(space_dim)):
                        gradients[own, d] += factor * away[d]
        # A particle always counts itself.
        densities[sorted_species[k]] += wp.float64(domain.smoothing_norm)
        i = source[k]
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
