"""Perception of each species separately: its density and its density gradient."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import Box, as_list, checked_count
from npa_envs.errors import NPAError, shown
from npa_envs.kernels.portable.density import species_kernel
from npa_envs.ops.custom_op import custom_op
from npa_envs.ops.launch import SCALARS, launch
from npa_envs.ops.perceive import checked_physics, perceive
from npa_envs.ops.physics import Physics
from npa_envs.ops.position_check import checked_positions
from npa_envs.ops.sort import plan_kernels, sort_worlds

MAX_SPECIES = 64
"""Maximum number of species of a world: a thread has a sum for each."""


class SpeciesFields(NamedTuple):
    """The unscaled density of each species and its gradient at every particle."""

    rho: Tensor
    """Density of each species [1 / length^D], shape [B, N, S]; they sum to the density."""
    drho: Tensor
    """Density gradient of each species [1 / length^(D+1)], shape [B, N, S, D]."""


def checked_counts(counts: Sequence[int], particle_count: int) -> tuple[int, ...]:
    """Return the particles of each species as ints, after checking that they are N in sum."""
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
    """Return species' densities [B, N, S] and gradients [B, N, S, D]; `scaled`: for perception."""
    world_count, particle_count, space_dim = map(int, x.shape)
    plan = plan_kernels(x, x.shape, 1, world_count * particle_count, False, physics)
    ordered = sort_worlds(plan, x, None, None, with_rows=False)
    index_in_world = ordered.original_index % particle_count
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
        ordered.original_index,
        sorted_species,
        ordered.positions,
        density,
        gradient,
    )
    shape = (world_count, particle_count, len(counts))
    return density.view(shape), gradient.view(*shape, space_dim)


def perceive_by_species(x: Tensor, counts: tuple[int, ...], physics: Physics) -> Tensor:
    """Return the scaled density and density gradient of each species, shape [B, N, S (1 + D)].

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
    `perception_fields`, and the gradients to its density gradient. Arguments and errors are those
    of `perceive_species`.
    """
    physics = checked_physics(x, x, eps, None, box)
    sizes = checked_counts(counts, x.shape[1])
    with checked_positions(x):
        fields = _gather_species(x.detach().contiguous(), list(sizes), physics, False)
    return SpeciesFields(*fields)


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

    z = [what `perceive` returns ; c^D ρ_k / N (S) ; L(c^(1+D) ∇ρ_k / N) (S x D, species-major)].
    No gradient flows through the added entries. Arguments and errors are those of `perceive`, and:

    Args:
        counts: Particles of each of S species, numbers that sum to N: species k is the next
            `counts[k]` particles.

    Returns:
        Perception vectors, dimensionless, shape [B, N, P + S (1 + D)].
    """
    physics = checked_physics(x, s, eps, eps0, box)
    sizes = checked_counts(counts, x.shape[1])
    shared = perceive(x, s, physics.eps, physics.eps0, physics.box, detach_positions)
    return torch.cat((shared, perceive_by_species(x, sizes, physics)), dim=-1)
