"""Worlds whose particles never move: all that follows from positions, computed once."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.portable.static import ENTRY_SIZE, pair_kernels
from npa_envs.sph.bridge import launch
from npa_envs.sph.cells import LARGEST_INDEX, Plan, density_scale, make_plan, sort_worlds
from npa_envs.sph.passes import Terms, compute_density_gradients

CAPACITY = 128
"""Neighbours that a particle's list has room for on CUDA: a longer one is not kept."""

AHEAD = 4
"""Entries that threads of CUDA ask for together."""

LARGEST_LISTS = 2**31
"""Bytes of all lists, at most."""

LARGEST_PADDING = 4
"""Columns of a row beyond what is perceived, at most."""


class SettledTensors(NamedTuple):
    """What follows from positions, as tensors in this order; particles are sorted."""

    source: Tensor
    """Caller's index of each sorted particle, int32, shape [B N]."""
    place: Tensor
    """Sorted place of each particle in the caller's order, int32, shape [B N]."""
    starts: Tensor
    """First sorted place of every cell, int32."""
    particles: Tensor
    """Positions [length units] with volumes 1 / rho, shape [B N, D + 1]."""
    weights: Tensor
    """Of each neighbour v W and v K [1 / length units], and in 2D its place, shape [E, 4]."""
    neighbours: Tensor
    """Place of each neighbour, int32, shape [E]; empty in 2D."""
    ends: Tensor
    """Where each list ends, int32, shape [B N]; empty where each has as much room."""
    lengths: Tensor
    """Entries of each list, -1 where it is not kept, int32, shape [B N]."""
    kernel_sum: Tensor
    """Sums of v K [1 / length units], shape [B N, D]."""
    correction: Tensor
    """What corrects state gradients, dimensionless, shape [B N, D, D]; empty where nothing does."""
    density_columns: Tensor
    """Scaled density gradients, dimensionless, shape [B N, D]; empty where not perceived."""


class SettledWorlds(NamedTuple):
    """Worlds made ready for steps that change states alone; `settle` makes it."""

    tensors: SettledTensors
    """What follows from positions."""
    shape: tuple[int, int, int]
    """Worlds B, particles of each N, space dimension D."""
    state_dim: int
    """State channels C."""
    capacity: int
    """Room of each list, 0 where they end at `ends`."""
    eps: float
    """Perception radius [length units]."""
    scale: float
    """c = eps / eps0, dimensionless."""
    box: tuple[float, ...] | None
    """Sides of the periodic box [length units], or None in open space."""
    terms: Terms
    """Groups of the perception vector."""

    @property
    def total(self) -> int:
        """Particles of all worlds, B N."""
        return self.shape[0] * self.shape[1]


def entries_ahead(plan: Plan) -> int:
    """Return how many entries of lists are asked for together."""
    return AHEAD if plan.lanes > 1 else 1


def list_capacity(x: Tensor) -> int:
    """Return how much room each list has; 0: as much as it needs, which only a CPU can tell."""
    return CAPACITY if x.is_cuda else 0


def _entry_bytes(x: Tensor) -> int:
    return ENTRY_SIZE * x.element_size() + (4 if x.shape[-1] == 3 else 0)


def _kernels(plan: Plan, moment_inverse: str | None) -> Any:
    return pair_kernels(
        plan.space_dim, plan.scalar, plan.lanes, entries_ahead(plan), moment_inverse
    )


@torch.library.custom_op("npa::sort_settled", mutates_args=())
def _sort_settled(
    x: Tensor,
    state_dim: int,
    eps: float,
    box: list[float] | None,
    moment_inverse: str | None,
    density_gradient: bool,
    counted: bool,
) -> list[Tensor]:
    """Return the first four of `SettledTensors`, density gradients, and ends of lists if asked."""
    total = x.shape[0] * x.shape[1]
    plan = make_plan(x, x.shape, state_dim, total, False, eps, box)
    ordered = sort_worlds(plan, x, None, None)
    terms = Terms(density_gradient=density_gradient)
    densities = compute_density_gradients(plan, ordered, terms)
    lengths = x.new_empty(total if counted else 0, dtype=torch.int32)
    if counted:
        launch(
            _kernels(plan, moment_inverse).count_pairs,
            total,
            x.device,
            plan.domain,
            plan.particle_count,
            ordered.starts,
            densities.particles,
            lengths,
        )
    return [
        ordered.source,
        ordered.row_of,
        ordered.starts,
        densities.particles,
        densities.row_density_gradient,
        torch.cumsum(lengths, 0, dtype=torch.int64),
    ]


@_sort_settled.register_fake
def _(
    x: Tensor,
    state_dim: int,
    eps: float,
    box: list[float] | None,
    moment_inverse: str | None,
    density_gradient: bool,
    counted: bool,
) -> list[Tensor]:
    total, space_dim = x.shape[0] * x.shape[1], x.shape[2]
    plan = make_plan(x, x.shape, state_dim, total, False, eps, box)
    return [
        x.new_empty(total, dtype=torch.int32),
        x.new_empty(total, dtype=torch.int32),
        x.new_empty(plan.start_count, dtype=torch.int32),
        x.new_empty(total, space_dim + 1),
        x.new_empty(total, space_dim, dtype=torch.float64),
        x.new_empty(total if counted else 0, dtype=torch.int64),
    ]


def _empty_lists(
    particles: Tensor, entry_count: int, moment_inverse: str | None, density_gradient: bool
) -> list[Tensor]:
    """Return what listing fills in: weights, neighbours, lengths, and what else is kept."""
    total, space_dim = particles.shape[0], particles.shape[1] - 1
    integers = torch.int32
    return [
        particles.new_empty(entry_count, ENTRY_SIZE),
        particles.new_empty(entry_count if space_dim == 3 else 0, dtype=integers),
        particles.new_empty(total, dtype=integers),
        particles.new_empty(total, space_dim),
        particles.new_empty(0 if moment_inverse is None else total, space_dim, space_dim),
        particles.new_empty(total if density_gradient else 0, space_dim),
    ]


@torch.library.custom_op("npa::list_pairs", mutates_args=())
def _list_pairs(
    starts: Tensor,
    particles: Tensor,
    gradients: Tensor,
    ends: Tensor,
    entry_count: int,
    capacity: int,
    shape: list[int],
    state_dim: int,
    eps: float,
    scale: float,
    box: list[float] | None,
    moment_inverse: str | None,
    density_gradient: bool,
) -> list[Tensor]:
    plan = make_plan(particles, shape, state_dim, particles.shape[0], False, eps, box)
    lists = _empty_lists(particles, entry_count, moment_inverse, density_gradient)
    launch(
        _kernels(plan, moment_inverse).list_pairs,
        plan.total,
        particles.device,
        plan.domain,
        plan.particle_count,
        capacity,
        int(density_gradient),
        density_scale(scale, plan.space_dim, plan.particle_count),
        starts,
        particles,
        gradients,
        ends,
        *lists,
    )
    return lists


@_list_pairs.register_fake
def _(
    starts: Tensor,
    particles: Tensor,
    gradients: Tensor,
    ends: Tensor,
    entry_count: int,
    *options: Any,
) -> list[Tensor]:
    return _empty_lists(particles, entry_count, *options[-2:])


def settle(
    x: Tensor,
    state_dim: int,
    *,
    eps: float,
    eps0: float,
    box: tuple[float, ...] | None,
    terms: Terms,
) -> SettledWorlds | None:
    """Sort checked worlds whose particles will not move, and weigh all pairs of neighbours.

    No gradient flows into positions. On the CPU lists are as long as they need to be, which on CUDA
    would stall the stream.

    Args:
        x: Positions [length units], shape [B, N, D].
        state_dim: State channels C.
        eps: Perception radius [length units].
        eps0: Radius at which the rule was trained [length units].
        box: Sides of the periodic box [length units], or None in open space.
        terms: Groups of the perception vector.

    Returns:
        The worlds, or None where the lists would take more than `LARGEST_LISTS` bytes, or all rows
        more numbers than kernels index.
    """
    x = x.detach().contiguous()
    world_count, particle_count, space_dim = x.shape
    total = world_count * particle_count
    capacity = list_capacity(x)
    sides = None if box is None else list(box)
    row_numbers = total * (terms.perception_dim(space_dim, state_dim) + LARGEST_PADDING)
    if row_numbers >= LARGEST_INDEX or total * capacity * _entry_bytes(x) > LARGEST_LISTS:
        return None
    source, place, starts, particles, gradients, ends = _sort_settled(
        x, state_dim, eps, sides, terms.correction, terms.density_gradient, capacity == 0
    )
    # Reading the number is free on the CPU.
    entry_count = total * capacity if capacity else int(ends[-1])
    if entry_count * _entry_bytes(x) > LARGEST_LISTS:
        return None
    ends = ends.to(torch.int32)
    weights, neighbours, *rest = _list_pairs(
        starts,
        particles,
        gradients,
        ends,
        entry_count,
        capacity,
        list(x.shape),
        state_dim,
        eps,
        eps / eps0,
        sides,
        terms.correction,
        terms.density_gradient,
    )
    tensors = SettledTensors(source, place, starts, particles, weights, neighbours, ends, *rest)
    shape = world_count, particle_count, space_dim
    return SettledWorlds(tensors, shape, state_dim, capacity, eps, eps / eps0, box, terms)
