"""Static worlds, whose particles do not move: sorted once, with densities and neighbour lists.

They stay in sorted order from the first step to the last. Each step only assigns rows to the
active particles, and then runs the ordinary kernels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.portable.density import density_kernels
from npa_envs.kernels.portable.sort import give_rows
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import SCALARS, aligned, is_traced, launch
from npa_envs.ops.perception_passes import (
    Densities,
    NeighbourLists,
    StaticNeighbours,
    compute_densities,
)
from npa_envs.ops.physics import Physics
from npa_envs.ops.sort import KernelPlan, SortedWorlds, plan_kernels, sort_worlds

MAX_LISTS = 2**31
"""Maximum number of bytes of all lists on a CPU; with more neighbours, each step searches again."""


class StaticWorlds(NamedTuple):
    """Worlds whose particles do not move: parts of their `SortedWorlds` and `Densities`."""

    original_index: Tensor
    sorted_index: Tensor
    """Sorted index of each particle in the caller's order, int32, shape [B N]."""
    all_indices: Tensor
    """0, 1, ... B N - 1, int32: all sorted indices."""
    starts: Tensor
    cell: Tensor
    particles: Tensor
    density_gradient: Tensor
    lists: list[Tensor]
    """For the CUDA backend index differences, lengths and records of `NeighbourLists`; on a CPU the
    tensors of `StaticNeighbours`, or none if they take too much memory; none elsewhere."""

    def to_list(self) -> list[Tensor]:
        """Return all tensors in one list, for torch operators."""
        return [*self[:-1], *self.lists]

    @property
    def neighbours(self) -> StaticNeighbours | None:
        """Neighbour lists for the portable kernels, if there are any."""
        return (self.lists[0], self.lists[1]) if len(self.lists) == 2 else None

    @classmethod
    def from_list(cls, tensors: list[Tensor]) -> StaticWorlds:
        """Return the worlds from a list by `to_list`."""
        count = len(cls._fields) - 1
        return cls._make([*tensors[:count], tensors[count:]])


@custom_op("npa::prepare_static")
def _prepare_static(x: Tensor, state_dim: int, physics: Physics) -> list[Tensor]:
    total = x.shape[0] * x.shape[1]
    plan = plan_kernels(x, x.shape, state_dim, total, False, physics)
    ordered = sort_worlds(plan, x, None, None)
    densities = compute_densities(plan, ordered)
    lists: list[Tensor] = []
    if densities.lists is not None:
        lists = [*densities.lists[1:4]]
    elif plan.on_cpu:
        lists = _list_neighbours(plan, ordered.starts, densities.particles)
    return StaticWorlds(
        original_index=ordered.original_index,
        sorted_index=ordered.row_of,
        all_indices=torch.arange(total, dtype=torch.int32, device=x.device),
        starts=ordered.starts,
        # Outputs of an operator must not share memory.
        cell=ordered.cell.clone(),
        particles=densities.particles,
        density_gradient=densities.density_gradient,
        lists=lists,
    ).to_list()


def _list_neighbours(plan: KernelPlan, starts: Tensor, particles: Tensor) -> list[Tensor]:
    """Return the tensors of `StaticNeighbours`, on a CPU; empty if they take too much memory."""
    kernels = density_kernels(plan.space_dim, plan.scalar, plan.on_cpu)
    common = plan.total, particles.device, plan.domain, plan.particle_count, starts, particles
    counts = starts.new_empty(plan.total)
    launch(kernels.list_neighbours, *common, None, counts, None)
    if is_traced():
        return [starts.new_empty(torch.library.get_ctx().new_dynamic_size()), counts]
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    if 4 * int(ends[-1]) > MAX_LISTS:
        return []
    neighbours = starts.new_empty(int(ends[-1]))
    ends = ends.to(torch.int32)
    launch(kernels.list_neighbours, *common, ends, counts, neighbours)
    return [neighbours, ends]


def prepare_static(x: Tensor, physics: Physics) -> StaticWorlds:
    """Return `StaticWorlds` at positions x, which are not checked; not differentiable."""
    return StaticWorlds.from_list(
        _prepare_static(x.detach().contiguous(), physics.state_dim, physics)
    )


class StaticRows(NamedTuple):
    """The particles of static worlds that are active in one step: fields of `SortedWorlds`.

    Static worlds stay in sorted order, so indices of particles are sorted ones.
    """

    row_of: Tensor
    row_particle: Tensor
    starts: Tensor
    row_positions: Tensor


@custom_op("npa::static_rows")
def _static_rows(
    x: Tensor, masks: Tensor, original_index: Tensor, cell_starts: Tensor, row_capacity: int
) -> list[Tensor]:
    """Return `StaticRows` of all steps, stacked, and the number of active particles of each."""
    step_count, total, space_dim = masks.shape[0], original_index.shape[0], int(x.shape[2])
    active = masks.view(step_count, total).index_select(1, original_index)
    # One sum over all steps: torch is fastest on one long row.
    active_before = torch.cumsum(active.view(-1), 0, dtype=torch.int32)
    rows = (
        cell_starts.new_empty(step_count, total),
        cell_starts.new_empty(step_count, row_capacity),
        cell_starts.new_empty(step_count, 2 * cell_starts.shape[0] - 1),
        x.new_empty(step_count, row_capacity, space_dim),
    )
    kernel, size = give_rows(space_dim, SCALARS[x.dtype]), max(total, rows[2].shape[1])
    read = total, cell_starts.shape[0] - 1, active_before, cell_starts, x
    launch(kernel, (step_count, size), x.device, *read, *rows)
    return [*rows, active_before.view(step_count, total)[:, -1].diff(prepend=rows[0].new_zeros(1))]


def static_rows(
    worlds: StaticWorlds, x: Tensor, masks: list[Tensor], row_capacity: int
) -> list[StaticRows]:
    """Return for each of several steps the rows of its active particles.

    Masks, [B, N], are in the caller's order. On CUDA a step has `row_capacity` rows, and further
    active particles get none; on a CPU it has a row for each active particle, at least one.
    """
    if not x.is_cuda:
        row_capacity = x.shape[0] * x.shape[1]
    order = worlds.original_index, worlds.starts
    *rows, active = _static_rows(x, torch.stack(masks), *order, row_capacity)
    steps = [StaticRows(*step) for step in zip(*rows, strict=True)]
    if x.is_cuda:
        return steps
    # Reading the number of rows is free on a CPU; on CUDA it would wait for the device.
    counts = [max(count, 1) for count in active.tolist()]
    return [
        StaticRows(row_of, row_particle[:count], starts, row_positions[:count])
        for count, (row_of, row_particle, starts, row_positions) in zip(counts, steps, strict=True)
    ]


def static_worlds(
    plan: KernelPlan, worlds: StaticWorlds, rows: StaticRows, x: Tensor, s: Tensor
) -> tuple[SortedWorlds, Densities]:
    """Return `SortedWorlds` and `Densities` of static worlds for a step with active `rows`."""
    lists = None
    if plan.lists_neighbours:
        differences, lengths, records = worlds.lists
        lists = NeighbourLists(plan.list_layout, differences, lengths, records, per_particle=True)
    # States in groups of channels.
    padding = 0, plan.group_count * plan.width - plan.state_dim
    ordered = SortedWorlds(
        starts=rows.starts,
        original_index=worlds.all_indices,
        cell=worlds.cell,
        row_of=rows.row_of,
        row_particle=rows.row_particle,
        row_index=rows.row_particle,
        positions=x.view(plan.total, plan.space_dim),
        row_positions=rows.row_positions,
        states=aligned(torch.nn.functional.pad(s, padding)).view(-1, plan.width),
    )
    return ordered, Densities(worlds.particles, worlds.density_gradient, lists, worlds.neighbours)
