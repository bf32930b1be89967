"""Worlds whose particles never move: all that follows from positions, computed once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.portable.static import (
    ENTRY_SIZE,
    pair_kernels,
    pair_sum_kernels,
    state_update_kernels,
)
from npa_envs.ops.backend import Terms, compute_density_gradients
from npa_envs.ops.launch import channel_width, lane_count, launch, scalar_type
from npa_envs.ops.sort import LARGEST_INDEX, Plan, density_scale, make_plan, sort_worlds

CAPACITY = 128
"""Neighbours that a particle's list has room for on CUDA: a longer one is not kept."""

AHEAD = 4
"""Entries that threads of CUDA ask for together."""

LARGEST_LISTS = 2**31
"""Bytes of all lists, at most."""

LARGEST_PADDING = 4
"""Columns of a row beyond what is perceived, at most."""


class SettledTensors(NamedTuple):
    """What follows from positions, as tensors in this order; particles are sorted."""

    source: Tensor
    """Caller's index of each sorted particle, int32, shape [B N]."""
    place: Tensor
    """Sorted place of each particle in the caller's order, int32, shape [B N]."""
    starts: Tensor
    """First sorted place of every cell, int32."""
    particles: Tensor
    """Positions [length units] with volumes 1 / rho, shape [B N, D + 1]."""
    weights: Tensor
    """Of each neighbour v W and v K [1 / length units], and in 2D its place, shape [E, 4]."""
    neighbours: Tensor
    """Place of each neighbour, int32, shape [E]; empty in 2D."""
    ends: Tensor
    """Where each list ends, int32, shape [B N]; empty where each has as much room."""
    lengths: Tensor
    """Entries of each list, -1 where it is not kept, int32, shape [B N]."""
    kernel_sum: Tensor
    """Sums of v K [1 / length units], shape [B N, D]."""
    correction: Tensor
    """What corrects state gradients, dimensionless, shape [B N, D, D]; empty where nothing does."""
    density_columns: Tensor
    """Scaled density gradients, dimensionless, shape [B N, D]; empty where not perceived."""


class SettledWorlds(NamedTuple):
    """Worlds made ready for steps that change states alone; `settle` makes it."""

    tensors: SettledTensors
    """What follows from positions."""
    shape: tuple[int, int, int]
    """Worlds B, particles of each N, space dimension D."""
    state_dim: int
    """State channels C."""
    capacity: int
    """Room of each list, 0 where they end at `ends`."""
    eps: float
    """Perception radius [length units]."""
    scale: float
    """c = eps / eps0, dimensionless."""
    box: tuple[float, ...] | None
    """Sides of the periodic box [length units], or None in open space."""
    terms: Terms
    """Groups of the perception vector."""

    @property
    def total(self) -> int:
        """Particles of all worlds, B N."""
        return self.shape[0] * self.shape[1]


def entries_ahead(plan: Plan) -> int:
    """Return how many entries of lists are asked for together."""
    return AHEAD if plan.lanes > 1 else 1


def list_capacity(x: Tensor) -> int:
    """Return how much room each list has; 0: as much as it needs, which only a CPU can tell."""
    return CAPACITY if x.is_cuda else 0


def _entry_bytes(x: Tensor) -> int:
    return ENTRY_SIZE * x.element_size() + (4 if x.shape[-1] == 3 else 0)


def _kernels(plan: Plan, moment_inverse: str | None) -> Any:
    return pair_kernels(
        plan.space_dim, plan.scalar, plan.lanes, entries_ahead(plan), moment_inverse
    )


@torch.library.custom_op("npa::sort_settled", mutates_args=())
def _sort_settled(
    x: Tensor,
    state_dim: int,
    eps: float,
    box: list[float] | None,
    moment_inverse: str | None,
    density_gradient: bool,
    counted: bool,
) -> list[Tensor]:
    """Return the first four of `SettledTensors`, density gradients, and ends of lists if asked."""
    total = x.shape[0] * x.shape[1]
    plan = make_plan(x, x.shape, state_dim, total, False, eps, box)
    ordered = sort_worlds(plan, x, None, None)
    terms = Terms(density_gradient=density_gradient)
    densities = compute_density_gradients(plan, ordered, terms)
    lengths = x.new_empty(total if counted else 0, dtype=torch.int32)
    if counted:
        launch(
            _kernels(plan, moment_inverse).count_pairs,
            total,
            x.device,
            plan.domain,
            plan.particle_count,
            ordered.starts,
            densities.particles,
            lengths,
        )
    return [
        ordered.source,
        ordered.row_of,
        ordered.starts,
        densities.particles,
        densities.row_density_gradient,
        torch.cumsum(lengths, 0, dtype=torch.int64),
    ]


@_sort_settled.register_fake
def _(
    x: Tensor,
    state_dim: int,
    eps: float,
    box: list[float] | None,
    moment_inverse: str | None,
    density_gradient: bool,
    counted: bool,
) -> list[Tensor]:
    total, space_dim = x.shape[0] * x.shape[1], x.shape[2]
    plan = make_plan(x, x.shape, state_dim, total, False, eps, box)
    return [
        x.new_empty(total, dtype=torch.int32),
        x.new_empty(total, dtype=torch.int32),
        x.new_empty(plan.start_count, dtype=torch.int32),
        x.new_empty(total, space_dim + 1),
        x.new_empty(total, space_dim, dtype=torch.float64),
        x.new_empty(total if counted else 0, dtype=torch.int64),
    ]


def _empty_lists(
    particles: Tensor, entry_count: int, moment_inverse: str | None, density_gradient: bool
) -> list[Tensor]:
    """Return what listing fills in: weights, neighbours, lengths, and what else is kept."""
    total, space_dim = particles.shape[0], particles.shape[1] - 1
    integers = torch.int32
    return [
        particles.new_empty(entry_count, ENTRY_SIZE),
        particles.new_empty(entry_count if space_dim == 3 else 0, dtype=integers),
        particles.new_empty(total, dtype=integers),
        particles.new_empty(total, space_dim),
        particles.new_empty(0 if moment_inverse is None else total, space_dim, space_dim),
        particles.new_empty(total if density_gradient else 0, space_dim),
    ]


@torch.library.custom_op("npa::list_pairs", mutates_args=())
def _list_pairs(
    starts: Tensor,
    particles: Tensor,
    gradients: Tensor,
    ends: Tensor,
    entry_count: int,
    capacity: int,
    shape: list[int],
    state_dim: int,
    eps: float,
    scale: float,
    box: list[float] | None,
    moment_inverse: str | None,
    density_gradient: bool,
) -> list[Tensor]:
    plan = make_plan(particles, shape, state_dim, particles.shape[0], False, eps, box)
    lists = _empty_lists(particles, entry_count, moment_inverse, density_gradient)
    launch(
        _kernels(plan, moment_inverse).list_pairs,
        plan.total,
        particles.device,
        plan.domain,
        plan.particle_count,
        capacity,
        int(density_gradient),
        density_scale(scale, plan.space_dim, plan.particle_count),
        starts,
        particles,
        gradients,
        ends,
        *lists,
    )
    return lists


@_list_pairs.register_fake
def _(
    starts: Tensor,
    particles: Tensor,
    gradients: Tensor,
    ends: Tensor,
    entry_count: int,
    *options: Any,
) -> list[Tensor]:
    return _empty_lists(particles, entry_count, *options[-2:])


def settle(
    x: Tensor,
    state_dim: int,
    *,
    eps: float,
    eps0: float,
    box: tuple[float, ...] | None,
    terms: Terms,
) -> SettledWorlds | None:
    """Sort checked worlds whose particles will not move, and weigh all pairs of neighbours.

    No gradient flows into positions. On the CPU lists are as long as they need to be, which on CUDA
    would stall the stream.

    Args:
        x: Positions [length units], shape [B, N, D].
        state_dim: State channels C.
        eps: Perception radius [length units].
        eps0: Radius at which the rule was trained [length units].
        box: Sides of the periodic box [length units], or None in open space.
        terms: Groups of the perception vector.

    Returns:
        The worlds, or None where the lists would take more than `LARGEST_LISTS` bytes, or all rows
        more numbers than kernels index.
    """
    x = x.detach().contiguous()
    world_count, particle_count, space_dim = x.shape
    total = world_count * particle_count
    capacity = list_capacity(x)
    sides = None if box is None else list(box)
    row_numbers = total * (terms.perception_dim(space_dim, state_dim) + LARGEST_PADDING)
    if row_numbers >= LARGEST_INDEX or total * capacity * _entry_bytes(x) > LARGEST_LISTS:
        return None
    source, place, starts, particles, gradients, ends = _sort_settled(
        x, state_dim, eps, sides, terms.correction, terms.density_gradient, capacity == 0
    )
    # Reading the number is free on the CPU.
    entry_count = total * capacity if capacity else int(ends[-1])
    if entry_count * _entry_bytes(x) > LARGEST_LISTS:
        return None
    ends = ends.to(torch.int32)
    weights, neighbours, *rest = _list_pairs(
        starts,
        particles,
        gradients,
        ends,
        entry_count,
        capacity,
        list(x.shape),
        state_dim,
        eps,
        eps / eps0,
        sides,
        terms.correction,
        terms.density_gradient,
    )
    tensors = SettledTensors(source, place, starts, particles, weights, neighbours, ends, *rest)
    shape = world_count, particle_count, space_dim
    return SettledWorlds(tensors, shape, state_dim, capacity, eps, eps / eps0, box, terms)


# States of worlds whose particles never move: in which order they are, and their update.
#
# They stay in the sorted order from the first step to the last, a particle's channels padded with
# zeros to whole groups.


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


# Perception of particles that never move as an opaque torch operator with a gathered adjoint.


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


# Steps of worlds whose particles never move: their rows, drawn some steps ahead, and one step.


DRAWN_AHEAD = 16
"""Steps whose masks are drawn together, at most: they are given rows in few launches."""

DRAWN_PARTICLES = 2**24
"""Particles of masks that are drawn together, if there are several."""


def drawn_rows(
    worlds: SettledWorlds, draw: Callable[[], Tensor | None], steps: int, row_capacity: int
) -> Iterator[tuple[SettledRows]]:
    """Return an iterator over the rows of steps, each alone in a tuple.

    Args:
        worlds: The worlds.
        draw: Draws a step's update mask, uint8 of ones and zeros, shape [B, N]; or None for all in
            every step.
        steps: Number of steps.
        row_capacity: Rows K of each step on CUDA; on the CPU each has as many as it needs.
    """
    ahead = max(min(DRAWN_AHEAD, DRAWN_PARTICLES // worlds.total), 1)
    for first in range(0, steps, ahead):
        drawn = [draw() for _ in range(min(ahead, steps - first))]
        masks = [mask for mask in drawn if mask is not None]
        if masks:
            yield from zip(settled_rows(worlds, masks, row_capacity))
        else:
            yield from [(all_rows(worlds),)] * len(drawn)


def advance_settled(
    network: Callable[[Tensor], Tensor],
    row_width: int,
    dt: float,
    worlds: SettledWorlds,
    states: Tensor,
    rows: SettledRows,
) -> tuple[Tensor]:
    """Advance states by one step; alone in a tuple.

    Args:
        network: Maps rows of perception, [K, row_width], to updates Δs, [K, C] or wider.
        row_width: Columns of its rows.
        dt: Time step, dimensionless.
        worlds: The worlds.
        states: States as `settled_states` returns them, shape [B N, C'].
        rows: Which particles are active.
    """
    perception = perceive_settled(worlds, states, rows, row_width=row_width)
    return (update_settled(worlds, states, network(perception), rows, dt),)
