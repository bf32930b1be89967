"""Perception of each species separately: its density and its density gradient."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import (
    Box,
    as_list,
    check_finite_positions,
    check_world,
    checked_count,
    checked_eps,
)
from npa_envs.errors import NPAError, shown
from npa_envs.kernels.portable.density import species_kernel
from npa_envs.ops.custom_op import check_derivatives, custom_op
from npa_envs.ops.launch import SCALARS, launch
from npa_envs.ops.perceive import perceive
from npa_envs.ops.physics_constants import Physics, make_physics
from npa_envs.ops.sort import plan_kernels, sort_worlds

MAX_SPECIES = 64
"""Most species of a world: a thread has a sum for each."""


class SpeciesFields(NamedTuple):
    """The unscaled density of each species and its gradient at every particle."""

    rho: Tensor
    """Density of each species [1 / length^D], shape [B, N, K]; they sum to the density."""
    drho: Tensor
    """Density gradient of each species [1 / length^(D+1)], shape [B, N, K, D]."""


def checked_counts(counts: Sequence[int], particle_count: int) -> tuple[int, ...]:
    """Return how many particles each species has, integers of at least 1 that sum to N."""
    numbers = as_list(counts)
    if numbers is None:
        raise NPAError(
            f"counts must have one number of particles for each species, got {shown(counts)}: "
            f"for example counts=({particle_count},)"
        )
    checked = tuple(checked_count("an entry of counts", count) for count in numbers)
    if not 1 <= len(checked) <= MAX_SPECIES:
        raise NPAError(f"counts must name 1 to {MAX_SPECIES} species, got {len(checked)}")
    if min(checked) < 1:
        raise NPAError(
            f"counts must be at least 1 for every species, got {checked}: leave the empty one out"
        )
    if sum(checked) != particle_count:
        raise NPAError(
            f"counts must sum to the {particle_count} particles of a world, got {checked}, "
            f"which sum to {sum(checked)}"
        )
    return checked


@custom_op("npa::gather_species")
def _gather_species(
    x: Tensor, counts: list[int], physics: Physics, scaled: bool
) -> tuple[Tensor, Tensor]:
    """Return densities [B, N, K] and their gradients [B, N, K, D]; `scaled`: as in perception."""
    world_count, particle_count, space_dim = map(int, x.shape)
    plan = plan_kernels(x, x.shape, 1, world_count * particle_count, False, physics)
    ordered = sort_worlds(plan, x, None, None, with_rows=False)
    index_in_world = ordered.source % particle_count
    sorted_species = torch.zeros_like(index_in_world)
    # Python numbers instead of a tensor: a CUDA graph must not copy from the host.
    for end in itertools.accumulate(counts[:-1]):
        sorted_species += index_in_world >= end
    density = x.new_empty(plan.total, len(counts))
    gradient = x.new_empty(plan.total, len(counts), space_dim)
    launch(
        species_kernel(space_dim, SCALARS[x.dtype], len(counts)),
        plan.total,
        x.device,
        plan.domain,
        particle_count,
        physics.scale() ** space_dim / particle_count if scaled else 1.0,
        plan.density_scale if scaled else 1.0,
        int(scaled),
        ordered.starts,
        ordered.source,
        sorted_species,
        ordered.positions,
        density,
        gradient,
    )
    shape = (world_count, particle_count, len(counts))
    return density.view(shape), gradient.view(*shape, space_dim)


def perceive_by_species(x: Tensor, counts: tuple[int, ...], physics: Physics) -> Tensor:
    """Return the scaled density and density gradient of each species, shape [B, N, K (1 + D)].

    Entries are c^D ρ_k / N for all species, then L(c^(1+D) ∇ρ_k / N) species by species. A species
    may have no particles. No gradient flows into positions.
    """
    density, gradient = _gather_species(x.detach().contiguous(), list(counts), physics, True)
    return torch.cat((density, gradient.flatten(2)), dim=-1)


def species_fields(
    x: Tensor, counts: Sequence[int], *, eps: float, box: Box = None
) -> SpeciesFields:
    """Return each species' density and density gradient at every particle; not differentiable.

    A particle counts itself in its own species' density. The densities sum to the density of
    `perception_fields`, and the gradients to its density gradient.

    Args:
        x: Particle positions [length units], shape [B, N, D], species after species.
        counts: Particles of each species, K numbers that sum to N: species k is the next
            `counts[k]` particles.
        eps: Perception radius [length units].
        box: Sides of a periodic box centred on the origin [length units], or None for open space.

    Raises:
        NPAError: Positions or counts do not fit, a position is not finite, eps is not positive and
            finite, or a box side is below 2 eps.
    """
    check_world(x, x)
    check_derivatives(x=x)
    checked = checked_counts(counts, x.shape[1])
    constants = make_physics(x.shape[2], 1, x.dtype, eps=eps, box=box)
    check_finite_positions(x)
    return SpeciesFields(*_gather_species(x.detach().contiguous(), list(checked), constants, False))


def perceive_species(
    x: Tensor,
    s: Tensor,
    counts: Sequence[int],
    eps: float,
    eps0: float | None = None,
    box: Box = None,
    detach_positions: bool = True,
) -> Tensor:
    """Perceive neighbourhoods as `perceive`, and of each species its own density and gradient.

    z = [what `perceive` returns ; c^D ρ_k / N (K) ; L(c^(1+D) ∇ρ_k / N) (K x D, species-major)].
    No gradient flows through the added entries.

    Args:
        x: Particle positions [length units], shape [B, N, D], species after species.
        s: Particle states, dimensionless, shape [B, N, C].
        counts: Particles of each species, K numbers that sum to N.
        eps: Perception radius [length units].
        eps0: Radius at which the rules were trained [length units]; default: eps.
        box: Sides of a periodic box centred on the origin [length units], a number for equal
            sides, or None for open space.
        detach_positions: Do not back-propagate into x.

    Returns:
        Perception vectors, dimensionless, shape [B, N, P + K (1 + D)].

    Raises:
        NPAError: As `perceive`, or the counts do not fit.
    """
    check_world(x, s)
    check_derivatives(x=x, s=s)
    checked = checked_counts(counts, x.shape[1])
    if eps0 is not None:
        eps0 = checked_eps("eps0", eps0, x.shape[2], x.dtype)
    constants = make_physics(x.shape[2], s.shape[2], x.dtype, eps=eps, eps0=eps0, box=box)
    shared = perceive(x, s, constants.eps, constants.eps0, constants.box, detach_positions)
    appended = perceive_by_species(x, checked, constants)
    return torch.cat((shared, appended), dim=-1)
