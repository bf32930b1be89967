"""Perception of particles that never move as an opaque torch operator with a gathered adjoint."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.portable.static import pair_sum_kernels
from npa_envs.sph.bridge import launch
from npa_envs.sph.cells import Plan, make_plan
from npa_envs.sph.passes import Terms
from npa_envs.sph.settled import SettledTensors, SettledWorlds, entries_ahead
from npa_envs.sph.settled_states import SettledRows, group_width, padded_channels


class _Call(NamedTuple):
    """What the kernels of a call take besides tensors."""

    plan: Plan
    kernels: Any
    group_count: int
    width: int


def _make_call(
    particles: Tensor,
    shape: list[int],
    state_dim: int,
    row_capacity: int,
    row_width: int,
    eps: float,
    box: list[float] | None,
    terms: Terms,
) -> _Call:
    plan = make_plan(particles, shape, state_dim, row_capacity, False, eps, box)
    width = group_width(particles, state_dim)
    kernels = pair_sum_kernels(
        plan.space_dim,
        plan.scalar,
        width,
        plan.lanes,
        entries_ahead(plan),
        terms.state_gradient,
        terms.correction is not None,
        state_dim % width == 0 and row_width % 4 == 0,
    )
    return _Call(plan, kernels, -(-state_dim // width), width)


@torch.library.custom_op("npa::perceive_settled", mutates_args=())
def _perceive_settled(
    states: Tensor,
    settled: list[Tensor],
    row_place: Tensor,
    active_before: Tensor,
    row_capacity: int,
    row_width: int,
    shape: list[int],
    state_dim: int,
    capacity: int,
    eps: float,
    scale: float,
    box: list[float] | None,
    state_gradient: bool,
    moment_inverse: str | None,
    density_gradient: bool,
) -> Tensor:
    tensors = SettledTensors(*settled)
    terms = Terms(state_gradient, moment_inverse, density_gradient)
    plan, kernels, group_count, width = _make_call(
        tensors.particles, shape, state_dim, row_capacity, row_width, eps, box, terms
    )
    perception = states.new_empty(row_capacity, row_width)
    launch(
        kernels.perceive,
        row_capacity * group_count,
        states.device,
        plan.domain,
        plan.particle_count,
        capacity,
        state_dim,
        group_count,
        row_width,
        int(density_gradient),
        scale,
        tensors.starts,
        tensors.particles,
        tensors.weights,
        tensors.neighbours,
        tensors.ends,
        tensors.lengths,
        tensors.correction,
        tensors.density_columns,
        row_place,
        active_before,
        states.contiguous().view(-1, width),
        perception.view(-1),
    )
    return perception


@_perceive_settled.register_fake
def _(
    states: Tensor,
    settled: list[Tensor],
    row_place: Tensor,
    active_before: Tensor,
    row_capacity: int,
    row_width: int,
    *options: Any,
) -> Tensor:
    return states.new_empty(row_capacity, row_width)


@torch.library.custom_op("npa::perceive_settled_backward", mutates_args=())
def _perceive_settled_backward(
    bar: Tensor,
    perception: Tensor,
    settled: list[Tensor],
    rows: list[Tensor],
    shape: list[int],
    state_dim: int,
    capacity: int,
    eps: float,
    scale: float,
    box: list[float] | None,
    state_gradient: bool,
    moment_inverse: str | None,
    density_gradient: bool,
) -> Tensor:
    tensors = SettledTensors(*settled)
    row_of, row_place, active_before = rows
    terms = Terms(state_gradient, moment_inverse, density_gradient)
    row_capacity, row_width = perception.shape
    plan, kernels, group_count, width = _make_call(
        tensors.particles, shape, state_dim, row_capacity, row_width, eps, box, terms
    )
    bar = bar.contiguous().view(-1)
    kinds = 1 + plan.space_dim * state_gradient
    cotangents = bar.new_empty(row_capacity * group_count, kinds, width)
    launch(
        kernels.unscale_cotangents,
        row_capacity * group_count,
        bar.device,
        state_dim,
        group_count,
        row_width,
        scale,
        tensors.particles,
        row_place,
        active_before,
        perception.view(-1),
        bar,
        cotangents,
    )
    states_bar = bar.new_empty(plan.total, group_count * width)
    launch(
        kernels.gather_state_cotangents,
        plan.total * group_count,
        bar.device,
        plan.domain,
        plan.particle_count,
        capacity,
        state_dim,
        group_count,
        row_width,
        tensors.starts,
        tensors.particles,
        tensors.weights,
        tensors.neighbours,
        tensors.ends,
        tensors.lengths,
        tensors.kernel_sum,
        row_of,
        bar,
        cotangents,
        states_bar.view(-1, width),
    )
    return states_bar


@_perceive_settled_backward.register_fake
def _(
    bar: Tensor,
    perception: Tensor,
    settled: list[Tensor],
    rows: list[Tensor],
    shape: list[int],
    state_dim: int,
    *options: Any,
) -> Tensor:
    total = SettledTensors(*settled).particles.shape[0]
    return bar.new_empty(total, padded_channels(bar, state_dim))


class _PerceiveSettled(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        states: Tensor,
        worlds: SettledWorlds,
        rows: SettledRows,
        row_width: int,
    ) -> Tensor:
        ctx.options = _options(worlds)
        perception: Tensor = _perceive_settled(
            states,
            list(worlds.tensors),
            rows.row_place,
            rows.active_before,
            rows.row_capacity,
            row_width,
            *ctx.options,
        )
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(perception, *rows[:-1], *worlds.tensors)
        return perception

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        perception, *tensors = ctx.saved_tensors
        count = len(tensors) - len(SettledTensors._fields)
        states_bar = _perceive_settled_backward(
            bar, perception, tensors[count:], tensors[:count], *ctx.options
        )
        return states_bar, None, None, None


def _options(worlds: SettledWorlds) -> tuple[Any, ...]:
    box = None if worlds.box is None else list(worlds.box)
    numbers = (worlds.state_dim, worlds.capacity, worlds.eps, worlds.scale)
    return (list(worlds.shape), *numbers, box, *worlds.terms)


def perceive_settled(
    worlds: SettledWorlds, states: Tensor, rows: SettledRows, *, row_width: int
) -> Tensor:
    """Perceive the active particles.

    Args:
        worlds: The worlds.
        states: States as `settled_states` returns them, shape [B N, C'].
        rows: Which particles are active.
        row_width: Columns of a row, at least P: a one follows the perception vector, then zeros.

    Returns:
        Rows of perception, dimensionless, shape [K, row_width], zero beyond the last active row.
    """
    perception: Tensor = _PerceiveSettled.apply(  # type: ignore[no-untyped-call]
        states, worlds, rows, row_width
    )
    return perception
