"""The two passes of perception over sorted worlds: which kernels run, and with what."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.access import WARP
from npa_envs.kernels.cuda.density import listed_density
from npa_envs.kernels.cuda.perceive import listed_perception
from npa_envs.kernels.portable.perceive import perception_kernels
from npa_envs.ops.launch import launch
from npa_envs.ops.sort import Plan, SortedWorlds, density_scale

CAPACITY, LARGE_CAPACITY, HUGE_CAPACITY = 64, 128, 96
"""Neighbours that lists have room for: in small worlds of a batch, elsewhere, in huge worlds."""

SMALL_WORLD = 2048
"""Particles of a small world."""

SHARED_WORLD = 4096
"""Particles of worlds that are often rolled out few at a time: several threads share a particle."""

HUGE_WORLD = 2**22
"""Particles of the largest world whose lists of neighbours may take more memory than its rows."""


class Terms(NamedTuple):
    """Which groups of the perception vector a rule reads: the others are not computed."""

    state_gradient: bool = True
    moment_inverse: str | None = "threshold"
    density_gradient: bool = True

    @property
    def correction(self) -> str | None:
        """How the state gradient is corrected, "threshold" or "smooth"; None: not at all."""
        return self.moment_inverse if self.state_gradient else None

    def perception_dim(self, space_dim: int, state_dim: int) -> int:
        """Length P of a perception vector with these groups."""
        gradients = state_dim * space_dim * self.state_gradient
        return 2 * state_dim + gradients + space_dim * self.density_gradient


class Listing(NamedTuple):
    """How neighbours are listed, and how threads share particles, on CUDA.

    It follows from the size of a world alone: the sums of a world, taken in the order that this
    gives, are the same in every batch.
    """

    capacity: int
    """Neighbours that a list has room for: what is longer, perception searches for again."""
    lanes: int
    """Threads of a particle in the density pass."""
    teams: int
    """Teams of lanes of a row in the perception pass."""


class NeighbourLists(NamedTuple):
    """The neighbours of each row's particle, itself included."""

    listing: Listing
    """How they were listed."""
    steps: Tensor
    """Steps to neighbours in the sorted order, int16; 32 particles together."""
    lengths: Tensor
    """Neighbours of each row's particle, int32, [K]."""
    records: Tensor
    """Sorted positions with volumes, and in 2D places of states, shape [B N, 4]."""


class Densities(NamedTuple):
    """What the density pass leaves for perception."""

    particles: Tensor
    """Sorted positions with volumes 1 / rho, shape [B N, D + 1]; empty where nobody asked."""
    row_density_gradient: Tensor
    """Density gradients of the rows, float64, [K, D]; empty where perception computes them."""
    lists: NeighbourLists | None = None
    """What the density pass found of neighbours."""


def plain_kernels(plan: Plan, terms: Terms) -> Any:
    """Return the plain kernels of a plan."""
    return perception_kernels(
        plan.space_dim,
        plan.scalar,
        plan.width,
        plan.lanes,
        terms.state_gradient,
        terms.correction,
    )


def rollout_listing(plan: Plan) -> Listing:
    """Return how rollouts list neighbours: few worlds shall fill a device, too."""
    if plan.particle_count <= SHARED_WORLD:
        return Listing(LARGE_CAPACITY, lanes=plan.lanes, teams=2)
    # The lists of worlds that fill a device's memory would be the largest part of it.
    huge = plan.particle_count > HUGE_WORLD
    return Listing(HUGE_CAPACITY if huge else LARGE_CAPACITY, lanes=1, teams=1)


def batch_listing(plan: Plan) -> Listing:
    """Return how environments list neighbours: whole batches fill a device with less."""
    small = plan.particle_count <= SMALL_WORLD
    return Listing(CAPACITY if small else LARGE_CAPACITY, lanes=1, teams=1)


def compute_densities(
    plan: Plan,
    ordered: SortedWorlds,
    terms: Terms,
    listing: Listing,
    *,
    state_place: Tensor | None = None,
    with_particles: bool = True,
) -> Densities:
    """Compute densities, and what perception wants besides: lists or the rows' density gradients.

    Args:
        plan: Plan of the call.
        ordered: The sorted worlds.
        terms: Groups of the perception that follows.
        listing: How to list neighbours, where the plan says so.
        state_place: Where the states of sorted particles are, int32, shape [B N]; None: in order.
        with_particles: Also leave `particles` where neighbours are listed: the adjoint reads them.
    """
    if not plan.listed:
        return compute_density_gradients(plan, ordered, terms)
    return list_neighbours(plan, ordered, listing, state_place, with_particles)


def list_neighbours(
    plan: Plan,
    ordered: SortedWorlds,
    listing: Listing,
    state_place: Tensor | None,
    with_particles: bool,
) -> Densities:
    """Compute densities, and list the neighbours of the rows: `compute_densities` on CUDA."""
    capacity, lanes, _ = listing
    positions = ordered.positions
    records = positions.new_empty(plan.total, 4)
    particles = positions.new_empty(plan.total if with_particles else 0, plan.space_dim + 1)
    blocks = -(-plan.row_capacity // WARP)
    steps = positions.new_empty(blocks, capacity, WARP, dtype=torch.int16)
    lengths = positions.new_empty(plan.row_capacity, dtype=torch.int32)
    launch(
        listed_density(plan.space_dim, lanes, plan.periodic, capacity, plan.masked),
        -(-plan.total * lanes // WARP) * WARP,
        positions.device,
        plan.domain,
        ordered.starts,
        ordered.cell,
        positions,
        state_place,
        ordered.source,
        ordered.row_of,
        particles,
        records,
        steps.view(-1),
        lengths,
    )
    no_gradient = positions.new_empty(0, plan.space_dim, dtype=torch.float64)
    return Densities(particles, no_gradient, NeighbourLists(listing, steps, lengths, records))


def compute_density_gradients(plan: Plan, ordered: SortedWorlds, terms: Terms) -> Densities:
    """Compute densities and the rows' density gradients, undefined beyond the last active row."""
    positions = ordered.positions
    particles = positions.new_empty(plan.total, plan.space_dim + 1)
    row_density_gradient = positions.new_empty(
        plan.row_capacity, plan.space_dim, dtype=torch.float64
    )
    launch(
        plain_kernels(plan, terms).compute_density,
        (plan.total, plan.lanes),
        positions.device,
        plan.domain,
        plan.particle_count,
        int(terms.density_gradient),
        ordered.starts,
        ordered.source,
        ordered.row_of,
        positions,
        particles,
        row_density_gradient,
    )
    return Densities(particles, row_density_gradient)


def perception_launch(
    plan: Plan,
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
) -> tuple[Any, ...]:
    """Return what to give to `launch` so that it writes the perception of each row.

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
    """
    common = (
        plan.domain,
        *(() if plan.listed else (plan.particle_count,)),
        plan.state_dim,
        int(terms.density_gradient),
        scale,
        density_scale(scale, plan.space_dim, plan.particle_count),
        plan.row_base,
    )
    row_place = ordered.row_place if plan.masked else None
    lists = densities.lists
    if lists is not None:
        capacity, _, teams = lists.listing
        kernel = listed_perception(
            plan.space_dim,
            plan.width,
            plan.lanes,
            terms.state_gradient,
            terms.correction,
            plan.periodic,
            plan.group_count > 1,
            capacity,
            row_kernel_sum is not None,
            teams,
        )
        threads = plan.row_capacity * plan.group_count * plan.lanes * teams
        source = ordered.states if states is None else states
        return (
            kernel,
            -(-threads // WARP) * WARP,
            out.device,
            *common,
            plan.row_capacity,
            plan.group_count,
            limit,
            ordered.starts,
            ordered.cell,
            ordered.positions,
            lists.records,
            source.view(-1, plan.width // plan.lanes),
            None if states is None else ordered.source,
            row_place,
            destination,
            lists.steps.view(-1),
            lists.lengths,
            out,
            row_kernel_sum,
        )
    return (
        plain_kernels(plan, terms).perceive,
        (plan.row_capacity, plan.group_count, plan.lanes),
        out.device,
        *common,
        plan.group_count,
        limit,
        ordered.starts,
        densities.particles,
        ordered.states,
        ordered.states.view(plan.total, -1),
        row_place,
        destination,
        densities.row_density_gradient,
        out,
        row_kernel_sum,
    )
