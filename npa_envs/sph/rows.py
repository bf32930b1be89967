"""Perception of every particle, in the caller's order and clipped; without gradients."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from npa_envs.sph.cells import Plan, SortedWorlds, make_plan, sort_worlds
from npa_envs.sph.passes import (
    Densities,
    Terms,
    compute_density,
    list_capacity,
    list_neighbours,
    write_perception,
)

DENSITY_LANES = 1
"""Threads of a particle in the density pass: whole batches fill the device without more."""


class Surveyed(NamedTuple):
    """Worlds made ready for perception: sorted, their densities known."""

    plan: Plan
    ordered: SortedWorlds
    densities: Densities
    states: Tensor | None
    """States in the caller's order, where they are read in place."""
    terms: Terms
    scale: float


def survey(
    x: Tensor,
    s: Tensor,
    *,
    eps: float,
    eps0: float,
    box: tuple[float, ...] | None,
    terms: Terms,
) -> Surveyed:
    """Sort checked worlds and compute their densities.

    The result may read `s` where it is: it serves until the states change.

    Args:
        x: Positions [length units], shape [B, N, D].
        s: States, dimensionless, shape [B, N, C].
        eps: Perception radius [length units].
        eps0: Radius at which the rule was trained [length units].
        box: Sides of the periodic box [length units], or None in open space.
        terms: Groups of the perception vector.
    """
    x, s = x.contiguous(), s.contiguous()
    plan = make_plan(x, x.shape, s.shape[2], x.shape[0] * x.shape[1], False, eps, box)
    in_place = plan.listed and plan.state_dim % plan.width == 0 and s.data_ptr() % 16 == 0
    ordered = sort_worlds(plan, x, None if in_place else s, None, with_rows=not plan.listed)
    if list_capacity(plan):
        densities = list_neighbours(plan, ordered, ordered.source if in_place else None)
    else:
        densities = compute_density(plan, ordered, terms, lanes=DENSITY_LANES)
    return Surveyed(plan, ordered, densities, s if in_place else None, terms, eps / eps0)


def write_observation(surveyed: Surveyed, limit: float, out: Tensor) -> None:
    """Write what every particle perceives, clipped; not differentiable.

    Args:
        surveyed: Worlds made ready by `survey`.
        limit: Entries are clipped to plus and minus this, positive.
        out: Where to write, shape [B N, P], contiguous.
    """
    plan, ordered, densities, states, terms, scale = surveyed
    write_perception(
        plan,
        ordered,
        densities,
        terms,
        scale,
        out,
        states=states,
        destination=ordered.source,
        limit=limit,
    )
