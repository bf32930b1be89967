"""The backend table: which implementation of each operator runs, and why.

There are two backends. `kernels/portable/` is plain Warp for a CPU and for CUDA, in float32 and
float64; it reads like `reference.py`. `kernels/cuda/` is for CUDA in float32 on compute capability
8.0 and above: neighbour lists in 16 bits, sums shared by threads, tensor cores. An operator takes
the first implementation in `TABLE` whose condition holds for a call. Perception has no row: it
reads what the density pass writes, by the `list_layout` that follows the row of density. The update
has one implementation; operators of `ops/pictures/` choose by the device only. `npa-envs bench
--explain` prints what was chosen.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch

from npa_envs.kernels.cuda.density import MIN_SIDE
from npa_envs.kernels.cuda.equivariance import fits_block
from npa_envs.kernels.cuda.network import WARP_UNITS
from npa_envs.kernels.cuda.sort import BLOCKS, MAX_GRID
from npa_envs.kernels.cuda.whole_rollout import MAX_CHANNELS, MIN_PARTICLES, SIZES
from npa_envs.kernels.cuda.whole_rollout import fits_block as world_fits_block
from npa_envs.ops.physics import Boundary

Operator = Literal["rollout", "sort", "density", "adjoint", "vectors", "network"]

MAX_ROW, MAX_UPDATE, MAX_HIDDEN = 128, 32, 512
"""Maximum numbers of columns of rows, of columns of updates, and of hidden units, that the CUDA
kernels of the network take."""

MAX_THREAD_WORLD = 4096
"""Maximum number of particles of a world that one CPU thread sorts."""

MAX_BLOCK_WORLD = max(BLOCKS)
"""Maximum number of particles of a world that one CUDA block sorts."""

SMALL_WORLD = 2048
"""Maximum number of particles of a world that environments perceive without tiles."""

SHARED_WORLD = 4096
"""Maximum number of particles of a world in which several threads share a particle: batches of such
worlds may be too small to fill a GPU."""


class KernelRequest(NamedTuple):
    """Properties of an operator call that decide which implementation in `TABLE` runs it."""

    device: torch.device
    dtype: torch.dtype
    particle_count: int = 0
    """Particles of a world, N."""
    cell_count: int = 0
    """Cells of a world's grid."""
    space_dim: int = 0
    """Space dimension D."""
    smallest_side: int = 0
    """Cells along the shortest side of a world's grid."""
    aligned: bool = True
    """Whether tensors begin at multiples of 16 bytes in memory."""
    position_gradient: bool = False
    """Whether positions get a gradient through perception."""
    row_width: int = 0
    """Columns of a row of perception."""
    update_width: int = 0
    """Columns of an update."""
    hidden_dim: int = 0
    """Hidden units of the rule, H."""
    vectors: tuple[int, int, int, int, bool] | None = None
    """The `VectorSizes` of an equivariant rule."""
    rollout: bool = False
    """Whether it is a rollout of one plain rule whose particles move, without gradients."""
    boundary: Boundary = "open"
    """Boundary of a rollout's worlds."""
    state_dim: int = 0
    """State channels C of a rollout."""
    for_environments: bool = False
    """Whether environments perceive, whose batches fill a GPU, and not rollouts."""


class Implementation(NamedTuple):
    """Kernels that implement an operator, and the calls that they can run."""

    operator: Operator
    """The operator that it implements."""
    name: str
    """Name to which call sites compare the result of `KernelPlan.runs`."""
    where: str
    """File of the kernels."""
    condition: str = "otherwise"
    """Description of when it runs."""
    holds: Callable[[KernelRequest], bool] = lambda request: True
    """Returns whether it can run a call."""


@functools.lru_cache
def multiprocessor_count(device: torch.device) -> int:
    """Return the number of streaming multiprocessors of a CUDA device."""
    return int(torch.cuda.get_device_properties(device).multi_processor_count)


def _cuda(request: KernelRequest) -> bool:
    fits = request.dtype == torch.float32 and request.device.type == "cuda"
    return fits and torch.cuda.get_device_capability(request.device) >= (8, 0)


def _block(request: KernelRequest) -> bool:
    return (
        _cuda(request)
        and request.aligned
        and request.particle_count <= MAX_BLOCK_WORLD
        and request.cell_count <= MAX_GRID
    )


def _tiles(request: KernelRequest) -> bool:
    return (
        _cuda(request)
        and request.space_dim == 2
        and request.particle_count <= SHARED_WORLD
        and not (request.for_environments and request.particle_count <= SMALL_WORLD)
        and request.smallest_side >= MIN_SIDE
    )


def _fused(request: KernelRequest) -> bool:
    widths = request.row_width, request.update_width
    return (
        _cuda(request)
        and all(width % 4 == 0 for width in widths)
        and request.hidden_dim % WARP_UNITS == 0
        and request.row_width <= MAX_ROW
        and request.update_width <= MAX_UPDATE
        and request.hidden_dim <= MAX_HIDDEN
    )


def _whole(request: KernelRequest) -> bool:
    return (
        request.rollout
        and _cuda(request)
        and torch.cuda.get_device_capability(request.device) == (9, 0)
        and request.space_dim == 2
        and request.boundary != "periodic"
        and world_fits_block(request.particle_count, request.state_dim, request.hidden_dim)
    )


_MODERN = "CUDA from compute capability 8.0 on, float32"

TABLE: tuple[Implementation, ...] = (
    Implementation(
        "rollout",
        "whole",
        "kernels/cuda/whole_rollout.py",
        "cuda_graph='whole', CUDA of compute capability 9.0, float32, 2D, no periodic box, "
        f"{MIN_PARTICLES} to {SIZES[-1]} particles with at most {MAX_CHANNELS} channels, worlds "
        "that fit into shared memory with the rule: a few warps run all steps of a world",
        _whole,
    ),
    Implementation(
        "rollout",
        "steps",
        "world/steps.py",
        "otherwise: launches of each step",
        lambda request: request.rollout,
    ),
    Implementation(
        "sort",
        "block",
        "kernels/cuda/sort.py",
        f"{_MODERN}, worlds of at most {MAX_BLOCK_WORLD} particles and "
        f"{MAX_GRID} cells: a block of threads sorts a world",
        _block,
    ),
    Implementation(
        "sort", "cuda", "kernels/cuda/sort.py", f"{_MODERN}: a warp moves states together", _cuda
    ),
    Implementation(
        "sort",
        "world",
        "kernels/portable/sort.py",
        f"a CPU, worlds of at most {MAX_THREAD_WORLD} particles: a thread sorts a world",
        lambda request: request.device.type == "cpu" and request.particle_count <= MAX_THREAD_WORLD,
    ),
    Implementation("sort", "portable", "kernels/portable/sort.py"),
    Implementation(
        "density",
        "tiles",
        "kernels/cuda/density.py",
        f"{_MODERN}, 2D, worlds of at most {SHARED_WORLD} particles, boxes of at least "
        f"{MIN_SIDE} cells along each side; environments only above {SMALL_WORLD}: neighbours "
        "are listed in the same pass, by a warp for eight particles",
        _tiles,
    ),
    Implementation(
        "density",
        "cuda",
        "kernels/cuda/density.py",
        f"{_MODERN}: neighbours are listed in the same pass, in 16 bits each",
        _cuda,
    ),
    Implementation("density", "portable", "kernels/portable/density.py"),
    Implementation(
        "adjoint",
        "cuda",
        "kernels/cuda/adjoint.py",
        f"{_MODERN}, positions get no gradient: tiles of eight particles on tensor cores",
        lambda request: _cuda(request) and not request.position_gradient,
    ),
    Implementation("adjoint", "portable", "kernels/portable/adjoint.py"),
    Implementation(
        "vectors",
        "cuda",
        "kernels/cuda/equivariance.py",
        f"{_MODERN}, rows fit into shared memory: a warp maps a few rows of an equivariant rule",
        lambda request: (
            request.vectors is not None and _cuda(request) and fits_block(*request.vectors)
        ),
    ),
    Implementation(
        "vectors",
        "portable",
        "kernels/portable/equivariance.py",
        "otherwise",
        lambda request: request.vectors is not None,
    ),
    Implementation(
        "network",
        "cuda",
        "kernels/cuda/network.py",
        f"{_MODERN}, rows of at most {MAX_ROW} columns, updates of {MAX_UPDATE}, "
        f"{MAX_HIDDEN} hidden units in multiples of {WARP_UNITS}: tensor cores",
        _fused,
    ),
    Implementation("network", "torch", "torch's products"),
)
"""All implementations. A call takes the first one of its operator whose condition is true."""


@functools.lru_cache(maxsize=4096)
def choose(operator: Operator, request: KernelRequest) -> Implementation:
    """Return the first implementation of an operator in `TABLE` that can run a call."""
    return next(row for row in TABLE if row.operator == operator and row.holds(request))


def describe(request: KernelRequest) -> list[str]:
    """Return a text line for each operator: name, file and condition of what `choose` returns."""
    chosen = {row.operator: row for row in reversed(TABLE) if row.holds(request)}
    return [
        f"{row.operator:8}  {row.name:8}  {row.where:28}  {row.condition}"
        for row in TABLE
        if row is chosen.get(row.operator)
    ]


class ListLayout(NamedTuple):
    """Length of neighbour lists on CUDA, and how many threads compute a particle together.

    It depends on the device and on one world's size and box, never on the number of worlds: the
    order of a world's sums follows from it, and must be the same in every batch.
    """

    capacity: int
    """Maximum length of a list; perception searches again for neighbours of particles with more."""
    lanes: int
    """Threads that share a particle in the density pass."""
    teams: int
    """Groups of threads that share a row in the perception pass."""
    tiled: bool = False
    """Whether the density pass is `tiled_density`."""


CROWD = range(80, 200)
"""Mean neighbours at which many lists are longer than 128, and few longer than 256."""

HUGE_WORLD = 2**22
"""Maximum number of particles of a world whose neighbour lists may take more memory than rows."""


def list_layout(request: KernelRequest, mean_neighbours: float) -> ListLayout:
    """Return the `ListLayout` of a call whose particles have about `mean_neighbours` neighbours.

    Rollouts use more threads for a particle than environments, so that few worlds fill a GPU.
    """
    tiled = choose("density", request).name == "tiles"
    if request.for_environments:
        if request.particle_count <= SMALL_WORLD:
            return ListLayout(64, lanes=1, teams=1)
        return ListLayout(128, lanes=4 if tiled else 1, teams=1, tiled=tiled)
    if request.particle_count <= SHARED_WORLD:
        capacity = 256 if int(mean_neighbours) in CROWD else 128
        return ListLayout(capacity, lanes=4, teams=2, tiled=tiled)
    # The lists of worlds that fill a device's memory would be the largest part of it.
    return ListLayout(96 if request.particle_count > HUGE_WORLD else 128, lanes=1, teams=1)
