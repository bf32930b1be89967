"""Perception of the active particles as an opaque torch operator with its gathered adjoints.

A `torch.library` operator keeps Warp out of torch.compile's sight; the autograd function over it
saves only what the adjoint of the case at hand reads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.sph.adjoint import SavedPerception, perceive_rows_backward
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
    moment_inverse: str | None,
    density_gradient: bool,
    for_adjoint: bool,
) -> list[Tensor]:
    """Return the particles of the rows, `row_source`, and then what a `SavedPerception` holds."""
    plan = make_plan(x, x.shape, s.shape[2], row_capacity, mask is not None, eps, box)
    terms = Terms(state_gradient, moment_inverse, density_gradient)
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
    saved = SavedPerception(
        perception=perception,
        row_of=ordered.row_of,
        starts=ordered.starts,
        source=ordered.source,
        particles=densities.particles,
        row_positions=ordered.row_positions,
        row_kernel_sum=row_kernel_sum,
        states=ordered.states,
    )
    return [ordered.row_source, *saved.tensors()]


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
) -> list[Tensor]:
    plan = make_plan(x, x.shape, s.shape[2], row_capacity, mask is not None, eps, box)
    for_adjoint = options[-1]
    particle_count = plan.total if for_adjoint or not plan.listed else 0
    integers = torch.int32
    saved = SavedPerception(
        perception=x.new_empty(row_capacity, row_width),
        row_of=x.new_empty(plan.total, dtype=integers),
        starts=x.new_empty(plan.start_count, dtype=integers),
        source=x.new_empty(plan.total, dtype=integers),
        particles=x.new_empty(particle_count, plan.space_dim + 1),
        row_positions=x.new_empty(row_capacity, plan.space_dim),
        row_kernel_sum=x.new_empty(row_capacity if for_adjoint else 0, plan.space_dim),
        states=s.new_empty(plan.total * plan.group_count, plan.width),
    )
    return [x.new_empty(row_capacity, dtype=integers), *saved.tensors()]


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
        row_source, *tensors = _perceive_rows(
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
        saved = SavedPerception(*tensors)
        ctx.mark_non_differentiable(saved.row_of, row_source, saved.starts)
        ctx.set_materialize_grads(False)
        if any(ctx.needs_input_grad):
            ctx.options = (eps, scale, box, terms)
            ctx.shapes = (x.shape, s.shape, mask is not None)
            ctx.save_for_backward(*(saved if ctx.needs_input_grad[0] else saved[:-1]))
        return saved.perception, saved.row_of, row_source, saved.starts

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Tensor | None, ...]:
        if bars[0] is None:
            return (None,) * 9
        eps, scale, box, terms = ctx.options
        x_shape, s_shape, masked = ctx.shapes
        states_bar, positions_bar = perceive_rows_backward(
            bars[0],
            list(ctx.saved_tensors),
            particle_count=x_shape[1],
            state_dim=s_shape[2],
            masked=masked,
            eps=eps,
            scale=scale,
            box=box,
            state_gradient=terms.state_gradient,
            density_gradient=terms.density_gradient,
        )
        x_bar = positions_bar.view(x_shape) if ctx.needs_input_grad[0] else None
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
