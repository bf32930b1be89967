"""Pictures of 2D worlds: every particle is a small Gaussian.

The picture gathers over particles for each pixel, its adjoint over pixels for each particle.

A particle at pixel p covers the patch of pixels q with |q - round(p)| <= r in both directions; its
weights exp(-|q - p|^2 / 2 sigma^2) are normalised to sum 1 over the patch, be it inside the picture
or not.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.domain import domain_types, kernel_module

CHANNELS = 4
"""Red, green, blue and density."""


@functools.cache
def splat_kernels(scalar: type) -> SimpleNamespace:
    """Return the kernels of one scalar type."""
    types = domain_types(2, scalar)
    vector, Domain = types.vector, types.Domain
    cell_of, segment_count, segment_cells = (
        types.cell_of,
        types.segment_count,
        types.segment_cells,
    )
    colour_type = wp.types.vector(CHANNELS, scalar)
    footprint_type = wp.types.vector(3, scalar)
    module = kernel_module("splat", 2, scalar)

    @wp.func
    def patch_centre(place: vector):
        """Nearest pixel of a place in pixels, clamped so that it converts to an integer."""
        limit = scalar(1.0e6)
        return vector(
            wp.clamp(wp.floor(place[0] + scalar(0.5)), -limit, limit),
            wp.clamp(wp.floor(place[1] + scalar(0.5)), -limit, limit),
        )

    @wp.func
    def patch_weight(away: vector, near: vector, falloff: scalar):
        """Gaussian relative to the patch's nearest pixel, so that narrow ones do not vanish."""
        return wp.exp(falloff * (wp.dot(near, near) - wp.dot(away, away)))

    @wp.kernel(enable_backward=False, module=module)
    def prepare_splats(
        sorted_positions: wp.array(dtype=vector),
        low: scalar,
        pixels_per_length: scalar,
        falloff: scalar,
        radius: wp.int32,
        area: scalar,
        # outputs
        footprints: wp.array(dtype=footprint_type),
    ):
        """Write each particle's place in pixels and its weight's factor: area over patch sum."""
        k = wp.tid()
        position = sorted_positions[k]
        place = vector(
            (position[0] - low) * pixels_per_length, (position[1] - low) * pixels_per_length
        )
        centre = patch_centre(place)
        sums = vector()
        for o in range(-radius, radius + 1):
            for d in range(2):
                near = centre[d] - place[d]
                away = near + scalar(o)
                sums[d] += wp.exp(falloff * (near * near - away * away))
        footprints[k] = footprint_type(place[0], place[1], area / (sums[0] * sums[1]))

    @wp.kernel(enable_backward=False, module=module)
    def gather_splats(
        domain: Domain,
        low: scalar,
        pixel_length: scalar,
        falloff: scalar,
        radius: wp.int32,
        starts: wp.array(dtype=wp.int32),
        footprints: wp.array(dtype=footprint_type),
        colours: wp.array(dtype=colour_type),
        # outputs
        picture: wp.array(dtype=colour_type, ndim=3),
    ):
        """Write each pixel: the weighted sum over the particles whose patch covers it."""
        world, row, column = wp.tid()
        x = scalar(column)
        y = scalar(row)
        reach = scalar(radius) + scalar(0.5)
        total = colour_type()
        base = world * domain.cell_count
        cell = cell_of(domain, vector(low + x * pixel_length, low + y * pixel_length))
        for segment in range(segment_count(domain, cell)):
            first, last = segment_cells(domain, cell, segment)
            for j in range(starts[base + first], starts[base + last]):
                footprint = footprints[j]
                place = vector(footprint[0], footprint[1])
                centre = patch_centre(place)
                if wp.abs(centre[0] - x) < reach and wp.abs(centre[1] - y) < reach:
                    away = vector(x - place[0], y - place[1])
                    weight = footprint[2] * patch_weight(away, centre - place, falloff)
                    total += weight * colours[j]
        picture[world, row, column] = total

    @wp.kernel(enable_backward=False, module=module)
    def pull_back_splats(
        particle_count: wp.int32,
        resolution: wp.int32,
        pixels_per_length: scalar,
        falloff: scalar,
        radius: wp.int32,
        footprints: wp.array(dtype=footprint_type),
        colours: wp.array(dtype=colour_type),
        source: wp.array(dtype=wp.int32),
        picture_bar: wp.array(dtype=colour_type, ndim=3),
        # outputs
        positions_bar: wp.array(dtype=vector),
        colours_bar: wp.array(dtype=colour_type),
    ):
        """Write the cotangents of each particle's position and colour from its patch."""
        k = wp.tid()
        world = k / particle_count
        footprint = footprints[k]
        place = vector(footprint[0], footprint[1])
        centre = patch_centre(place)
        colour = colours[k]
        colour_bar = colour_type()
        pull = vector()
        patch_sum = scalar(0.0)
        patch_pull = vector()
        for row_offset in range(-radius, radius + 1):
            for column_offset in range(-radius, radius + 1):
                away = vector(
                    centre[0] + scalar(column_offset) - place[0],
                    centre[1] + scalar(row_offset) - place[1],
                )
                weight = footprint[2] * patch_weight(away, centre - place, falloff)
                patch_sum += weight
                patch_pull += weight * away
                row = wp.int32(centre[1]) + row_offset
                column = wp.int32(centre[0]) + column_offset
                inside = row >= 0 and row < resolution and column >= 0 and column < resolution
                if inside:
                    bar = picture_bar[world, row, column]
                    colour_bar += weight * bar
                    pull += (weight * wp.dot(bar, colour)) * away
        # The normalisation keeps the patch's sum: its derivative subtracts the patch's mean pull.
        pull -= (wp.dot(colour_bar, colour) / patch_sum) * patch_pull
        i = source[k]
        positions_bar[i] = (scalar(2.0) * falloff * pixels_per_length) * pull
        colours_bar[i] = colour_bar

    return SimpleNamespace(
        prepare_splats=prepare_splats,
        gather_splats=gather_splats,
        pull_back_splats=pull_back_splats,
    )
