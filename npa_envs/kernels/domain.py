"""The `Domain` struct: radius, box and cell grid that all worlds share, and functions on it.

Kernels are made by cached factories for one space dimension and one scalar type, so that the same
source serves 2D and 3D, float32 and float64, CPU and CUDA. Each (dimension, scalar, channel width)
is one Warp module: a scene compiles one or two small modules, never all of them.

Sources: design formulas of arXiv 2601.16096, section 3 and appendix.
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native

TERMS_PER_SUM = 4096
"""Terms that are summed before they are added to a total: of a million summed one after the other,
too much is rounded away."""

SLACK = 1.0 + 1e-5
"""Factor on eps² within which candidates are taken, against rounding errors of their distances."""

CELL_SLACK = 1.0 + 2.0**-20
"""Factor by which cells are larger than eps / n, so that rounding cannot lose a neighbour."""

FAR = 2.0**62
"""Largest distance of a cell from the origin; positions beyond it are in the outermost cell."""


def scalar_name(scalar: type) -> str:
    """Return the short name of a scalar type: "f32" or "f64"."""
    return {wp.float32: "f32", wp.float64: "f64"}[scalar]


@cached_under_lock()
def kernel_module(name: str, space_dim: int, scalar: type, **options: int) -> wp.Module:
    """Return the Warp module of kernels such as "sort"; each combination of options has one."""
    words = [name, f"{space_dim}d", scalar_name(scalar)]
    for option, value in options.items():
        if value is not False:
            words.append(option if value is True else f"{option}{value}")
    return native.module(f"npa_envs.kernels.{'_'.join(words)}")


@cached_under_lock()
def domain_types(space_dim: int, scalar: type) -> SimpleNamespace:
    """Return vector types, the `Domain` struct and its functions, for a dimension and scalar type.

    The struct has the constants of all worlds: radius, norms of kernels, box and cell grid.
    """
    vector = wp.types.vector(space_dim, scalar)
    cell_vector = wp.types.vector(space_dim, wp.int32)
    vector_f64 = wp.types.vector(space_dim, wp.float64)
    particle = wp.types.vector(space_dim + 1, scalar)

    @wp.struct
    class Domain:
        inverse_eps: scalar
        squared_eps: scalar
        inverse_squared_eps: scalar
        smoothing_norm: scalar
        spiky_norm: scalar
        periodic: int
        box: vector
        inverse_box: vector
        cell_scale: vector_f64
        cell_shape: cell_vector
        cell_count: int
        cells_per_eps: int

    @wp.func
    def cell_of(domain: Domain, position: vector):
        """Return the cell that contains a position; in open space the grid repeats periodically."""
        cell = cell_vector()
        for d in range(wp.static(space_dim)):
            count = domain.cell_shape[d]
            scaled = wp.float64(position[d]) * domain.cell_scale[d]
            # Comparisons are false for NaN, whose index must also be inside the grid.
            if domain.periodic != 0:
                scaled = wp.floor((scaled - wp.floor(scaled)) * wp.float64(count))
                if scaled < wp.float64(count):
                    cell[d] = wp.int32(scaled)
            elif wp.abs(scaled) < wp.float64(wp.static(FAR)):
                # The count is a power of two, and float64 divides slowly.
                cell[d] = wp.int32(wp.int64(wp.floor(scaled)) & wp.int64(count - 1))
        return cell

    @wp.func
    def cell_index(domain: Domain, cell: cell_vector):
        index = cell[wp.static(space_dim - 1)]
        for d in range(wp.static(space_dim - 1)):
            index = index * domain.cell_shape[wp.static(space_dim - 2) - d]
            index += cell[wp.static(space_dim - 2) - d]
        return index

    @wp.func
    def cell_at(domain: Domain, index: int):
        """Return the cell at an index in row-major order within its world."""
        cell = cell_vector()
        rest = index
        for d in range(wp.static(space_dim - 1)):
            above = wp.int32(wp.uint32(rest) / wp.uint32(domain.cell_shape[d]))
            cell[d] = rest - above * domain.cell_shape[d]
            rest = above
        cell[wp.static(space_dim - 1)] = rest
        return cell

    @wp.func
    def cells_around(domain: Domain, d: int):
        """Return the number of cells along dimension d that may hold neighbours of a particle."""
        return wp.min(wp.int32(2) * domain.cells_per_eps + 1, domain.cell_shape[d])

    @wp.func
    def wrapped(coordinate: int, count: int):
        """Return a cell coordinate that is at most one grid size outside, wrapped into the grid."""
        result = coordinate
        if coordinate < 0:
            result = coordinate + count
        if coordinate >= count:
            result = coordinate - count
        return result

    @wp.func
    def segment_count(domain: Domain, cell: cell_vector):
        """Return the number of runs of cells around a cell: 1 or, if it wraps, 2 for each line."""
        lines = wp.int32(1)
        for d in range(1, wp.static(space_dim)):
            lines *= cells_around(domain, d)
        first = wrapped(cell[0] - domain.cells_per_eps, domain.cell_shape[0])
        if first + cells_around(domain, 0) > domain.cell_shape[0]:
            lines *= 2
        return lines

    @wp.func
    def segment_cells(domain: Domain, cell: cell_vector, segment: int):
        """Return first and last + 1 cell (row-major) of run number `segment` around a cell."""
        width = cells_around(domain, 0)
        nx = domain.cell_shape[0]
        first = wrapped(cell[0] - domain.cells_per_eps, nx)
        line = segment
        begin = first
        end = first + width
        if end > nx:
            line = segment / 2
            if segment % 2 == 0:
                end = nx
            else:
                begin = 0
                end = first + width - nx
        y_line = line
        base = wp.int32(0)
        if wp.static(space_dim == 3):
            last = wp.static(space_dim - 1)
            y_width = cells_around(domain, 1)
            y_line = line % y_width
            z = wrapped(cell[last] - domain.cells_per_eps + line / y_width, domain.cell_shape[last])
            base = z * domain.cell_shape[1] * nx
        base += wrapped(cell[1] - domain.cells_per_eps + y_line, domain.cell_shape[1]) * nx
        return base + begin, base + end

    @wp.func
    def periodic_image_along(domain: Domain, d: int, difference: scalar):
        """Return the shortest image of a difference of coordinates in a box [length units]."""
        return difference - domain.box[d] * wp.round(difference * domain.inverse_box[d])

    @wp.func
    def periodic_image(domain: Domain, difference: vector):
        """Return the shortest image of a difference of positions in a box [length units]."""
        result = vector()
        for d in range(wp.static(space_dim)):
            result[d] = periodic_image_along(domain, d, difference[d])
        return result

    @wp.func
    def minimum_image(domain: Domain, difference: vector):
        """Return `periodic_image` of a difference in a box; in open space the difference itself."""
        result = difference
        if domain.periodic != 0:
            result = periodic_image(domain, difference)
        return result

    @wp.func
    def boxes_f64(domain: Domain, d: int, difference: scalar):
        """Return the multiple of the box's side d that is nearest to a difference, in float64."""
        return wp.float64(wp.round(difference * domain.inverse_box[d])) * wp.float64(domain.box[d])

    @wp.func
    def difference_f64(domain: Domain, centre: vector, neighbour: vector):
        """Return the minimum image of neighbour - centre, in float64 [length units]."""
        result = vector_f64()
        for d in range(wp.static(space_dim)):
            result[d] = wp.float64(neighbour[d]) - wp.float64(centre[d])
            if domain.periodic != 0:
                result[d] -= boxes_f64(domain, d, neighbour[d] - centre[d])
        return result

    @wp.func
    def position_of(entry: particle):
        result = vector()
        for d in range(wp.static(space_dim)):
            result[d] = entry[d]
        return result

    types = {"vector": vector, "vector_f64": vector_f64, "cell_vector": cell_vector}
    return native.namespace(locals(), **types, particle=particle, Domain=Domain)


@cached_under_lock()
def group_types(space_dim: int, scalar: type, width: int) -> SimpleNamespace:
    """Return `domain_types`, its arguments, and types of a group [width] and its gradient."""
    return SimpleNamespace(
        **vars(domain_types(space_dim, scalar)),
        **{"space_dim": space_dim, "scalar": scalar, "width": width},
        group=wp.types.vector(width, scalar),
        group_gradient=wp.types.matrix((space_dim, width), scalar),
        square=wp.types.matrix((space_dim, space_dim), scalar),
    )


@functools.lru_cache(maxsize=256)
def cell_grid(
    space_dim: int,
    particle_count: int,
    eps: float,
    box: tuple[float, ...] | None,
    cells_per_eps: int,
) -> tuple[int, ...]:
    """Return the number of cells of a world's grid along each dimension.

    Open space (`box` None) gets about one cell for each particle: a power of two along each
    dimension, because the grid wraps around. A periodic box is divided into cells no smaller than
    eps / cells_per_eps, into at most four times as many as open space has.
    """
    open_side = 8
    while open_side**space_dim < particle_count:
        open_side *= 2
    if box is None:
        return (open_side,) * space_dim
    size = eps / cells_per_eps * CELL_SLACK
    shape = [max(int(side / size), 1) for side in box]
    while math.prod(shape) > 4 * open_side**space_dim:
        longest = shape.index(max(shape))
        shape[longest] = -(-shape[longest] // 2)
    return tuple(shape)


@cached_under_lock(256)
def make_domain(
    space_dim: int,
    scalar: type,
    eps: float,
    box: tuple[float, ...] | None,
    particle_count: int,
    cells_per_eps: int = 2,
) -> Any:
    """Return the `Domain` of worlds; cells have side eps / cells_per_eps. No `box`: open space."""
    types = domain_types(space_dim, scalar)
    domain = types.Domain()
    domain.inverse_eps = 1.0 / eps
    domain.squared_eps = eps * eps
    domain.inverse_squared_eps = 1.0 / (eps * eps)
    smoothing_norm, spiky_norm = (4.0, 30.0) if space_dim == 2 else (315.0 / 64.0, 45.0)
    domain.smoothing_norm = smoothing_norm / (math.pi * eps**space_dim)
    domain.spiky_norm = spiky_norm / (math.pi * eps ** (space_dim + 1))
    shape = cell_grid(space_dim, particle_count, eps, box, cells_per_eps)
    domain.periodic = 0 if box is None else 1
    domain.box = types.vector(*(box or (1.0,) * space_dim))
    domain.inverse_box = types.vector(*(1.0 / side for side in (box or (1.0,) * space_dim)))
    scale = 1.0 / (eps / cells_per_eps * CELL_SLACK)
    scales = (scale,) * space_dim if box is None else tuple(1.0 / side for side in box)
    domain.cell_scale = wp.types.vector(space_dim, wp.float64)(*scales)
    domain.cell_shape = wp.types.vector(space_dim, wp.int32)(*shape)
    domain.cell_count = math.prod(shape)
    domain.cells_per_eps = cells_per_eps
    return domain
