"""The passes over sorted worlds: arguments and launches of density, perception and adjoint."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.cuda.adjoint import THREAD_CHANNELS, listed_adjoint
from npa_envs.kernels.cuda.adjoint import TILE_PARTICLES as ADJOINT_PARTICLES
from npa_envs.kernels.cuda.density import LIST_BLOCK, TILE_PARTICLES, listed_density, tiled_density
from npa_envs.kernels.cuda.perceive import PerceptionVariant, listed_perception
from npa_envs.kernels.lanes_and_memory import WARP
from npa_envs.kernels.portable.adjoint import adjoint_kernels
from npa_envs.kernels.portable.density import density_kernels
from npa_envs.kernels.portable.perceive import perception_kernels
from npa_envs.kernels.portable.search import PARTICLES
from npa_envs.ops.backend import ListLayout
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import ALIGNMENT, launch
from npa_envs.ops.physics import Physics
from npa_envs.ops.sort import MAX_INDEX, KernelPlan, SortedWorlds, plan_kernels

INTERLEAVED_LISTS = 32
"""Number of neighbour lists that are interleaved in memory."""


class NeighbourLists(NamedTuple):
    """Neighbour lists of active particles (rows) for the CUDA kernels; they include themselves."""

    layout: ListLayout
    index_differences: Tensor
    """Differences of sorted indices from each neighbour to the next, int16; lists of 32 rows are
    interleaved, those of tiles are stored one after the other."""
    lengths: Tensor
    """Number of neighbours of each row's particle, int32, [K]."""
    records: Tensor
    """Sorted positions with volumes, and in 2D indices of states, shape [B N, 4]."""
    per_particle: bool = False
    """Whether there is a list for each sorted particle, not for each row."""


StaticNeighbours = tuple[Tensor, Tensor]
"""Neighbour lists of static particles for the portable kernels: sorted indices of all particles'
neighbours, themselves included, int32, [E], and the end of each particle's part, int32, [B N]."""


class Densities(NamedTuple):
    """Result of the SPH density pass: volumes, density gradients, neighbours; for perception."""

    particles: Tensor
    """Sorted positions with volumes 1 / rho, shape [B N, D + 1]; empty if not asked for."""
    density_gradient: Tensor
    """Density gradients of sorted particles with rows, float64, shape [B N, D]; undefined for
    others; empty where perception computes them."""
    lists: NeighbourLists | None = None
    """Neighbours found by the density pass of `kernels/cuda/`."""
    static_neighbours: StaticNeighbours | None = None
    """Neighbours in static worlds on a CPU."""


def portable_kernels(plan: KernelPlan, with_lists: bool = False) -> Any:
    """Return the portable perception kernels; `with_lists`: they read neighbour lists."""
    terms = plan.physics.terms
    return perception_kernels(
        plan.space_dim,
        plan.scalar,
        plan.width,
        plan.on_cpu,
        terms.state_gradient,
        terms.correction,
        with_lists,
    )


def compute_densities(
    plan: KernelPlan,
    ordered: SortedWorlds,
    *,
    state_index: Tensor | None = None,
    with_particles: bool = True,
    particles: Tensor | None = None,
) -> Densities:
    """Return densities, with neighbour lists (CUDA) or density gradients (elsewhere).

    `state_index` is the index of each sorted particle's state, int32, shape [B N]; None: states are
    sorted too. `with_particles`: also return `Densities.particles` on CUDA, for the adjoint, in the
    tensor `particles`, or a new one.
    """
    if not plan.lists_neighbours:
        return compute_densities_in_cells(plan, ordered, particles)
    layout, positions = plan.list_layout, ordered.positions
    records = positions.new_empty(plan.total, 4)
    if particles is None:
        particles = positions.new_empty(plan.total if with_particles else 0, plan.space_dim + 1)
    list_shape = -(-plan.row_capacity // INTERLEAVED_LISTS), layout.capacity, INTERLEAVED_LISTS
    differences = positions.new_empty(list_shape, dtype=torch.int16)
    lengths = positions.new_empty(plan.row_capacity, dtype=torch.int32)
    cells = ordered.starts, ordered.cell, positions
    indices = state_index, ordered.original_index, ordered.row_of
    arrays = (*cells, *indices, particles, records, differences, lengths)
    if layout.tiled:
        launch(
            tiled_density(plan.periodic, layout.capacity, plan.masked),
            plan.world_count * -(-plan.particle_count // TILE_PARTICLES) * WARP,
            positions.device,
            plan.domain,
            plan.particle_count,
            *arrays,
            block_dim=WARP,
        )
    else:
        launch(
            listed_density(
                plan.space_dim, layout.lanes, plan.periodic, layout.capacity, plan.masked
            ),
            -(-plan.total * layout.lanes // WARP) * WARP,
            positions.device,
            plan.domain,
            *arrays,
            block_dim=LIST_BLOCK,
        )
    no_gradient = positions.new_empty(0, plan.space_dim, dtype=torch.float64)
    return Densities(particles, no_gradient, NeighbourLists(layout, differences, lengths, records))


def compute_densities_in_cells(
    plan: KernelPlan, ordered: SortedWorlds, particles: Tensor | None = None
) -> Densities:
    """Return densities of all particles and density gradients of active ones; makes no lists."""
    positions = ordered.positions
    if particles is None:
        particles = positions.new_empty(plan.total, plan.space_dim + 1)
    density_gradient = positions.new_empty(plan.total, plan.space_dim, dtype=torch.float64)
    kernels = density_kernels(plan.space_dim, plan.scalar, plan.on_cpu)
    launch(
        kernels.compute_density,
        search_threads(plan.total, plan.on_cpu),
        positions.device,
        plan.domain,
        plan.particle_count,
        int(plan.physics.terms.density_gradient),
        ordered.starts,
        ordered.original_index,
        ordered.row_of,
        positions,
        particles,
        density_gradient,
    )
    return Densities(particles, density_gradient)


def search_threads(count: int, on_cpu: bool) -> int:
    """Return how many threads search the neighbours of some particles, in portable kernels."""
    return -(-count // PARTICLES) if on_cpu else count


def perception_launch(
    plan: KernelPlan,
    ordered: SortedWorlds,
    densities: Densities,
    out: Tensor,
    *,
    states: Tensor | None = None,
    destination: Tensor | None = None,
    limit: float = 0.0,
    row_kernel_sum: Tensor | None = None,
    first_row: int = 0,
    row_count: int | None = None,
) -> tuple[Any, ...]:
    """Return the arguments of a `launch` that writes active particles' perception vectors to `out`.

    Args:
        states: States in the caller's order, [B, N, C], where `ordered` has none; CUDA only.
        destination: Row of `out` for each active particle, int32, shape [K]; None: in their order.
        limit: Entries are clipped to plus and minus this; 0: not clipped.
        row_kernel_sum: Output: sums over neighbours of volume times kernel gradient, shape [K, D].
        first_row: First active particle to write, a multiple of `INTERLEAVED_LISTS`.
        row_count: Number of active particles to write, one after the other; None: all.
    """
    row_index, lists = ordered.row_index if plan.masked else None, densities.lists
    if row_count is None:
        row_count = plan.row_capacity
    else:
        row_index = ordered.row_index[first_row:]
        if lists is not None:
            differences = lists.index_differences[first_row // INTERLEAVED_LISTS :]
            lists = lists._replace(index_differences=differences, lengths=lists.lengths[first_row:])
    group_count, rows, outputs = plan.group_count, (row_index, destination), (out, row_kernel_sum)
    numbers = (
        plan.state_dim,
        int(plan.physics.terms.density_gradient),
        plan.physics.scale(),
        plan.density_scale,
        plan.row_base + first_row,
    )
    if lists is None:
        neighbours, ends = densities.static_neighbours or (None, None)
        cells = ordered.starts, ends, neighbours, densities.particles
        kernels = portable_kernels(plan, neighbours is not None)
        return (
            kernels.perceive,
            (search_threads(row_count, plan.on_cpu), group_count),
            out.device,
            plan.domain,
            plan.particle_count,
            *numbers,
            row_count,
            group_count,
            limit,
            *cells,
            ordered.states,
            ordered.states.view(plan.total, -1),
            *rows,
            densities.density_gradient,
            *outputs,
        )
    variant = _perception_variant(plan, lists, group_count > 1, row_kernel_sum is not None)
    cells = ordered.starts, ordered.cell, ordered.positions, lists.records
    return (
        listed_perception(variant),
        -(-row_count * group_count * variant.lanes // WARP) * WARP,
        out.device,
        plan.domain,
        *numbers,
        row_count,
        group_count,
        limit,
        *cells,
        ordered.states if states is None else states,
        None if states is None else ordered.original_index,
        *rows,
        lists.index_differences,
        lists.lengths,
        *outputs,
    )


def _perception_variant(
    plan: KernelPlan, lists: NeighbourLists, grouped: bool, for_adjoint: bool
) -> PerceptionVariant:
    terms, layout = plan.physics.terms, lists.layout
    return PerceptionVariant(
        space_dim=plan.space_dim,
        width=plan.width,
        state_gradient=terms.state_gradient,
        moment_inverse=terms.correction,
        periodic=plan.periodic,
        grouped=grouped,
        capacity=layout.capacity,
        for_adjoint=for_adjoint,
        teams=layout.teams,
        per_particle=lists.per_particle,
        tiled=layout.tiled,
    )


class SavedPerception(NamedTuple):
    """Tensors that the adjoint of perception reads; some are in `SortedWorlds` and `Densities`."""

    perception: Tensor
    """Rows of perception, dimensionless, shape [K, row_width]."""
    row_kernel_sum: Tensor
    """Sums over neighbours of volume times kernel gradient [1 / length units], shape [K, D];
    undefined beyond the last active row."""
    row_of: Tensor
    starts: Tensor
    original_index: Tensor
    particles: Tensor
    row_positions: Tensor
    states: Tensor | None = None
    """Of `SortedWorlds`; None where positions get no gradient."""


def saved_together(
    plan: KernelPlan, perception: Tensor, with_states: bool, block: Tensor | None = None
) -> tuple[Tensor, SavedPerception]:
    """Return a `SavedPerception` of all particles, all but perception within one block of bytes.

    The first result is the block; `block` None: a new one.
    """
    total, dims = plan.total, plan.space_dim
    indices = {"row_of": (total,), "starts": (plan.start_count,), "original_index": (total,)}
    shapes: dict[str, tuple[int, ...]] = indices | {"row_kernel_sum": (total, dims)}
    shapes |= {"row_positions": (total, dims), "particles": (total, dims + 1)}
    shapes |= {"states": (total * plan.group_count, plan.width)} if with_states else {}
    counts = [math.prod(shape) for shape in shapes.values()]
    sizes = [-(-count * perception.itemsize // ALIGNMENT) * ALIGNMENT for count in counts]
    if block is None:
        block = torch.empty(sum(sizes), dtype=torch.uint8, device=perception.device)
    parts = {}
    for name, count, part in zip(shapes, counts, block.split_with_sizes(sizes), strict=True):
        numbers = part.view(torch.int32 if name in indices else perception.dtype)
        parts[name] = numbers[:count].view(shapes[name])
    return block, SavedPerception(perception, **parts)


@custom_op("npa::perceive_backward", of_all=True)
def perceive_backward(
    perception_bar: Tensor,
    perception: Tensor,
    block: Tensor,
    space_dim: int,
    state_dim: int,
    with_positions: bool,
    physics: Physics,
) -> list[Tensor]:
    """Return gradients of states and, if asked for, of positions from that of perception.

    `block` is that of `saved_together`.
    """
    bar, rows = perception_bar.flatten(0, 1), perception.flatten(0, 1)
    worlds = tuple(map(int, perception.shape[:2]))
    plan = plan_kernels(rows, (*worlds, space_dim), state_dim, len(rows), False, physics)
    _, saved = saved_together(plan, rows, with_positions, block)
    gradients = _pull_back(plan, saved, [], bar, saved.original_index)
    return [gradient.view(*worlds, -1) for gradient in gradients[: 1 + with_positions]]


@custom_op("npa::perceive_rows_backward")
def perceive_rows_backward(
    perception_bar: Tensor,
    saved_tensors: list[Tensor],
    static_neighbours: list[Tensor],
    particle_count: int,
    state_dim: int,
    masked: bool,
    physics: Physics,
) -> tuple[Tensor, Tensor]:
    """Return gradients of states, [B N, C], and positions, [B N, D] or empty, from those of rows.

    The tensors are those of a `SavedPerception` and of `StaticNeighbours`, or none. Positions get a
    gradient if states were saved.
    """
    saved = SavedPerception(*saved_tensors)
    total, space_dim = saved.particles.shape[0], saved.particles.shape[1] - 1
    plan = plan_kernels(
        saved.particles,
        (total // particle_count, particle_count, space_dim),
        state_dim,
        saved.perception.shape[0],
        masked,
        physics,
    )
    return _pull_back(plan, saved, static_neighbours, perception_bar.contiguous(), None)


def _pull_back(
    plan: KernelPlan,
    saved: SavedPerception,
    static_neighbours: list[Tensor],
    bar: Tensor,
    bar_row: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Return both gradients of `perceive_rows_backward`.

    `bar_row` is the row of perception and of `bar` of each row; None: the same.
    """
    if plan.runs("adjoint", position_gradient=saved.states is not None) == "cuda":
        states_bar = _gather_by_tiles(plan, saved, bar, bar_row)
        return states_bar, states_bar.new_empty(0)
    neighbours, ends = static_neighbours or (None, None)
    space_dim, group_count = plan.space_dim, plan.group_count
    terms, with_positions = plan.physics.terms, saved.states is not None
    kernels = adjoint_kernels(
        space_dim,
        plan.scalar,
        plan.width,
        plan.on_cpu,
        terms.state_gradient,
        bool(static_neighbours),
    )
    row_bars = _unscaled_cotangents(plan, saved, kernels, bar, bar_row)
    smoothed_bar, gradient_bar, _ = row_bars
    states_bar = bar.new_empty(plan.total, plan.state_dim)
    cells = saved.starts, ends, neighbours, saved.particles, saved.original_index
    rows = saved.row_of, saved.row_positions, saved.row_kernel_sum
    launch(
        kernels.gather_state_cotangents,
        (search_threads(plan.total, plan.on_cpu), group_count),
        bar.device,
        plan.domain,
        plan.particle_count,
        plan.state_dim,
        *plan.row_arguments,
        group_count,
        *cells,
        *rows,
        bar,
        bar_row,
        smoothed_bar,
        # Twice: in the kernel's matrices, and as its flat array of numbers.
        gradient_bar,
        gradient_bar,
        states_bar,
    )
    if not with_positions:
        return states_bar, bar.new_empty(0)
    density_bar = bar.new_empty(plan.total)
    positions_bar = bar.new_empty(plan.total, space_dim)
    sizes = plan.total, bar.device, plan.domain, plan.particle_count, group_count
    world = saved.starts, saved.particles, saved.states, saved.original_index, saved.row_of
    common = (*sizes, *world)
    launch(kernels.gather_density_cotangents, *common, smoothed_bar, gradient_bar, density_bar)
    launch(kernels.gather_position_cotangents, *common, density_bar, *row_bars, positions_bar)
    return states_bar, positions_bar


def _unscaled_cotangents(
    plan: KernelPlan, saved: SavedPerception, kernels: Any, bar: Tensor, bar_row: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return gradients of each row's smoothed states, state gradients and density gradients.

    These are sums before their scaling by `Physics.scale` and the logarithm. The last gradients are
    empty if positions get none.
    """
    group_count, space_dim, width = plan.group_count, plan.space_dim, plan.width
    entries = plan.row_capacity * group_count
    largest = entries * space_dim * width
    if largest >= MAX_INDEX:
        raise NPAError(
            f"gradients must stay below {MAX_INDEX} numbers in one batch, got {largest}: split "
            "the batch, or take float32 and detach_positions=True"
        )
    smoothed_bar = bar.new_empty(entries, width)
    gradient_bar = bar.new_empty(entries, space_dim, width)
    density_rows = 0 if saved.states is None else plan.row_capacity
    density_gradient_bar = bar.new_empty(density_rows, space_dim)
    launch(
        kernels.unscale_cotangents,
        (plan.row_capacity, group_count * width),
        bar.device,
        plan.state_dim,
        int(plan.physics.terms.density_gradient),
        plan.physics.scale(),
        plan.density_scale,
        plan.row_base,
        group_count,
        saved.starts,
        saved.perception,
        bar,
        bar_row,
        smoothed_bar,
        gradient_bar,
        density_gradient_bar,
    )
    return smoothed_bar, gradient_bar, density_gradient_bar


def _gather_by_tiles(
    plan: KernelPlan, saved: SavedPerception, bar: Tensor, bar_row: Tensor | None
) -> Tensor:
    """Return the gradient with respect to states, [B N, C], with the CUDA kernels in float32."""
    state_gradient = plan.physics.terms.state_gradient
    kernels = listed_adjoint(
        plan.space_dim, plan.width, state_gradient, plan.periodic, plan.group_count > 1
    )
    # The kernel multiplies by one norm; cotangents of smoothed states get the ratio of norms first.
    norm = plan.domain.spiky_norm if state_gradient else plan.domain.smoothing_norm
    sum_count = 1 + plan.space_dim * state_gradient
    entries = plan.row_capacity * plan.group_count + 1
    cotangents = bar.new_empty(entries * sum_count * plan.width // THREAD_CHANNELS, THREAD_CHANNELS)
    launch(
        kernels.unscale_cotangents,
        entries * plan.width // THREAD_CHANNELS,
        bar.device,
        plan.state_dim,
        plan.physics.scale(),
        plan.domain.smoothing_norm / norm,
        plan.row_base,
        plan.row_capacity,
        plan.group_count,
        saved.starts,
        saved.perception,
        bar,
        bar_row,
        cotangents,
    )
    states_bar = bar.new_empty(plan.total, plan.state_dim)
    tile_count = -(-plan.particle_count // ADJOINT_PARTICLES)
    cells = saved.starts, saved.particles, saved.original_index
    rows = saved.row_of, saved.row_positions, saved.row_kernel_sum
    launch(
        kernels.gather_state_cotangents,
        plan.world_count * tile_count * plan.group_count * WARP,
        bar.device,
        plan.domain,
        norm,
        plan.particle_count,
        tile_count,
        plan.state_dim,
        *plan.row_arguments,
        plan.group_count,
        *cells,
        *rows,
        bar,
        bar_row,
        # Twice: in the kernel's vectors of channels, and as its flat array of numbers.
        cotangents,
        cotangents,
        states_bar,
    )
    return states_bar
