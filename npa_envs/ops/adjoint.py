"""The adjoint of perception as an opaque torch operator."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.access import WARP
from npa_envs.kernels.cuda.adjoint import SHARE, TILE, listed_adjoint
from npa_envs.kernels.portable.adjoint import adjoint_kernels
from npa_envs.ops.launch import launch
from npa_envs.ops.opaque import opaque
from npa_envs.ops.sort import LARGEST_INDEX, KernelPlan, density_scale, make_plan


class SavedPerception(NamedTuple):
    """Tensors that the forward pass saves for the adjoint of perception."""

    perception: Tensor
    """Rows of perception, dimensionless, shape [K, row_width]."""
    row_of: Tensor
    """Row of each particle, -1 where it has none, int32, shape [B N]."""
    starts: Tensor
    """First sorted place of every cell, then first row of every cell (shifted), int32."""
    source: Tensor
    """Caller's index of each sorted particle, int32, shape [B N]."""
    particles: Tensor
    """Sorted positions [length units] with volumes 1 / rho, shape [B N, D + 1]."""
    row_positions: Tensor
    """Positions of the rows [length units], shape [K, D]; undefined beyond the last active row."""
    row_kernel_sum: Tensor
    """The rows' sums of v K [1 / length units], shape [K, D]; undefined beyond the last one."""
    states: Tensor | None = None
    """Sorted states, dimensionless, shape [B N G, W]; None where positions get no gradient."""

    def tensors(self) -> list[Tensor]:
        """Return those that are there, as a torch operator takes or returns them."""
        return [tensor for tensor in self if tensor is not None]


class RowCotangents(NamedTuple):
    """Cotangents of the rows' raw sums, of G groups of W channels each."""

    bar: Tensor
    """Cotangents of rows of perception, as they came, shape [K, row_width]."""
    blur: Tensor
    """Of the smoothed states, shape [K G, W]."""
    gradient: Tensor
    """Of the state gradients before their scaling, shape [K G, D, W]."""
    density_gradient: Tensor
    """Of the density gradients before their scaling, shape [K, D]; empty without `states`."""


@opaque("npa::perceive_rows_backward")
def perceive_rows_backward(
    perception_bar: Tensor,
    saved_tensors: list[Tensor],
    listed: list[Tensor],
    *,
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

    The tensors are those of a `SavedPerception`, and of the `ListedNeighbours` where there are any;
    positions are skipped if no states were saved.
    """
    saved = SavedPerception(*saved_tensors)
    total, space_dim = saved.particles.shape[0], saved.particles.shape[1] - 1
    plan = make_plan(
        saved.particles,
        (total // particle_count, particle_count, space_dim),
        state_dim,
        saved.perception.shape[0],
        masked,
        eps,
        box,
    )
    bar = perception_bar.contiguous()
    if plan.runs("adjoint", position_gradient=saved.states is not None) == "cuda":
        states_bar = _gather_by_tiles(plan, saved, bar, scale, state_gradient)
        return states_bar, states_bar.new_empty(0)
    kernels = adjoint_kernels(
        space_dim, plan.scalar, plan.width, plan.on_cpu, state_gradient, bool(listed)
    )
    cotangents = _unscale(kernels, plan, saved, bar, scale, density_gradient)
    states_bar = _gather_states(kernels, plan, saved, listed, cotangents)
    if saved.states is None:
        return states_bar, bar.new_empty(0)
    return states_bar, _gather_positions(kernels, plan, saved, cotangents)


@perceive_rows_backward.register_fake
def _(
    perception_bar: Tensor,
    saved_tensors: list[Tensor],
    listed: list[Tensor],
    *,
    state_dim: int,
    **options: Any,
) -> tuple[Tensor, Tensor]:
    saved = SavedPerception(*saved_tensors)
    particles = saved.particles
    total, space_dim = particles.shape[0], particles.shape[1] - 1
    positions_bar = (
        particles.new_empty(0) if saved.states is None else particles.new_empty(total, space_dim)
    )
    return particles.new_empty(total, state_dim), positions_bar


def _unscale(
    kernels: Any,
    plan: KernelPlan,
    saved: SavedPerception,
    bar: Tensor,
    scale: float,
    density_gradient: bool,
) -> RowCotangents:
    """Pull the cotangents of rows back through their scaling."""
    entries, space_dim = plan.row_capacity * plan.group_count, plan.space_dim
    largest = entries * space_dim * plan.width
    if largest >= LARGEST_INDEX:
        raise NPAError(
            f"gradients must stay below {LARGEST_INDEX} numbers in one batch, got {largest}: split "
            "the batch, or take float32 and detach_positions=True"
        )
    cotangents = RowCotangents(
        bar,
        bar.new_empty(entries, plan.width),
        bar.new_empty(entries, space_dim, plan.width),
        bar.new_empty(0 if saved.states is None else plan.row_capacity, space_dim),
    )
    launch(
        kernels.unscale_cotangents,
        (plan.row_capacity, plan.group_count * plan.width),
        bar.device,
        plan.state_dim,
        int(density_gradient),
        scale,
        density_scale(scale, space_dim, plan.particle_count),
        plan.row_base,
        plan.group_count,
        saved.starts,
        saved.perception,
        bar,
        cotangents.blur,
        cotangents.gradient,
        cotangents.density_gradient,
    )
    return cotangents


def _gather_states(
    kernels: Any,
    plan: KernelPlan,
    saved: SavedPerception,
    listed: list[Tensor],
    cotangents: RowCotangents,
) -> Tensor:
    """Return the cotangent of states, [B N, C]."""
    neighbours, ends = listed or (None, None)
    states_bar = cotangents.bar.new_empty(plan.total, plan.state_dim)
    launch(
        kernels.gather_state_cotangents,
        (plan.total, plan.group_count),
        states_bar.device,
        plan.domain,
        plan.particle_count,
        plan.state_dim,
        plan.active_offset,
        plan.row_base,
        plan.row_capacity,
        plan.group_count,
        saved.starts,
        ends,
        neighbours,
        saved.particles,
        saved.source,
        saved.row_of,
        saved.row_positions,
        saved.row_kernel_sum,
        cotangents.bar,
        cotangents.blur,
        cotangents.gradient,
        cotangents.gradient,
        states_bar,
    )
    return states_bar


def _gather_positions(
    kernels: Any, plan: KernelPlan, saved: SavedPerception, cotangents: RowCotangents
) -> Tensor:
    """Return the cotangent of positions, [B N, D]."""
    bar = cotangents.bar
    density_bar = bar.new_empty(plan.total)
    launch(
        kernels.gather_density_cotangents,
        plan.total,
        bar.device,
        plan.domain,
        plan.particle_count,
        plan.group_count,
        saved.starts,
        saved.particles,
        saved.states,
        saved.source,
        saved.row_of,
        cotangents.blur,
        cotangents.gradient,
        density_bar,
    )
    positions_bar = bar.new_empty(plan.total, plan.space_dim)
    launch(
        kernels.gather_position_cotangents,
        plan.total,
        bar.device,
        plan.domain,
        plan.particle_count,
        plan.group_count,
        saved.starts,
        saved.particles,
        saved.states,
        saved.source,
        saved.row_of,
        density_bar,
        cotangents.blur,
        cotangents.gradient,
        cotangents.density_gradient,
        positions_bar,
    )
    return positions_bar


def _gather_by_tiles(
    plan: KernelPlan, saved: SavedPerception, bar: Tensor, scale: float, state_gradient: bool
) -> Tensor:
    """Return the cotangent of states, [B N, C], on CUDA in float32."""
    kernels = listed_adjoint(
        plan.space_dim, plan.width, state_gradient, plan.periodic, plan.group_count > 1
    )
    # All cotangents are multiplied by one kernel's norm, those of the smoothed state before.
    norm = plan.domain.spiky_norm if state_gradient else plan.domain.smoothing_norm
    kinds = 1 + plan.space_dim * state_gradient
    entries = plan.row_capacity * plan.group_count + 1
    cotangents = bar.new_empty(entries * kinds * plan.width // SHARE, SHARE)
    launch(
        kernels.unscale_cotangents,
        entries * plan.width // SHARE,
        bar.device,
        plan.state_dim,
        scale,
        plan.domain.smoothing_norm / norm,
        plan.row_base,
        plan.row_capacity,
        plan.group_count,
        saved.starts,
        saved.perception,
        bar,
        cotangents,
    )
    states_bar = bar.new_empty(plan.total, plan.state_dim)
    tile_count = -(-plan.particle_count // TILE)
    launch(
        kernels.gather_state_cotangents,
        plan.world_count * tile_count * plan.group_count * WARP,
        bar.device,
        plan.domain,
        norm,
        plan.particle_count,
        tile_count,
        plan.state_dim,
        plan.active_offset,
        plan.row_base,
        plan.row_capacity,
        plan.group_count,
        saved.starts,
        saved.particles,
        saved.source,
        saved.row_of,
        saved.row_positions,
        saved.row_kernel_sum,
        bar,
        cotangents,
        cotangents,
        states_bar,
    )
    return states_bar
