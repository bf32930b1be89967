"""Perception of the active particles as an opaque torch operator with its gathered adjoints.

A `torch.library` operator keeps Warp out of torch.compile's sight; the autograd function over it
saves only what the adjoint of the case at hand reads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.sph.adjoint import perceive_rows_backward
from npa_envs.sph.bridge import launch
from npa_envs.sph.cells import make_plan, sort_worlds
from npa_envs.sph.passes import Terms, compute_densities, perception_launch, rollout_listing

__all__ = ["Rows", "Terms", "perceive_rows"]


class Rows(NamedTuple):
    """Which particles a batch of rows stands for: rows follow the sorted order of the particles."""

    row_of: Tensor
    """Row of each particle, -1 where it has none, int32, shape [B N]."""
    row_source: Tensor
    """Particle of each row, int32, shape [K]; undefined beyond the last active row."""
    starts: Tensor
    """Cell starts; the last entry minus `row_base` is the number of active rows."""
    row_base: int


@torch.library.custom_op("npa::perceive_rows", mutates_args=())
def _perceive_rows(
    x: Tensor,
    s: Tensor,
    mask: Tensor | None,
    row_capacity: int,
    row_width: int,
    eps: float,
    scale: float,
    box: list[float] | None,
    state_gradient: bool,
    moment_correction: bool,
    density_gradient: bool,
    for_adjoint: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    plan = make_plan(x, x.shape, s.shape[2], row_capacity, mask is not None, eps, box)
    terms = Terms(state_gradient, moment_correction, density_gradient)
    ordered = sort_worlds(plan, x, s, mask)
    densities = compute_densities(
        plan, ordered, terms, rollout_listing(plan), with_particles=for_adjoint
    )
    perception = x.new_empty(row_capacity, row_width)
    row_kernel_sum = x.new_empty(row_capacity if for_adjoint else 0, plan.space_dim)
    launch(
        *perception_launch(
            plan,
            ordered,
            densities,
            terms,
            scale,
            perception,
            row_kernel_sum=row_kernel_sum if for_adjoint else None,
        )
    )
    return (
        perception,
        ordered.row_of,
        ordered.row_source,
        ordered.starts,
        ordered.source,
        densities.particles,
        ordered.row_positions,
        row_kernel_sum,
        ordered.states,
    )


@_perceive_rows.register_fake
def _(
    x: Tensor,
    s: Tensor,
    mask: Tensor | None,
    row_capacity: int,
    row_width: int,
    eps: float,
    scale: float,
    box: list[float] | None,
    *options: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    plan = make_plan(x, x.shape, s.shape[2], row_capacity, mask is not None, eps, box)
    for_adjoint = options[-1]
    particle_count = plan.total if for_adjoint or not plan.listed else 0
    integers = torch.int32
    return (
        x.new_empty(row_capacity, row_width),
        x.new_empty(plan.total, dtype=integers),
        x.new_empty(row_capacity, dtype=integers),
        x.new_empty(plan.start_count, dtype=integers),
        x.new_empty(plan.total, dtype=integers),
        x.new_empty(particle_count, plan.space_dim + 1),
        x.new_empty(row_capacity, plan.space_dim),
        x.new_empty(row_capacity if for_adjoint else 0, plan.space_dim),
        s.new_empty(plan.total * plan.group_count, plan.width),
    )


class _PerceiveRows(torch.autograd.Function):
    """Perception of the active particles, with gathered adjoints for states and positions."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        s: Tensor,
        mask: Tensor | None,
        row_capacity: int,
        row_width: int,
        eps: float,
        scale: float,
        box: list[float] | None,
        terms: Terms,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        (
            perception,
            row_of,
            row_source,
            starts,
            source,
            particles,
            row_positions,
            row_kernel_sum,
            states,
        ) = _perceive_rows(
            x,
            s,
            mask,
            row_capacity,
            row_width,
            eps,
            scale,
            box,
            *terms,
            for_adjoint=any(ctx.needs_input_grad),
        )
        ctx.mark_non_differentiable(row_of, row_source, starts)
        ctx.set_materialize_grads(False)
        if any(ctx.needs_input_grad):
            ctx.options = (eps, scale, box, terms)
            ctx.shapes = (x.shape, s.shape, mask is not None)
            saved = (perception, row_of, starts, source, particles, row_positions, row_kernel_sum)
            ctx.save_for_backward(*saved, *((states,) if ctx.needs_input_grad[0] else ()))
        return perception, row_of, row_source, starts

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Tensor | None, ...]:
        if bars[0] is None:
            return (None,) * 9
        saved = ctx.saved_tensors
        states = saved[7] if len(saved) == 8 else None
        eps, scale, box, terms = ctx.options
        x_shape, s_shape, masked = ctx.shapes
        states_bar, positions_bar = perceive_rows_backward(
            bars[0],
            *saved[:7],
            states,
            x_shape[1],
            s_shape[2],
            masked,
            eps,
            scale,
            box,
            terms.state_gradient,
            terms.density_gradient,
        )
        x_bar = None if states is None else positions_bar.view(x_shape)
        return (x_bar, states_bar.view(s_shape), None, None, None, None, None, None, None)


def perceive_rows(
    x: Tensor,
    s: Tensor,
    *,
    mask: Tensor | None,
    row_capacity: int,
    row_width: int,
    eps: float,
    eps0: float,
    box: tuple[float, ...] | None,
    terms: Terms,
) -> tuple[Tensor, Rows]:
    """Perceive the active particles of checked worlds.

    Args:
        x: Positions [length units], shape [B, N, D]; gradients flow into it if it requires them.
        s: States, dimensionless, shape [B, N, C].
        mask: Which particles are active, uint8, shape [B, N], or None for all.
        row_capacity: Rows K of the result; active particles beyond it are left out.
        row_width: Columns of a row, at least P: a one follows the perception vector, then zeros.
        eps: Perception radius [length units].
        eps0: Radius at which the rule was trained [length units].
        box: Sides of the periodic box [length units], or None in open space.
        terms: Groups of the perception vector.

    Returns:
        Rows of perception, dimensionless, shape [K, row_width], zero beyond the last active row,
        and which particles they stand for.
    """
    perception, row_of, row_source, starts = _PerceiveRows.apply(  # type: ignore[no-untyped-call]
        x.contiguous(),
        s.contiguous(),
        mask,
        row_capacity,
        row_width,
        eps,
        eps / eps0,
        None if box is None else list(box),
        terms,
    )
    row_base = 0 if mask is None else x.shape[0] * x.shape[1]
    return perception, Rows(row_of, row_source, starts, row_base)
