"""The public SPH operators over whole worlds: perception vectors and the fields behind them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.sph.bridge import launch
from npa_envs.sph.cells import make_plan, sort_worlds
from npa_envs.sph.checks import (
    Box,
    MomentInverse,
    check_finite_positions,
    check_scale,
    check_world,
    checked_box,
    checked_eps,
    checked_flag,
    checked_moment_inverse,
)
from npa_envs.sph.operators import perceive_rows
from npa_envs.sph.passes import Terms, compute_density_gradients, plain_kernels


class PerceptionFields(NamedTuple):
    """The unscaled SPH fields at every particle (arXiv 2601.16096, section 3)."""

    rho: Tensor
    """Density [1 / length^D], shape [B, N]."""
    blur: Tensor
    """Smoothed states, dimensionless, shape [B, N, C]."""
    grad0: Tensor
    """State gradients without correction [1 / length], shape [B, N, C, D]."""
    moment: Tensor
    """Moment matrices M, dimensionless, shape [B, N, D, D]."""
    grad1: Tensor
    """State gradients corrected by the inverse of M [1 / length], shape [B, N, C, D]."""
    drho: Tensor
    """Density gradients [1 / length^(D+1)], shape [B, N, D]."""


def perceive(
    x: Tensor,
    s: Tensor,
    eps: float,
    eps0: float | None = None,
    box: Box = None,
    detach_positions: bool = True,
    *,
    state_gradient: bool = True,
    moment_correction: bool = True,
    density_gradient: bool = True,
    moment_inverse: MomentInverse = "threshold",
) -> Tensor:
    """Perceive every particle's neighbourhood: z = [s ; smoothed s ; L(c ∇s) ; L(c^(1+D) ∇ρ / N)].

    c = eps / eps0, L(v) = log(1 + |v|) v / |v|. Differentiable in s, and in x where
    `detach_positions` is False; the moment correction of ∇s is a stopped gradient, as in the paper
    (arXiv 2601.16096, section 3). Bit-identical from run to run; world k of B equals that world
    alone.

    Args:
        x: Particle positions [length units], shape [B, N, D], D = 2 or 3, anywhere in open space.
        s: Particle states, dimensionless, shape [B, N, C], any C; dtype and device of x.
        eps: Perception radius [length units].
        eps0: Radius at which the rule was trained [length units]; default: eps.
        box: Sides of a periodic box centred on the origin [length units], a number for equal
            sides, or None for open space.
        detach_positions: Do not back-propagate into x.
        state_gradient: Include the state gradient in z.
        moment_correction: Correct the state gradient by the inverse moment matrix.
        density_gradient: Include the density gradient in z.
        moment_inverse: How the moment matrix M is inverted: "threshold", M⁻¹ where
            |det M| >= 1e-3 and not at all below, as in the paper, which jumps there; or "smooth",
            (det M adj M + τ² I) / (det² M + τ²), τ = 1e-2, which nears both and never jumps.

    Returns:
        Perception vectors z, dimensionless, shape [B, N, P], P = C(2+D)+D with every group.

    Raises:
        NPAError: Shapes, dtypes or devices do not fit, a position is not finite, eps or eps0 is
            not positive and finite, a box side is below 2 eps, or `moment_inverse` is another word.
    """
    check_world(x, s)
    radius = checked_eps("eps", eps, x.dtype)
    radius0 = radius if eps0 is None else checked_eps("eps0", eps0, x.dtype)
    check_scale(radius, radius0, x.shape[2], x.dtype)
    sides = checked_box(box, x.shape[2], radius)
    check_finite_positions(x)
    inverse = checked_moment_inverse(moment_inverse)
    terms = Terms(
        checked_flag("state_gradient", state_gradient),
        inverse if checked_flag("moment_correction", moment_correction) else None,
        checked_flag("density_gradient", density_gradient),
    )
    perception, rows = perceive_rows(
        x.detach() if checked_flag("detach_positions", detach_positions) else x,
        s,
        mask=None,
        row_capacity=x.shape[0] * x.shape[1],
        row_width=terms.perception_dim(x.shape[2], s.shape[2]),
        eps=radius,
        eps0=radius0,
        box=sides,
        terms=terms,
    )
    return perception.index_select(0, rows.row_of).view(*x.shape[:2], -1)


@torch.no_grad()
def perception_fields(
    x: Tensor,
    s: Tensor,
    eps: float,
    box: Box = None,
    *,
    moment_inverse: MomentInverse = "threshold",
) -> PerceptionFields:
    """Return the unscaled SPH fields of every particle; not differentiable (`perceive` is).

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states, dimensionless, shape [B, N, C].
        eps: Perception radius [length units].
        box: Sides of a periodic box centred on the origin [length units], or None for open space.
        moment_inverse: How `grad1` is corrected, as in `perceive`.

    Raises:
        NPAError: As `perceive`.
    """
    terms = Terms(moment_inverse=checked_moment_inverse(moment_inverse))
    check_world(x, s)
    radius = checked_eps("eps", eps, x.dtype)
    sides = checked_box(box, x.shape[2], radius)
    check_finite_positions(x)
    x, s = x.contiguous(), s.contiguous()
    world_count, particle_count, space_dim = x.shape
    state_dim = s.shape[2]
    plan = make_plan(x, x.shape, state_dim, x.shape[0] * x.shape[1], False, radius, sides)
    ordered = sort_worlds(plan, x, s, None)
    particles, row_density_gradient, _ = compute_density_gradients(plan, ordered, terms)
    fields = PerceptionFields(
        rho=x.new_empty(plan.total),
        blur=x.new_empty(plan.total, state_dim),
        grad0=x.new_empty(plan.total, state_dim, space_dim),
        moment=x.new_empty(plan.total, space_dim, space_dim),
        grad1=x.new_empty(plan.total, state_dim, space_dim),
        drho=row_density_gradient[ordered.row_of].to(x.dtype),
    )
    launch(
        plain_kernels(plan, terms).gather_fields,
        (plan.total, plan.group_count, plan.lanes),
        x.device,
        plan.domain,
        particle_count,
        state_dim,
        plan.group_count,
        ordered.starts,
        particles,
        ordered.states,
        ordered.source,
        *fields[:-1],
    )
    return PerceptionFields(
        *(field.view(world_count, particle_count, *field.shape[1:]) for field in fields)
    )
