"""States of worlds whose particles never move: in which order they are, and their update.

They stay in the sorted order from the first step to the last, a particle's channels padded with
zeros to whole groups.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.portable.static import state_update_kernels
from npa_envs.sph.bridge import channel_width, lane_count, launch, scalar_type
from npa_envs.sph.cells import LARGEST_INDEX
from npa_envs.sph.settled import SettledWorlds


class SettledRows(NamedTuple):
    """Which sorted particles a step's rows stand for; tensors are empty where each has its own."""

    row_of: Tensor
    """Row of each sorted particle, -1 where it has none, int32, shape [B N]."""
    row_place: Tensor
    """Sorted place of each row, int32, shape [K]; undefined beyond the last active row."""
    active_before: Tensor
    """Active particles up to each sorted place, itself included, int32, shape [B N]."""
    row_capacity: int
    """Rows K."""


def group_width(like: Tensor, state_dim: int) -> int:
    """Return how many channels of a settled particle form a group: on CUDA 16 bytes of float32."""
    return lane_count(like.device) if like.is_cuda else channel_width(state_dim)


def padded_channels(like: Tensor, state_dim: int) -> int:
    """Return how many channels a settled particle's state has room for."""
    width = group_width(like, state_dim)
    return -(-state_dim // width) * width


@torch.library.custom_op("npa::reorder", mutates_args=())
def _reorder(values: Tensor, order: Tensor, columns: int) -> Tensor:
    moved = values.index_select(0, order)
    return torch.nn.functional.pad(moved, (0, columns - values.shape[1])).contiguous()


@_reorder.register_fake
def _(values: Tensor, order: Tensor, columns: int) -> Tensor:
    return values.new_empty(order.shape[0], columns)


class _Reordered(torch.autograd.Function):
    """Rows in another order, their columns cut off or padded with zeros."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, order: Tensor, inverse: Tensor, columns: int) -> Tensor:
        ctx.save_for_backward(inverse)
        ctx.columns = values.shape[1]
        # An opaque operator: of plain ones in here, torch.compile of torch 2.11 loses the gradient.
        result: Tensor = _reorder(values, order, columns)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        (inverse,) = ctx.saved_tensors
        return _reorder(bar, inverse, ctx.columns), None, None, None


def settled_states(worlds: SettledWorlds, s: Tensor) -> Tensor:
    """Return states, [B, N, C], as the steps take them: sorted and padded, [B N, C']."""
    tensors = worlds.tensors
    columns = padded_channels(s, worlds.state_dim)
    result: Tensor = _Reordered.apply(  # type: ignore[no-untyped-call]
        s.reshape(worlds.total, worlds.state_dim), tensors.source, tensors.place, columns
    )
    return result


def unsettled_states(worlds: SettledWorlds, states: Tensor) -> Tensor:
    """Return states of the steps, [B N, C'], in the caller's order, [B, N, C]."""
    tensors = worlds.tensors
    result: Tensor = _Reordered.apply(  # type: ignore[no-untyped-call]
        states, tensors.place, tensors.source, worlds.state_dim
    )
    return result.view(*worlds.shape[:2], worlds.state_dim)


@torch.library.custom_op("npa::settled_rows", mutates_args=())
def _settled_rows(masks: Tensor, source: Tensor, row_capacity: int) -> list[Tensor]:
    step_count, total = masks.shape[0], source.shape[0]
    active = masks.view(step_count, total).index_select(1, source)
    active_before = torch.cumsum(active, 1, dtype=torch.int32)
    row_of = torch.empty_like(active_before)
    row_place = source.new_empty(step_count, row_capacity)
    launch(
        state_update_kernels(scalar_type(torch.float32), 4).give_rows,
        step_count * total,
        masks.device,
        total,
        row_capacity,
        active_before.view(-1),
        row_of.view(-1),
        row_place.view(-1),
    )
    return [row_of, row_place, active_before]


@_settled_rows.register_fake
def _(masks: Tensor, source: Tensor, row_capacity: int) -> list[Tensor]:
    steps, total = masks.shape[0], source.shape[0]
    sizes = total, row_capacity, total
    return [source.new_empty(steps, size) for size in sizes]


def settled_rows(
    worlds: SettledWorlds, masks: list[Tensor], row_capacity: int
) -> list[SettledRows]:
    """Give the active particles of each of some steps rows, all steps at once.

    Args:
        worlds: The worlds.
        masks: Which particles are active in each step, in the caller's order, uint8 of ones and
            zeros, shape [B, N].
        row_capacity: Rows K on CUDA; active particles beyond them get none. On the CPU each step
            has as many as it needs, at least one.
    """
    source = worlds.tensors.source
    if not source.is_cuda:
        row_capacity = worlds.total
    found = _settled_rows(torch.stack(masks), source, row_capacity)
    steps = [
        SettledRows(row_of, row_place, active_before, row_capacity)
        for row_of, row_place, active_before in zip(*found, strict=True)
    ]
    if source.is_cuda:
        return steps
    # Counting is free on the CPU; on CUDA it would stall the stream.
    counts = [max(count, 1) for count in found[2][:, -1].tolist()]
    return [
        rows._replace(row_place=rows.row_place[:count], row_capacity=count)
        for rows, count in zip(steps, counts, strict=True)
    ]


def all_rows(worlds: SettledWorlds) -> SettledRows:
    """Return the rows of a step in which all particles are active."""
    none = worlds.tensors.source.new_empty(0)
    return SettledRows(none, none, none, worlds.total)


@torch.library.custom_op("npa::update_settled", mutates_args=())
def _update_settled(
    states: Tensor, update: Tensor, row_of: Tensor, state_dim: int, dt: float
) -> Tensor:
    if update.numel() >= LARGEST_INDEX:
        raise NPAError(
            f"updates must stay below {LARGEST_INDEX} numbers in one batch, got "
            f"{update.numel()}: split the batch"
        )
    update = update.contiguous()
    width = group_width(states, state_dim)
    group_count = states.shape[1] // width
    new_states = torch.empty_like(states, memory_format=torch.contiguous_format)
    aligned = update.shape[1] % width == 0 and update.data_ptr() % 16 == 0
    launch(
        state_update_kernels(scalar_type(states.dtype), width).update_states,
        states.shape[0] * group_count,
        states.device,
        dt,
        state_dim,
        group_count,
        update.shape[1],
        int(aligned),
        row_of,
        update.view(-1),
        states.contiguous().view(-1, width),
        new_states.view(-1, width),
    )
    return new_states


@_update_settled.register_fake
def _(states: Tensor, *rest: Any) -> Tensor:
    return torch.empty_like(states, memory_format=torch.contiguous_format)


@torch.library.custom_op("npa::update_settled_backward", mutates_args=())
def _update_settled_backward(
    new_states_bar: Tensor,
    row_place: Tensor,
    active_before: Tensor,
    row_capacity: int,
    update_width: int,
    state_dim: int,
    dt: float,
) -> Tensor:
    width = group_width(new_states_bar, state_dim)
    update_bar = new_states_bar.new_empty(row_capacity, update_width)
    launch(
        state_update_kernels(scalar_type(new_states_bar.dtype), width).pull_back_update,
        row_capacity * -(-update_width // width),
        update_bar.device,
        dt,
        state_dim,
        new_states_bar.shape[1] // width,
        update_width,
        int(update_width % width == 0),
        row_place,
        active_before,
        new_states_bar.contiguous().view(-1, width),
        update_bar.view(-1),
    )
    return update_bar


@_update_settled_backward.register_fake
def _(
    new_states_bar: Tensor,
    row_place: Tensor,
    active_before: Tensor,
    row_capacity: int,
    update_width: int,
    *options: Any,
) -> Tensor:
    return new_states_bar.new_empty(row_capacity, update_width)


class _UpdateSettled(torch.autograd.Function):
    """States after one update of the active particles."""

    @staticmethod
    def forward(
        ctx: Any, states: Tensor, update: Tensor, rows: SettledRows, state_dim: int, dt: float
    ) -> Tensor:
        ctx.options = (*update.shape, state_dim, dt)
        ctx.save_for_backward(rows.row_place, rows.active_before)
        new_states: Tensor = _update_settled(states, update, rows.row_of, state_dim, dt)
        return new_states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        update_bar = None
        if ctx.needs_input_grad[1]:
            update_bar = _update_settled_backward(bar, *ctx.saved_tensors, *ctx.options)
        return bar, update_bar, None, None, None


def update_settled(
    worlds: SettledWorlds, states: Tensor, update: Tensor, rows: SettledRows, dt: float
) -> Tensor:
    """Apply a rule's outputs to the states of the particles that have rows.

    Args:
        worlds: The worlds.
        states: States as `settled_states` returns them, shape [B N, C'].
        update: Updates Δs, dimensionless, shape [K, C] or wider; the columns beyond C are not read.
        rows: Which particles the rows stand for.
        dt: Time step, dimensionless.

    Returns:
        The states after it, shape [B N, C'].
    """
    new_states: Tensor = _UpdateSettled.apply(  # type: ignore[no-untyped-call]
        states, update, rows, worlds.state_dim, dt
    )
    return new_states
