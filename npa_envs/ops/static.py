"""Static worlds: sorted once, with densities and neighbour lists, for steps that move nobody.

They stay in sorted order from the first step to the last. Each step only gives the active particles
rows; then the ordinary kernels run.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.portable.density import density_kernels
from npa_envs.kernels.portable.sort import give_rows
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import launch, scalar_type
from npa_envs.ops.passes import Densities, ListedNeighbours, NeighbourLists, compute_densities
from npa_envs.ops.physics import Physics
from npa_envs.ops.sort import KernelPlan, SortedWorlds, grouped_states, plan_kernels, sort_worlds

LARGEST_LISTS = 2**31
"""Bytes of all lists on a CPU, at most: where there would be more, each step searches anew."""


class StaticWorlds(NamedTuple):
    """What perception needs of positions that stay: sorted worlds, by `prepare_static`."""

    source: Tensor
    """Caller's index of each sorted particle, int32, shape [B N]."""
    place: Tensor
    """Sorted place of each particle in the caller's order, int32, shape [B N]."""
    everyone: Tensor
    """0, 1, ... B N - 1, int32: each sorted particle's own place."""
    starts: Tensor
    """First sorted place of every cell, int32."""
    cell: Tensor
    """Cell of each sorted particle, counted through all worlds, int32, shape [B N]."""
    particles: Tensor
    """Positions [length units] with volumes 1 / rho, shape [B N, D + 1]."""
    density_gradient: Tensor
    """Density gradients, float64, shape [B N, D]; empty where neighbours are listed for CUDA."""
    lists: list[Tensor]
    """Of `kernels/cuda/` steps, lengths and records of neighbour lists; on a CPU neighbours of each
    particle and where they end; empty elsewhere."""

    def flat(self) -> list[Tensor]:
        """Return all tensors one after the other, as a torch operator takes or returns them."""
        return [*self[:-1], *self.lists]

    @property
    def listed(self) -> ListedNeighbours | None:
        """The neighbours as the portable kernels read them, where they were listed."""
        return ListedNeighbours(*self.lists) if len(self.lists) == 2 else None

    @classmethod
    def of(cls, tensors: list[Tensor]) -> StaticWorlds:
        """Return what `flat` made a list of."""
        count = len(cls._fields) - 1
        return cls._make([*tensors[:count], tensors[count:]])


@custom_op("npa::prepare_static")
def _prepare_static(x: Tensor, state_dim: int, physics: Physics) -> list[Tensor]:
    """Return what a `StaticWorlds` holds."""
    total = x.shape[0] * x.shape[1]
    plan = plan_kernels(x, x.shape, state_dim, total, False, physics)
    ordered = sort_worlds(plan, x, None, None)
    densities = compute_densities(plan, ordered)
    lists: list[Tensor] = []
    if densities.lists is not None:
        lists = [densities.lists.steps, densities.lists.lengths, densities.lists.records]
    elif plan.on_cpu:
        lists = _list_neighbours(plan, ordered.starts, densities.particles)
    return StaticWorlds(
        source=ordered.source,
        place=ordered.row_of,
        everyone=torch.arange(total, dtype=torch.int32, device=x.device),
        starts=ordered.starts,
        # Outputs of an operator share no memory.
        cell=ordered.cell.clone(),
        particles=densities.particles,
        density_gradient=densities.density_gradient,
        lists=lists,
    ).flat()


def _list_neighbours(plan: KernelPlan, starts: Tensor, particles: Tensor) -> list[Tensor]:
    """List the neighbours of each particle on a CPU, where reading their number is free."""
    kernels = density_kernels(plan.space_dim, plan.scalar, plan.on_cpu)
    common = plan.total, particles.device, plan.domain, plan.particle_count, starts, particles
    counts = starts.new_empty(plan.total)
    launch(kernels.count_neighbours, *common, starts.new_empty(0), counts)
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    if 4 * int(ends[-1]) > LARGEST_LISTS:
        return []
    neighbours = starts.new_empty(int(ends[-1]))
    ends = ends.to(torch.int32)
    launch(kernels.list_neighbours, *common, ends, neighbours)
    return [neighbours, ends]


@_prepare_static.register_fake
def _(x: Tensor, state_dim: int, physics: Physics) -> list[Tensor]:
    total, space_dim = x.shape[0] * x.shape[1], x.shape[2]
    plan = plan_kernels(x, x.shape, state_dim, total, False, physics)

    def integers(count: int | torch.SymInt) -> Tensor:
        return x.new_empty(count, dtype=torch.int32)

    lists: list[Tensor] = []
    on_cuda = plan.lists_neighbours
    if on_cuda:
        shape = plan.listing.shape(total)
        lists = [x.new_empty(shape, dtype=torch.int16), integers(total), x.new_empty(total, 4)]
    elif plan.on_cpu:
        lists = [integers(torch.library.get_ctx().new_dynamic_size()), integers(total)]
    return StaticWorlds(
        source=integers(total),
        place=integers(total),
        everyone=integers(total),
        starts=integers(plan.start_count),
        cell=integers(total),
        particles=x.new_empty(total, space_dim + 1),
        density_gradient=x.new_empty(0 if on_cuda else total, space_dim, dtype=torch.float64),
        lists=lists,
    ).flat()


def prepare_static(x: Tensor, physics: Physics) -> StaticWorlds:
    """Sort checked worlds whose particles do not move, and list their neighbours; no gradient."""
    return StaticWorlds.of(_prepare_static(x.detach().contiguous(), physics.state_dim, physics))


class StaticRows(NamedTuple):
    """Which sorted particles a step's rows stand for."""

    row_of: Tensor
    """Row of each sorted particle, -1 where it has none, int32, shape [B N]."""
    row_source: Tensor
    """Sorted particle of each row, int32, shape [K]; undefined beyond the last active row."""
    starts: Tensor
    """First sorted place of every cell, then first row of every cell (shifted), int32."""
    row_positions: Tensor
    """Positions of the rows [length units], shape [K, D]; undefined beyond the last active row."""


@custom_op("npa::static_rows")
def _static_rows(
    x: Tensor, masks: Tensor, source: Tensor, cell_starts: Tensor, row_capacity: int
) -> list[Tensor]:
    """Return what `StaticRows` hold, of all steps, and how many particles each step updates."""
    step_count, total, space_dim = masks.shape[0], source.shape[0], x.shape[2]
    active = masks.view(step_count, total).index_select(1, source)
    # Of all steps at once: torch sums one long row fastest.
    active_before = torch.cumsum(active.view(-1), 0, dtype=torch.int32)
    rows = _empty_rows(x, step_count, cell_starts, row_capacity)
    launch(
        give_rows(space_dim, scalar_type(x.dtype)),
        (step_count, max(total, rows[2].shape[1])),
        x.device,
        total,
        cell_starts.shape[0] - 1,
        active_before,
        cell_starts,
        x,
        *rows,
    )
    return [*rows, active_before.view(step_count, total)[:, -1].diff(prepend=rows[0].new_zeros(1))]


@_static_rows.register_fake
def _(
    x: Tensor, masks: Tensor, source: Tensor, cell_starts: Tensor, row_capacity: int
) -> list[Tensor]:
    rows = _empty_rows(x, masks.shape[0], cell_starts, row_capacity)
    return [*rows, source.new_empty(masks.shape[0])]


def _empty_rows(
    x: Tensor, step_count: int, cell_starts: Tensor, row_capacity: int
) -> tuple[Tensor, ...]:
    integers = cell_starts.new_empty
    return (
        integers(step_count, x.shape[0] * x.shape[1]),
        integers(step_count, row_capacity),
        integers(step_count, 2 * cell_starts.shape[0] - 1),
        x.new_empty(step_count, row_capacity, x.shape[2]),
    )


def static_rows(
    worlds: StaticWorlds, x: Tensor, masks: list[Tensor], row_capacity: int
) -> list[StaticRows]:
    """Give the active particles of each of some steps rows, all steps at once.

    Masks are in the caller's order. There are `row_capacity` rows on CUDA, and active particles
    beyond them get none; on a CPU each step has as many as it needs, at least one.
    """
    if not x.is_cuda:
        row_capacity = x.shape[0] * x.shape[1]
    *rows, active = _static_rows(x, torch.stack(masks), worlds.source, worlds.starts, row_capacity)
    steps = [StaticRows(*step) for step in zip(*rows, strict=True)]
    if x.is_cuda:
        return steps
    # Reading the number of rows is free on the CPU; on CUDA it would stall the stream.
    return [
        step._replace(
            row_source=step.row_source[: max(count, 1)],
            row_positions=step.row_positions[: max(count, 1)],
        )
        for step, count in zip(steps, active.tolist(), strict=True)
    ]


def all_rows(worlds: StaticWorlds, x: Tensor) -> StaticRows:
    """Return the rows of a step in which all particles of worlds at x are active."""
    return StaticRows(worlds.everyone, worlds.everyone, worlds.starts, x.flatten(0, 1))


def static_worlds(
    plan: KernelPlan, worlds: StaticWorlds, rows: StaticRows, x: Tensor, s: Tensor
) -> tuple[SortedWorlds, Densities]:
    """Return what the perception pass of a step reads."""
    lists = None
    if plan.lists_neighbours:
        steps, lengths, records = worlds.lists
        lists = NeighbourLists(plan.listing, steps, lengths, records, by_place=True)
    ordered = SortedWorlds(
        starts=rows.starts,
        source=worlds.everyone,
        cell=worlds.cell,
        row_of=rows.row_of,
        row_source=rows.row_source,
        row_place=rows.row_source,
        positions=x.view(plan.total, plan.space_dim),
        row_positions=rows.row_positions,
        states=grouped_states(plan, s),
    )
    return ordered, Densities(worlds.particles, worlds.density_gradient, lists, worlds.listed)
