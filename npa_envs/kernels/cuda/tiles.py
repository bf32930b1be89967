"""Density and lists of neighbours in 2D on CUDA: a warp for eight particles side by side, a tile.

A tile's particles lie in one line of cells or two, so most of their candidates are the same. The
warp brings these into fast memory once. Four lanes of a particle then test every fourth of them: a
test takes ten instructions, no address is computed, and no end of a run of cells looked at. Whom a
lane has found near stands in the bits of a word, of which lists are made afterwards. It takes half
the time where neighbours are many and particles few. In sparse worlds tiles share few candidates,
and in worlds that fill a device a thread for each particle does as well. Worlds have at most 2^15
particles: steps of lists have 16 bits.
"""

import warp as wp

from npa_envs.kernels import native
from npa_envs.kernels.access import (
    WARP,
    as_word,
    await_earlier,
    load_integer,
    make_wide_load,
    thread_number,
)
from npa_envs.kernels.cuda.density import RECORD, store_record
from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.once import made_once

TILE = 8
"""Particles of a tile."""

TILE_LANES = WARP // TILE
"""Lanes of a warp that share a particle."""

SMALLEST_SIDE = 7
"""Cells along each side of the smallest periodic box: in smaller ones the images of a particle that
are nearest to its tile's particles may differ."""

CUDA_REGISTERS = 64
"""Registers of a thread: 32 warps of a processor."""


@made_once()
def tiled_density(periodic: bool, capacity: int, masked: bool) -> wp.Kernel:
    """Return the density kernel of one variant. A block is a warp, and serves a tile.

    Args:
        capacity: Neighbours that a list has room for.
        masked: Whether only some particles have rows, and lists.
    """
    types = domain_types(2, wp.float32)
    vector, particle, Domain = types.vector, types.particle, types.Domain
    load_vector = make_wide_load(vector, wp.float32)

    @native.func_native(capacity, periodic, TILE, SMALLEST_SIDE)
    def density_of_tile(
        domain: Domain,
        starts: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        base: wp.int32,
        first: wp.int32,
        k: wp.int32,
        inside: wp.bool,
        row: wp.int32,
        lists: wp.array(dtype=wp.int16, ndim=3),
        list_lengths: wp.array(dtype=wp.int32),
    ) -> wp.float32: ...

    topic = "tiled_density" + "_in_box" * periodic + f"_{capacity}" + "_of_rows" * masked

    @wp.kernel(
        enable_backward=False,
        module=kernel_module(topic, 2, wp.float32),
        cuda_max_registers=CUDA_REGISTERS,
        grid_stride=False,
    )
    def compute_density(
        domain: Domain,
        particle_count: wp.int32,
        starts: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
        state_place: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.int32),
        row_of: wp.array(dtype=wp.int32),
        # outputs
        particles: wp.array(dtype=particle),
        records: wp.array(dtype=RECORD),
        lists: wp.array(dtype=wp.int16, ndim=3),
        list_lengths: wp.array(dtype=wp.int32),
    ):
        """Write what `listed_density` writes, but each list as a whole, one behind the other."""
        await_earlier()
        thread = thread_number()
        tile = thread >> wp.static(WARP.bit_length() - 1)
        lane = thread & wp.static(WARP - 1)
        tiles = (particle_count + wp.static(TILE - 1)) / wp.static(TILE)
        world = wp.int32(wp.uint32(tile) / wp.uint32(tiles))
        # Tiles begin anew in each world: its sums are the same in every batch.
        first = world * particle_count + (tile - world * tiles) * wp.static(TILE)
        k = first + lane / wp.static(TILE_LANES)
        inside = k < (world + 1) * particle_count
        k = wp.where(inside, k, first)
        row = k
        if wp.static(masked):
            row = load_integer(row_of, load_integer(source, k))
        row = wp.where(inside and row < list_lengths.shape[0], row, wp.int32(-1))
        total = density_of_tile(
            domain,
            starts,
            sorted_cell,
            sorted_positions,
            world * domain.cell_count,
            first,
            k,
            inside,
            row,
            lists,
            list_lengths,
        )
        if inside and lane % wp.static(TILE_LANES) == 0:
            position = load_vector(sorted_positions, k)
            # A particle always sees itself: a position that is not finite would have rho 0.
            volume = 1.0 / (domain.smoothing_norm * wp.max(total, 1.0))
            if particles.shape[0] > 0:
                particles[k] = particle(position[0], position[1], volume)
            number = k
            if state_place.shape[0] > 0:
                number = load_integer(state_place, k)
            record = RECORD(position[0], position[1], volume, as_word(number))
            store_record(records, k, record)

    return compute_density
