"""How pictures of 2D worlds are divided: the `Lens` struct, its sizes and the types of splats."""

import functools
import math
from types import SimpleNamespace
from typing import Any

import warp as wp

CHANNELS = 4
"""Red, green, blue and density."""

TILE_WIDTH, TILE_HEIGHT = 4, 2
"""Pixels of a tile, which a few CUDA threads gather; also of a cell, which particles lie in."""

TILE_LANES = 4
"""CUDA threads that share a tile's candidates, and a particle's cotangents; one on the CPU."""

GROUP_WIDTH, GROUP_HEIGHT = 4, 2
"""Tiles of a group: with their lanes they make up a warp, which adds up its errors."""

FOOTPRINT = 8
"""Entries of a footprint: the way from its place to the patch's centre and that centre, in pixels
(2 each); red, green, blue and one, times the weights' common factor (4)."""

PATCH_SIGMAS = 3.0
"""A particle's patch reaches this many standard deviations from its centre."""


@functools.cache
def splat_types(scalar: type) -> SimpleNamespace:
    """Return the vector types and the `Lens` struct of one scalar type."""

    @wp.struct
    class Lens:
        resolution: wp.int32
        radius: wp.int32
        low: scalar
        pixels_per_length: scalar
        falloff: scalar
        area: scalar
        pull: scalar
        tile_columns: wp.int32
        tile_rows: wp.int32
        cell_columns: wp.int32
        cells_across: wp.int32
        cells_down: wp.int32
        cell_count: wp.int32

    return SimpleNamespace(
        Lens=Lens,
        vector=wp.types.vector(2, scalar),
        colour=wp.types.vector(CHANNELS, scalar),
        footprint=wp.types.vector(FOOTPRINT, scalar),
        columns=wp.types.vector(TILE_WIDTH, scalar),
        rows=wp.types.vector(TILE_HEIGHT, scalar),
        weights=wp.types.vector(TILE_WIDTH * TILE_HEIGHT, scalar),
        tile=wp.types.matrix((CHANNELS, TILE_WIDTH * TILE_HEIGHT), scalar),
        pulls=wp.types.vector(CHANNELS + 2, scalar),
    )


@functools.lru_cache(maxsize=256)
def make_lens(
    scalar: type, resolution: int, pixel_size: float, sigma: float, low: float, high: float
) -> Any:
    """Return the `Lens`: the sizes that follow from a picture's resolution, window and Gaussian.

    Args:
        scalar: `wp.float32` or `wp.float64`.
        resolution: Pixels R along each side.
        pixel_size: Side of a pixel of the target [length units].
        sigma: Standard deviation of the Gaussian in target pixels, dimensionless.
        low: Lower edge of the window in both directions [length units].
        high: Upper edge of the window in both directions [length units].
    """
    pixels = resolution * pixel_size / (high - low)
    lens = splat_types(scalar).Lens()
    lens.resolution = resolution
    lens.radius = radius = math.ceil(PATCH_SIGMAS * sigma * pixels)
    lens.low = low
    lens.pixels_per_length = (resolution - 1) / (high - low)
    # Of powers of two, which is what the hardware takes.
    lens.falloff = 0.5 / (sigma * pixels) ** 2 / math.log(2.0)
    lens.pull = lens.pixels_per_length / (sigma * pixels) ** 2
    lens.area = pixels * pixels
    lens.tile_columns = -(-resolution // TILE_WIDTH)
    lens.tile_rows = -(-resolution // TILE_HEIGHT)
    lens.cells_across = (TILE_WIDTH - 1 + 2 * radius) // TILE_WIDTH + 1
    lens.cell_columns = lens.tile_columns - 1 + lens.cells_across
    lens.cells_down = (TILE_HEIGHT - 1 + 2 * radius) // TILE_HEIGHT + 1
    # One more, for the particles that no pixel sees.
    lens.cell_count = lens.cell_columns * (lens.tile_rows - 1 + lens.cells_down) + 1
    return lens


def group_count(resolution: int) -> int:
    """Return how many groups of tiles cover a picture."""
    across = -(-resolution // (TILE_WIDTH * GROUP_WIDTH))
    return across * -(-resolution // (TILE_HEIGHT * GROUP_HEIGHT))
