"""The update of particles from a rule's outputs as an opaque torch operator with its adjoint."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.portable.update import CHANNEL_SHARE, TEAM, UPDATE_ALIGNMENT, update_kernels
from npa_envs.sph.bridge import launch, scalar_type
from npa_envs.sph.cells import LARGEST_INDEX
from npa_envs.sph.operators import Rows


def _sharers(count: int) -> int:
    """Return how many threads share `count` channels."""
    return -(-count // CHANNEL_SHARE)


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
    if update.numel() >= LARGEST_INDEX:
        raise NPAError(
            f"updates must stay below {LARGEST_INDEX} numbers in one batch, got "
            f"{update.numel()}: split the batch"
        )
    outputs = torch.empty_like(x), torch.empty_like(s), torch.empty_like(path_length)
    update = update.contiguous()
    # Adjacent channels are then read and written at once: their places are aligned in memory.
    alignment = UPDATE_ALIGNMENT[space_dim]
    aligned = state_dim % CHANNEL_SHARE == 0 and s.data_ptr() % 16 == 0
    aligned = aligned and (4 * update.shape[1]) % alignment == 0
    aligned = aligned and update.data_ptr() % alignment == 0
    launch(
        kernels.apply_update,
        -(-total // TEAM) * TEAM * (1 + _sharers(state_dim)),
        x.device,
        reach * dt,
        dt,
        int(box is not None),
        tuple(box) if box is not None else (1.0,) * space_dim,
        int(moving),
        state_dim,
        update.shape[1],
        int(aligned),
        row_of,
        update.view(-1),
        x.view(total, space_dim),
        s.view(-1),
        path_length.view(total),
        outputs[0].view(total, space_dim),
        outputs[1].view(-1),
        outputs[2].view(total),
    )
    return outputs


@_update_particles.register_fake
def _(
    update: Tensor, x: Tensor, s: Tensor, path_length: Tensor, *rest: Any
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
        update.shape[0] * _sharers(update.shape[1]),
        update.device,
        reach * dt,
        dt,
        int(moving),
        row_base,
        state_dim,
        update.shape[1],
        int(update.shape[1] % CHANNEL_SHARE == 0),
        starts,
        row_source,
        update.contiguous().view(-1),
        new_x_bar.contiguous().view(-1, space_dim),
        new_s_bar.contiguous().view(-1),
        new_path_bar.contiguous().view(-1),
        update_bar.view(-1),
    )
    return update_bar


@_update_particles_backward.register_fake
def _(update: Tensor, *rest: Any) -> Tensor:
    return torch.empty_like(update, memory_format=torch.contiguous_format)


class _UpdateParticles(torch.autograd.Function):
    """Positions, states and path lengths after one update of the active particles."""

    @staticmethod
    def forward(
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
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
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
    outputs: tuple[Tensor, Tensor, Tensor] = _UpdateParticles.apply(  # type: ignore[no-untyped-call]
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


def wrapped(x: Tensor, box: tuple[float, ...] | None) -> Tensor:
    """Return a copy of positions, wrapped into the periodic box if there is one.

    Args:
        x: Positions [length units], shape [B, N, D].
        box: Sides of the box, centred on the origin [length units], or None.
    """
    if box is None:
        return x.clone()
    images = [torch.floor(x.detach()[..., d] / side + 0.5) for d, side in enumerate(box)]
    return x - torch.stack([side * image for side, image in zip(box, images, strict=True)], dim=-1)
