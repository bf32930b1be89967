"""Sorting worlds into cells, the first half of every SPH operator, and the sizes of launches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.cuda.sort import BLOCKS, THREAD_CHANNELS, order_particles, sort_small_worlds
from npa_envs.kernels.domain import cell_grid, make_domain
from npa_envs.kernels.lanes_and_memory import CUDA_LANES, WARP
from npa_envs.kernels.portable.sort import sort_kernels
from npa_envs.ops.backend import (
    KernelRequest,
    ListLayout,
    Operator,
    choose,
    list_layout,
    multiprocessor_count,
)
from npa_envs.ops.launch import SCALARS, channel_width, is_aligned, launch
from npa_envs.ops.physics import Physics

MAX_INDEX = 2**31 - 1
"""Largest index of an array in a kernel: indices have 32 bits."""

MAX_MASK = 2**28
"""Maximum product of worlds and entries of a mask that CUDA blocks sort: each block counts the
active particles of all earlier worlds."""

MAX_THREAD_MASK = 2**22
"""The same for masks that CPU threads sort."""

MIN_SLICE = 128
"""Minimum number of particles of a slice."""


class KernelPlan(NamedTuple):
    """Sizes of an operator's launches, with its cell grid and constants.

    It follows from shapes, dtype, device and `Physics`, not from the values of tensors.
    """

    scalar: Any
    """Warp's scalar type of positions and states."""
    width: int
    """State channels of a group, which one thread sums."""
    world_count: int
    particle_count: int
    space_dim: int
    state_dim: int
    row_capacity: int
    """Number K of rows: the maximum number of active particles in all worlds together."""
    masked: bool
    """Whether some particles may be inactive."""
    physics: Physics
    """Constants of the worlds; its D and C may be 0: read those of the plan."""
    domain: Any
    """Radius, box and cell grid: a struct that kernels read."""
    request: KernelRequest
    """Properties by which the backend table chooses kernels."""
    list_layout: ListLayout
    """Layout of neighbour lists on CUDA."""

    def runs(
        self, operator: Operator, *, aligned: bool = True, position_gradient: bool = False
    ) -> str:
        """Return the name of the implementation in `backend.TABLE` that runs an operator."""
        request = self.request
        if not aligned or position_gradient:
            request = request._replace(aligned=aligned, position_gradient=position_gradient)
        return choose(operator, request).name

    @property
    def lists_neighbours(self) -> bool:
        """Whether the density pass makes neighbour lists, as on CUDA."""
        return self.runs("density") != "portable"

    @property
    def on_cpu(self) -> bool:
        """Whether kernels run on a CPU."""
        return self.request.device.type == "cpu"

    @property
    def periodic(self) -> bool:
        """Whether space is a periodic box."""
        return bool(self.domain.periodic)

    @property
    def total(self) -> int:
        """Number of particles of all worlds, B N."""
        return self.world_count * self.particle_count

    @property
    def group_count(self) -> int:
        """Number of groups of `width` channels that a particle's states are split into."""
        return -(-self.state_dim // self.width)

    @property
    def cell_total(self) -> int:
        """Number of cells of all worlds."""
        return self.world_count * int(self.domain.cell_count)

    @property
    def active_offset(self) -> int:
        """Index in `SortedWorlds.starts` of the first entry that counts active particles."""
        return self.cell_total if self.masked else 0

    @property
    def start_count(self) -> int:
        """Length of `SortedWorlds.starts`: 1 + number of cells, with a mask 1 + twice that."""
        return self.cell_total + self.active_offset + 1

    @property
    def row_base(self) -> int:
        """Value of `SortedWorlds.starts` for row 0: an entry minus this is a row."""
        return self.total if self.masked else 0

    @property
    def row_arguments(self) -> tuple[int, int, int]:
        """Arguments of kernels that number or look up rows, in their order."""
        return self.active_offset, self.row_base, self.row_capacity

    @property
    def density_scale(self) -> float:
        """c^(1+D) / N, by which the density gradient is scaled before the logarithm."""
        return self.physics.scale() ** (1 + self.space_dim) / self.particle_count


class SortedWorlds(NamedTuple):
    """Particles sorted by world, cell and index; active ones have rows 0 to K - 1 in this order."""

    starts: Tensor
    """First sorted index of every cell, then first row of every cell (plus `row_base`), int32."""
    original_index: Tensor
    """Caller's index of each sorted particle, int32, shape [B N]."""
    cell: Tensor
    """Cell of each sorted particle, counted through all worlds, int32, shape [B N]."""
    row_of: Tensor
    """Row of each particle, -1 for inactive ones, int32, shape [B N]."""
    row_particle: Tensor
    """Caller's index of each row, int32, shape [K]; undefined beyond the last active row."""
    row_index: Tensor
    """Sorted index of each row, int32, shape [K]; undefined beyond the last active row."""
    positions: Tensor
    """Sorted positions [length units], shape [B N, D]."""
    row_positions: Tensor
    """Positions of the rows [length units], shape [K, D]; undefined beyond the last active row."""
    states: Tensor
    """Sorted states, dimensionless, shape [B N G, W]: channels padded with zeros to G groups."""


def plan_kernels(
    like: Tensor,
    shape: Sequence[int],
    state_dim: int,
    row_capacity: int,
    masked: bool,
    physics: Physics,
    *,
    for_environments: bool = False,
) -> KernelPlan:
    """Return the `KernelPlan` of a call on positions of shape [B, N, D] and `state_dim` channels.

    `like` is a tensor of the worlds' dtype and device. `row_capacity` is the maximum number K of
    active particles in all worlds together. `masked`: some particles may be inactive.
    """
    # As integers: symbolic sizes of torch.compile become constants, and other sizes recompile.
    world_count, particle_count, space_dim = (int(size) for size in shape)
    scalar = SCALARS[like.dtype]
    eps, sides = physics.eps, physics.periodic_box
    # In 3D smaller cells give many short runs of candidates, which threads share badly.
    cells_per_eps = 1 if space_dim == 3 and like.device.type == "cuda" else 2
    domain = make_domain(space_dim, scalar, eps, sides, particle_count, cells_per_eps)
    request = KernelRequest(
        like.device,
        like.dtype,
        particle_count,
        int(domain.cell_count),
        space_dim,
        smallest_side=min(cell_grid(space_dim, particle_count, eps, sides, cells_per_eps)),
        for_environments=for_environments,
    )
    plan = KernelPlan(
        scalar=scalar,
        width=channel_width(int(state_dim)),
        world_count=world_count,
        particle_count=particle_count,
        space_dim=space_dim,
        state_dim=int(state_dim),
        row_capacity=row_capacity,
        masked=masked,
        physics=physics,
        domain=domain,
        request=request,
        list_layout=list_layout(request, mean_neighbours(particle_count, eps, sides)),
    )
    largest = max(2 * plan.cell_total, plan.total * (1 + plan.state_dim))
    if largest >= MAX_INDEX:
        raise NPAError(
            f"worlds must stay below {MAX_INDEX} cells and state entries in one batch, got "
            f"{world_count} worlds of {particle_count} particles and {plan.state_dim} channels: "
            f"split the batch"
        )
    return plan


def mean_neighbours(particle_count: int, eps: float, box: Sequence[float] | None) -> float:
    """Return the mean number of neighbours of uniform particles in a box; 0 in open space."""
    if box is None:
        return 0.0
    ball = math.pi * eps**2 if len(box) == 2 else 4.0 / 3.0 * math.pi * eps**3
    return particle_count * ball / math.prod(box)


def sorts_at_once(world_count: int, particle_count: int) -> bool:
    """Return whether worlds are so small that one launch sorts them on a CPU, even with a mask."""
    return world_count * world_count * particle_count <= MAX_THREAD_MASK


def sort_worlds(
    plan: KernelPlan,
    x: Tensor,
    s: Tensor | None,
    mask: Tensor | None,
    *,
    with_rows: bool = True,
    into: dict[str, Tensor] | None = None,
) -> SortedWorlds:
    """Return worlds sorted into cells; active particles (`mask`, uint8, [B, N]) get rows.

    Arguments are contiguous. `s` None: sorted states are empty. `mask` None: all particles are
    active. Without `with_rows` tensors of rows are empty. `into` has fields to write to.
    """
    # Mask entries that are read if each world counts the rows of earlier worlds.
    earlier = plan.world_count * plan.total if plan.masked else 0
    capacity = 0 if earlier > MAX_MASK else block_capacity(plan.request, x, s, mask)
    ordered = _empty_worlds(plan, x, s is not None, with_rows)._replace(**into or {})
    if capacity:
        _sort_by_blocks(plan, capacity, x, s, mask, ordered)
    elif plan.runs("sort") == "world" and earlier <= MAX_THREAD_MASK:
        _sort_by_threads(plan, x, s, mask, ordered)
    else:
        _sort_in_passes(plan, x, s, mask, ordered)
    return ordered


def _sort_in_passes(
    plan: KernelPlan, x: Tensor, s: Tensor | None, mask: Tensor | None, ordered: SortedWorlds
) -> None:
    """Write worlds of any size to `ordered`: particles are counted, placed by cell and moved."""
    kernels = sort_kernels(plan.space_dim, plan.scalar, plan.width)
    device, total = x.device, plan.total
    cell, arrival = torch.empty(2, total, dtype=torch.int32, device=device).unbind()
    arrived = torch.empty(total, 2, dtype=torch.int32, device=device)
    counts = torch.zeros(plan.start_count, dtype=torch.int32, device=device)
    sizes, counted = (plan.particle_count, plan.active_offset), (cell, arrival, counts)
    launch(kernels.count_cells, total, device, plan.domain, x, mask, *sizes, *counted)
    torch.cumsum(counts, 0, dtype=torch.int32, out=ordered.starts)
    launch(kernels.place_by_arrival, total, device, mask, cell, arrival, ordered.starts, arrived)

    on_cuda = plan.runs("sort", aligned=False) == "cuda"
    # Channels that a thread reads and writes at once where they are aligned.
    together = plan.width // CUDA_LANES if on_cuda else plan.width
    aligned = s is not None and plan.state_dim % together == 0 and is_aligned(s)
    launch(
        order_particles(plan.space_dim, plan.width) if on_cuda else kernels.order_particles,
        # A warp moves the states of 32 particles.
        -(-total // WARP) * WARP if on_cuda else total,
        device,
        x,
        plan.state_dim,
        plan.group_count,
        int(aligned),
        s,
        *plan.row_arguments,
        arrived,
        *ordered,
    )


def _empty_worlds(plan: KernelPlan, x: Tensor, with_states: bool, with_rows: bool) -> SortedWorlds:
    total = plan.total
    original_index, cell = torch.empty(2, total, dtype=torch.int32, device=x.device).unbind()
    row_capacity = plan.row_capacity if with_rows else 0
    row_particle = cell.new_empty(row_capacity)
    return SortedWorlds(
        starts=cell.new_empty(plan.start_count),
        original_index=original_index,
        cell=cell,
        row_of=cell.new_empty(total if with_rows else 0),
        row_particle=row_particle,
        row_index=torch.empty_like(row_particle),
        positions=x.new_empty(total, plan.space_dim),
        row_positions=x.new_empty(row_capacity, plan.space_dim),
        states=x.new_empty(total * plan.group_count if with_states else 0, plan.width),
    )


def block_capacity(request: KernelRequest, *tensors: Tensor | None) -> int:
    """Return the capacity [particles] of the CUDA block that sorts such worlds; 0: none does."""
    aligned = all(tensor is None or is_aligned(tensor) for tensor in tensors)
    if choose("sort", request._replace(aligned=aligned)).name != "block":
        return 0
    return next(size for size in sorted(BLOCKS) if size >= request.particle_count)


def slice_count(device: torch.device, world_count: int, particle_count: int) -> int:
    """Return the number of slices of a world, one CUDA block each: several if worlds are few."""
    idle = multiprocessor_count(device) // world_count
    return max(min(idle, particle_count // MIN_SLICE), 1)


def _sort_by_threads(
    plan: KernelPlan, x: Tensor, s: Tensor | None, mask: Tensor | None, ordered: SortedWorlds
) -> None:
    """Write small worlds on a CPU to `ordered` in one launch, one thread for each world."""
    launch(
        sort_kernels(plan.space_dim, plan.scalar, plan.width).sort_worlds,
        plan.world_count,
        x.device,
        plan.domain,
        x,
        mask,
        plan.particle_count,
        plan.state_dim,
        plan.group_count,
        int(s is not None and plan.state_dim % plan.width == 0 and is_aligned(s)),
        s,
        *plan.row_arguments,
        torch.empty_like(ordered.original_index),
        *ordered,
    )


def _sort_by_blocks(
    plan: KernelPlan,
    capacity: int,
    x: Tensor,
    s: Tensor | None,
    mask: Tensor | None,
    ordered: SortedWorlds,
) -> None:
    """Write small worlds on CUDA to `ordered` in one launch; a block sorts a slice of a world."""
    slices = slice_count(x.device, plan.world_count, plan.particle_count)
    block = BLOCKS[capacity]
    launch(
        sort_small_worlds(plan.space_dim, capacity),
        plan.world_count * slices * block,
        x.device,
        plan.domain,
        plan.particle_count,
        slices,
        x,
        plan.state_dim,
        1 if s is None else plan.group_count * plan.width // THREAD_CHANNELS,
        int(plan.state_dim % THREAD_CHANNELS == 0),
        s,
        mask,
        *plan.row_arguments,
        *ordered,
        block_dim=block,
    )
