"""The density and the perception pass over sorted worlds: kernels and their arguments."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.access import CUDA_LANES, WARP
from npa_envs.kernels.cuda.density import LIST_BLOCK, listed_density
from npa_envs.kernels.cuda.perceive import listed_perception
from npa_envs.kernels.cuda.tiles import TILE, tiled_density
from npa_envs.kernels.portable.density import density_kernels
from npa_envs.kernels.portable.perceive import perception_kernels
from npa_envs.ops.backend import Listing
from npa_envs.ops.launch import launch
from npa_envs.ops.physics import Terms
from npa_envs.ops.sort import KernelPlan, SortedWorlds, density_scale

LISTS_TOGETHER = 32
"""Neighbour lists that lie together."""


class NeighbourLists(NamedTuple):
    """The neighbours of each row's particle, itself included."""

    listing: Listing
    """How they were listed."""
    steps: Tensor
    """Steps to neighbours in the sorted order, int16: 32 particles together, or, of tiles, list
    after list."""
    lengths: Tensor
    """Neighbours of each row's particle, int32, [K]."""
    records: Tensor
    """Sorted positions with volumes, and in 2D places of states, shape [B N, 4]."""
    by_place: bool = False
    """There is a list for each sorted particle, not for each row."""


class ListedNeighbours(NamedTuple):
    """The neighbours of each sorted particle, itself included, for the portable kernels."""

    neighbours: Tensor
    """Their places in the sorted order, int32, shape [E]."""
    ends: Tensor
    """Where each particle's neighbours end, int32, shape [B N]."""


class Densities(NamedTuple):
    """What the density pass leaves for perception."""

    particles: Tensor
    """Sorted positions with volumes 1 / rho, shape [B N, D + 1]; empty where nobody asked."""
    density_gradient: Tensor
    """Density gradients of sorted particles that have rows, float64, shape [B N, D]; undefined of
    the others; empty where perception computes them."""
    lists: NeighbourLists | None = None
    """What the density pass of `kernels/cuda/` found of neighbours."""
    listed: ListedNeighbours | None = None
    """The neighbours of static worlds on a CPU."""


def portable_kernels(plan: KernelPlan, terms: Terms, listed: bool = False) -> Any:
    """Return the portable perception kernels of a plan."""
    return perception_kernels(
        plan.space_dim,
        plan.scalar,
        plan.width,
        plan.on_cpu,
        terms.state_gradient,
        terms.correction,
        listed,
    )


def compute_densities(
    plan: KernelPlan,
    ordered: SortedWorlds,
    terms: Terms,
    listing: Listing,
    *,
    state_place: Tensor | None = None,
    with_particles: bool = True,
) -> Densities:
    """Compute densities, and neighbour lists or the rows' density gradients for perception.

    Args:
        plan: Plan of the call.
        ordered: The sorted worlds.
        terms: Groups of the perception that follows.
        listing: How to list neighbours, where the plan says so.
        state_place: Where the states of sorted particles are, int32, shape [B N]; None: in order.
        with_particles: Also leave `particles` where neighbours are listed: the adjoint reads them.
    """
    if not plan.lists_neighbours:
        return compute_density_gradients(plan, ordered, terms)
    return list_neighbours(plan, ordered, listing, state_place, with_particles)


def list_neighbours(
    plan: KernelPlan,
    ordered: SortedWorlds,
    listing: Listing,
    state_place: Tensor | None,
    with_particles: bool,
) -> Densities:
    """Compute densities, and list the neighbours of the rows: `compute_densities` on CUDA."""
    positions = ordered.positions
    records = positions.new_empty(plan.total, 4)
    particles = positions.new_empty(plan.total if with_particles else 0, plan.space_dim + 1)
    steps = positions.new_empty(listing.shape(plan.row_capacity), dtype=torch.int16)
    lengths = positions.new_empty(plan.row_capacity, dtype=torch.int32)
    where = (
        ordered.starts,
        ordered.cell,
        positions,
        state_place,
        ordered.source,
        ordered.row_of,
        particles,
        records,
        steps,
        lengths,
    )
    if listing.tiled:
        launch(
            tiled_density(plan.periodic, listing.capacity, plan.masked),
            plan.world_count * -(-plan.particle_count // TILE) * WARP,
            positions.device,
            plan.domain,
            plan.particle_count,
            *where,
            block_dim=WARP,
        )
    else:
        launch(
            listed_density(
                plan.space_dim, listing.lanes, plan.periodic, listing.capacity, plan.masked
            ),
            -(-plan.total * listing.lanes // WARP) * WARP,
            positions.device,
            plan.domain,
            *where,
            block_dim=LIST_BLOCK,
        )
    no_gradient = positions.new_empty(0, plan.space_dim, dtype=torch.float64)
    return Densities(particles, no_gradient, NeighbourLists(listing, steps, lengths, records))


def compute_density_gradients(plan: KernelPlan, ordered: SortedWorlds, terms: Terms) -> Densities:
    """Compute densities, and density gradients of the particles that have rows."""
    positions = ordered.positions
    particles = positions.new_empty(plan.total, plan.space_dim + 1)
    density_gradient = positions.new_empty(plan.total, plan.space_dim, dtype=torch.float64)
    launch(
        density_kernels(plan.space_dim, plan.scalar, plan.on_cpu).compute_density,
        plan.total,
        positions.device,
        plan.domain,
        plan.particle_count,
        int(terms.density_gradient),
        ordered.starts,
        ordered.source,
        ordered.row_of,
        positions,
        particles,
        density_gradient,
    )
    return Densities(particles, density_gradient)


def perception_launch(
    plan: KernelPlan,
    ordered: SortedWorlds,
    densities: Densities,
    terms: Terms,
    scale: float,
    out: Tensor,
    *,
    states: Tensor | None = None,
    destination: Tensor | None = None,
    limit: float = 0.0,
    row_kernel_sum: Tensor | None = None,
    first_row: int = 0,
    row_count: int | None = None,
) -> tuple[Any, ...]:
    """Return what to give to `launch` so that it writes the perception of each row, or of some.

    Args:
        plan: Plan of the call.
        ordered: The sorted worlds.
        densities: Their densities.
        terms: Groups of the perception vector.
        scale: c = eps / eps0, dimensionless.
        out: Rows to write, shape [K, row_width].
        states: States in the caller's order, where `ordered` has none.
        destination: Row of `out` for each row, int32, shape [K]; default: its own.
        limit: Entries are clipped to plus and minus this; 0: they are not.
        row_kernel_sum: Where to write the rows' sums of v K, shape [K, D], for the adjoint.
        first_row: What is written into the first row of `out`, a multiple of `LISTS_TOGETHER`.
        row_count: Rows to write, where they are not all.
    """
    some = row_count is not None
    row_count = plan.row_capacity if row_count is None else row_count
    row_place = ordered.row_place[first_row:] if plan.masked or some else None
    numbers = (
        plan.state_dim,
        int(terms.density_gradient),
        scale,
        density_scale(scale, plan.space_dim, plan.particle_count),
        plan.row_base + first_row,
    )
    lists = densities.lists
    if lists is not None and some:
        shifted = lists.steps[first_row // LISTS_TOGETHER :], lists.lengths[first_row:]
        lists = lists._replace(steps=shifted[0], lengths=shifted[1])
    if lists is not None:
        kernel = listed_perception(
            plan.space_dim,
            plan.width,
            CUDA_LANES,
            terms.state_gradient,
            terms.correction,
            plan.periodic,
            plan.group_count > 1,
            lists.listing.capacity,
            row_kernel_sum is not None,
            lists.listing.teams,
            lists.by_place,
            lists.listing.tiled,
        )
        threads = row_count * plan.group_count * CUDA_LANES * lists.listing.teams
        source = ordered.states if states is None else states
        return (
            kernel,
            -(-threads // WARP) * WARP,
            out.device,
            plan.domain,
            *numbers,
            row_count,
            plan.group_count,
            limit,
            ordered.starts,
            ordered.cell,
            ordered.positions,
            lists.records,
            source,
            None if states is None else ordered.source,
            row_place,
            destination,
            lists.steps,
            lists.lengths,
            out,
            row_kernel_sum,
        )
    listed = densities.listed
    return (
        portable_kernels(plan, terms, listed is not None).perceive,
        (row_count, plan.group_count),
        out.device,
        plan.domain,
        plan.particle_count,
        *numbers,
        plan.group_count,
        limit,
        ordered.starts,
        None if listed is None else listed.ends,
        None if listed is None else listed.neighbours,
        densities.particles,
        ordered.states,
        ordered.states.view(plan.total, -1),
        row_place,
        destination,
        densities.density_gradient,
        out,
        row_kernel_sum,
    )
