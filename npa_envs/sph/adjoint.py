"""The adjoint of perception as an opaque torch operator."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.kernels.adjoint import adjoint_kernels
from npa_envs.kernels.listed_adjoint import SHARE, listed_adjoint
from npa_envs.kernels.tiles import TILE
from npa_envs.kernels.warps import WARP
from npa_envs.sph.bridge import launch
from npa_envs.sph.cells import Plan, density_scale, make_plan


@torch.library.custom_op("npa::perceive_rows_backward", mutates_args=())
def perceive_rows_backward(
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
    masked: bool,
    eps: float,
    scale: float,
    box: list[float] | None,
    state_gradient: bool,
    density_gradient: bool,
) -> tuple[Tensor, Tensor]:
    """Return the cotangents of states, [B N, C], and of positions, [B N, D] or empty.

    Everything saved by the forward pass comes as it left it; `states` None skips positions.
    """
    total, space_dim = particles.shape[0], particles.shape[1] - 1
    row_capacity = perception.shape[0]
    plan = make_plan(
        particles,
        (total // particle_count, particle_count, space_dim),
        state_dim,
        row_capacity,
        masked,
        eps,
        box,
    )
    if plan.listed and states is None:
        states_bar = _gather_by_tiles(
            plan,
            perception_bar,
            perception,
            row_of,
            starts,
            source,
            particles,
            row_positions,
            row_kernel_sum,
            scale,
            state_gradient,
        )
        return states_bar, states_bar.new_empty(0)
    width = plan.width
    kernels = adjoint_kernels(space_dim, plan.scalar, width, plan.lanes, state_gradient)
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
        density_scale(scale, space_dim, particle_count),
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


def _gather_by_tiles(
    plan: Plan,
    perception_bar: Tensor,
    perception: Tensor,
    row_of: Tensor,
    starts: Tensor,
    source: Tensor,
    particles: Tensor,
    row_positions: Tensor,
    row_kernel_sum: Tensor,
    scale: float,
    state_gradient: bool,
) -> Tensor:
    """Return the cotangent of states, [B N, C], on CUDA in float32."""
    kernels = listed_adjoint(
        plan.space_dim, plan.width, state_gradient, plan.periodic, plan.group_count > 1
    )
    device = particles.device
    bar = perception_bar.contiguous()
    # All cotangents are multiplied by one kernel's norm, those of the smoothed state before.
    norm = plan.domain.spiky_norm if state_gradient else plan.domain.smoothing_norm
    kinds = 1 + plan.space_dim * state_gradient
    entries = plan.row_capacity * plan.group_count + 1
    cotangents = bar.new_empty(entries * kinds * plan.width // SHARE, SHARE)
    launch(
        kernels.unscale_cotangents,
        entries * plan.width // SHARE,
        device,
        plan.state_dim,
        scale,
        plan.domain.smoothing_norm / norm,
        plan.row_base,
        plan.row_capacity,
        plan.group_count,
        starts,
        perception,
        bar,
        cotangents,
    )
    states_bar = bar.new_empty(plan.total, plan.state_dim)
    tile_count = -(-plan.particle_count // TILE)
    launch(
        kernels.gather_state_cotangents,
        plan.world_count * tile_count * plan.group_count * WARP,
        device,
        plan.domain,
        norm,
        plan.particle_count,
        tile_count,
        plan.state_dim,
        plan.active_offset,
        plan.row_base,
        plan.row_capacity,
        plan.group_count,
        starts,
        particles.view(-1),
        source,
        row_of,
        row_positions,
        row_kernel_sum,
        bar,
        cotangents,
        cotangents.view(-1),
        states_bar,
    )
    return states_bar


@perceive_rows_backward.register_fake
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
    *options: Any,
) -> tuple[Tensor, Tensor]:
    total, space_dim = particles.shape[0], particles.shape[1] - 1
    positions_bar = (
        particles.new_empty(0) if states is None else particles.new_empty(total, space_dim)
    )
    return particles.new_empty(total, state_dim), positions_bar
