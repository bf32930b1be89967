"""Perception of active rows and their update, as opaque torch operators with their adjoints.

`torch.library` operators keep Warp out of torch.compile's sight; the autograd functions over them
save only what the adjoint of the case at hand reads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.adjoint import adjoint_kernels
from npa_envs.kernels.domain import make_domain
from npa_envs.kernels.perception import perception_kernels
from npa_envs.kernels.update import update_kernels
from npa_envs.sph.bridge import lane_count, launch, scalar_type
from npa_envs.sph.cells import Plan, compute_density, make_plan, sort_worlds


class Terms(NamedTuple):
    """Which groups of the perception vector a rule reads: the others are not computed."""

    state_gradient: bool = True
    moment_correction: bool = True
    density_gradient: bool = True

    def perception_dim(self, space_dim: int, state_dim: int) -> int:
        """Length P of a perception vector with these groups."""
        gradients = state_dim * space_dim * self.state_gradient
        return 2 * state_dim + gradients + space_dim * self.density_gradient


class Rows(NamedTuple):
    """Which particles a batch of rows stands for: rows follow the sorted order of the particles."""

    row_of: Tensor
    """Row of each particle, -1 where it has none, int32, shape [B N]."""
    row_source: Tensor
    """Particle of each row, int32, shape [K]; undefined beyond the last active row."""
    starts: Tensor
    """Cell starts; the last entry minus `row_base` is the number of active rows."""
    row_base: int


def _density_scale(scale: float, space_dim: int, particle_count: int) -> float:
    return scale ** (1 + space_dim) / particle_count


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
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    plan = make_plan(x, s, row_capacity, mask is not None, eps, None if box is None else tuple(box))
    kernels = perception_kernels(
        plan.space_dim, plan.scalar, plan.width, plan.lanes, state_gradient
    )
    ordered = sort_worlds(plan, x, s, mask)
    particles, row_density_gradient = compute_density(plan, ordered, kernels, density_gradient)
    perception = x.new_empty(row_capacity, row_width)
    row_kernel_sum = x.new_empty(row_capacity, plan.space_dim)
    launch(
        kernels.perceive,
        (row_capacity, plan.group_count, plan.lanes),
        x.device,
        plan.domain,
        plan.particle_count,
        plan.state_dim,
        int(moment_correction and state_gradient),
        int(density_gradient),
        scale,
        _density_scale(scale, plan.space_dim, plan.particle_count),
        plan.row_base,
        plan.group_count,
        ordered.starts,
        particles,
        ordered.states,
        ordered.states.view(plan.total, -1),
        ordered.row_place,
        row_density_gradient,
        perception,
        row_kernel_sum,
    )
    return (
        perception,
        ordered.row_of,
        ordered.row_source,
        ordered.starts,
        ordered.source,
        particles,
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
    state_gradient: bool,
    moment_correction: bool,
    density_gradient: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    plan = make_plan(x, s, row_capacity, mask is not None, eps, None if box is None else tuple(box))
    cells = plan.world_count * int(plan.domain.cell_count) * (2 if plan.masked else 1)
    integers = torch.int32
    return (
        x.new_empty(row_capacity, row_width),
        x.new_empty(plan.total, dtype=integers),
        x.new_empty(row_capacity, dtype=integers),
        x.new_empty(cells + 1, dtype=integers),
        x.new_empty(plan.total, dtype=integers),
        x.new_empty(plan.total, plan.space_dim + 1),
        x.new_empty(row_capacity, plan.space_dim),
        x.new_empty(row_capacity, plan.space_dim),
        s.new_empty(plan.total * plan.group_count, plan.width),
    )


@torch.library.custom_op("npa::perceive_rows_backward", mutates_args=())
def _perceive_rows_backward(
    perception_bar: Tensor,
    perception: Tensor,
    row_of: Tensor,
    starts: Tensor,
    source: Tensor,
    particles: Tensor,
    row_positions: Tensor,
    row_kernel_sum: Tensor,
    states: Tensor | None,
    particle_count: int,
    state_dim: int,
    width: int,
    masked: bool,
    eps: float,
    scale: float,
    box: list[float] | None,
    state_gradient: bool,
    density_gradient: bool,
) -> tuple[Tensor, Tensor]:
    total, space_dim = particles.shape[0], particles.shape[1] - 1
    row_capacity = perception.shape[0]
    scalar = scalar_type(particles.dtype)
    sides = None if box is None else tuple(box)
    plan = Plan(
        scalar=scalar,
        width=width,
        lanes=lane_count(particles.device),
        world_count=total // particle_count,
        particle_count=particle_count,
        space_dim=space_dim,
        state_dim=state_dim,
        row_capacity=row_capacity,
        masked=masked,
        domain=make_domain(space_dim, scalar, eps, sides, particle_count),
    )
    kernels = adjoint_kernels(space_dim, scalar, width, plan.lanes, state_gradient)
    device = particles.device
    bar = perception_bar.contiguous()
    blur_bar = bar.new_empty(row_capacity * plan.group_count, width)
    gradient_bar = bar.new_empty(row_capacity * plan.group_count, space_dim, width)
    density_gradient_bar = bar.new_empty(0 if states is None else row_capacity, space_dim)
    launch(
        kernels.unscale_cotangents,
        (row_capacity, plan.group_count * width),
        device,
        state_dim,
        int(density_gradient),
        scale,
        _density_scale(scale, space_dim, particle_count),
        plan.row_base,
        plan.group_count,
        starts,
        perception,
        bar,
        blur_bar.view(-1),
        gradient_bar.view(-1),
        density_gradient_bar,
    )
    states_bar = bar.new_empty(total, state_dim)
    launch(
        kernels.gather_state_cotangents,
        (total, plan.group_count, plan.lanes),
        device,
        plan.domain,
        particle_count,
        state_dim,
        plan.active_offset,
        plan.row_base,
        row_capacity,
        plan.group_count,
        starts,
        particles,
        source,
        row_of,
        row_positions,
        row_kernel_sum,
        bar,
        blur_bar,
        gradient_bar,
        gradient_bar.view(-1),
        states_bar,
    )
    if states is None:
        return states_bar, bar.new_empty(0)
    density_bar = bar.new_empty(total)
    launch(
        kernels.gather_density_cotangents,
        total,
        device,
        plan.domain,
        particle_count,
        plan.group_count,
        starts,
        particles,
        states,
        source,
        row_of,
        blur_bar,
        gradient_bar,
        density_bar,
    )
    positions_bar = bar.new_empty(total, space_dim)
    launch(
        kernels.gather_position_cotangents,
        total,
        device,
        plan.domain,
        particle_count,
        plan.group_count,
        starts,
        particles,
        states,
        source,
        row_of,
        density_bar,
        blur_bar,
        gradient_bar,
        density_gradient_bar,
        positions_bar,
    )
    return states_bar, positions_bar


@_perceive_rows_backward.register_fake
def _(
    perception_bar: Tensor,
    perception: Tensor,
    row_of: Tensor,
    starts: Tensor,
    source: Tensor,
    particles: Tensor,
    row_positions: Tensor,
    row_kernel_sum: Tensor,
    states: Tensor | None,
    particle_count: int,
    state_dim: int,
    width: int,
    masked: bool,
    eps: float,
    scale: float,
    box: list[float] | None,
    state_gradient: bool,
    density_gradient: bool,
) -> tuple[Tensor, Tensor]:
    total, space_dim = particles.shape[0], particles.shape[1] - 1
    positions_bar = (
        particles.new_empty(0) if states is None else particles.new_empty(total, space_dim)
    )
    return particles.new_empty(total, state_dim), positions_bar


class PerceiveRows(torch.autograd.Function):
    """Perception vectors of the active particles, with gathered adjoints for states and positions."""

    @staticmethod
    def forward(  # type: ignore[override]
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
        ) = _perceive_rows(x, s, mask, row_capacity, row_width, eps, scale, box, *terms)
        ctx.mark_non_differentiable(row_of, row_source, starts)
        ctx.set_materialize_grads(False)
        if any(ctx.needs_input_grad):
            ctx.options = (eps, scale, box, terms)
            ctx.shapes = (x.shape, s.shape, states.shape[-1], mask is not None)
            saved = (perception, row_of, starts, source, particles, row_positions, row_kernel_sum)
            ctx.save_for_backward(*saved, *((states,) if ctx.needs_input_grad[0] else ()))
        return perception, row_of, row_source, starts

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        if bars[0] is None:
            return (None,) * 9
        saved = ctx.saved_tensors
        states = saved[7] if len(saved) == 8 else None
        eps, scale, box, terms = ctx.options
        x_shape, s_shape, width, masked = ctx.shapes
        states_bar, positions_bar = _perceive_rows_backward(
            bars[0],
            *saved[:7],
            states,
            x_shape[1],
            s_shape[2],
            width,
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
    perception, row_of, row_source, starts = PerceiveRows.apply(  # type: ignore[no-untyped-call]
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


@torch.library.custom_op("npa::update_particles", mutates_args=())
def _update_particles(
    update: Tensor,
    x: Tensor,
    s: Tensor,
    path_length: Tensor,
    row_of: Tensor,
    reach: float,
    dt: float,
    moving: bool,
    box: list[float] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    space_dim, state_dim = x.shape[2], s.shape[2]
    total = x.shape[0] * x.shape[1]
    kernels = update_kernels(space_dim, scalar_type(x.dtype))
    outputs = torch.empty_like(x), torch.empty_like(s), torch.empty_like(path_length)
    launch(
        kernels.apply_update,
        total * (1 + state_dim),
        x.device,
        reach * dt,
        dt,
        int(box is not None),
        tuple(box) if box is not None else (1.0,) * space_dim,
        int(moving),
        row_of,
        update.contiguous(),
        x.view(total, space_dim),
        s.view(total, state_dim),
        path_length.view(total),
        outputs[0].view(total, space_dim),
        outputs[1].view(total, state_dim),
        outputs[2].view(total),
    )
    return outputs


@_update_particles.register_fake
def _(
    update: Tensor,
    x: Tensor,
    s: Tensor,
    path_length: Tensor,
    row_of: Tensor,
    reach: float,
    dt: float,
    moving: bool,
    box: list[float] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(x), torch.empty_like(s), torch.empty_like(path_length)


@torch.library.custom_op("npa::update_particles_backward", mutates_args=())
def _update_particles_backward(
    update: Tensor,
    new_x_bar: Tensor,
    new_s_bar: Tensor,
    new_path_bar: Tensor,
    row_source: Tensor,
    starts: Tensor,
    row_base: int,
    reach: float,
    dt: float,
    moving: bool,
) -> Tensor:
    space_dim, state_dim = new_x_bar.shape[2], new_s_bar.shape[2]
    kernels = update_kernels(space_dim, scalar_type(update.dtype))
    update_bar = torch.empty_like(update, memory_format=torch.contiguous_format)
    launch(
        kernels.pull_back_update,
        tuple(update.shape),
        update.device,
        reach * dt,
        dt,
        int(moving),
        row_base,
        starts,
        row_source,
        update.contiguous(),
        new_x_bar.contiguous().view(-1, space_dim),
        new_s_bar.contiguous().view(-1, state_dim),
        new_path_bar.contiguous().view(-1),
        update_bar,
    )
    return update_bar


@_update_particles_backward.register_fake
def _(
    update: Tensor,
    new_x_bar: Tensor,
    new_s_bar: Tensor,
    new_path_bar: Tensor,
    row_source: Tensor,
    starts: Tensor,
    row_base: int,
    reach: float,
    dt: float,
    moving: bool,
) -> Tensor:
    return torch.empty_like(update, memory_format=torch.contiguous_format)


class UpdateParticles(torch.autograd.Function):
    """Positions, states and path lengths after one update of the active particles."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        update: Tensor,
        x: Tensor,
        s: Tensor,
        path_length: Tensor,
        rows: Rows,
        reach: float,
        dt: float,
        moving: bool,
        box: list[float] | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.options = (rows.row_base, reach, dt, moving)
        ctx.save_for_backward(update, rows.row_source, rows.starts)
        outputs: tuple[Tensor, Tensor, Tensor] = _update_particles(
            update, x, s, path_length, rows.row_of, reach, dt, moving, box
        )
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        update, row_source, starts = ctx.saved_tensors
        update_bar = _update_particles_backward(update, *bars, row_source, starts, *ctx.options)
        return (update_bar, *bars, None, None, None, None, None)


def update_particles(
    update: Tensor,
    x: Tensor,
    s: Tensor,
    path_length: Tensor,
    *,
    rows: Rows,
    reach: float,
    dt: float,
    moving: bool,
    box: tuple[float, ...] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Apply a rule's outputs to the particles that have rows.

    Args:
        update: Raw updates [δ (D) ; Δs (C)], dimensionless, shape [K, A] or wider; the columns
            beyond A are not read.
        x: Positions [length units], shape [B, N, D].
        s: States, dimensionless, shape [B, N, C].
        path_length: Length of each particle's path so far [length units], shape [B, N].
        rows: Which particles the rows stand for.
        reach: Largest displacement alpha eps of a unit step [length units].
        dt: Time step, dimensionless.
        moving: Updates begin with δ; otherwise there is none and positions stay.
        box: Sides of the periodic box, into which positions are wrapped, or None.
    """
    outputs: tuple[Tensor, Tensor, Tensor] = UpdateParticles.apply(  # type: ignore[no-untyped-call]
        update,
        x.contiguous(),
        s.contiguous(),
        path_length,
        rows,
        reach,
        dt,
        moving,
        None if box is None else list(box),
    )
    return outputs
