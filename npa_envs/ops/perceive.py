"""Perception: vectors and fields of whole worlds, rows of active particles in rollouts.

Each is a custom torch operator, which torch.compile does not trace. The autograd functions save
only tensors that the adjoint of the case reads.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from npa_envs.checks import (
    Box,
    MomentInverse,
    check_world,
    checked_choice,
    checked_eps,
    checked_flag,
    checked_once,
)
from npa_envs.ops.custom_op import check_derivatives, custom_op, once_differentiable
from npa_envs.ops.launch import RecordedLaunches, channel_width, is_aligned, launch
from npa_envs.ops.perception_passes import (
    SavedPerception,
    compute_densities,
    compute_densities_in_cells,
    perceive_backward,
    perceive_rows_backward,
    perception_launch,
    portable_kernels,
    saved_together,
    search_threads,
)
from npa_envs.ops.physics import Physics, Terms, make_physics
from npa_envs.ops.position_check import checked_positions
from npa_envs.ops.sort import SortedWorlds, plan_kernels, sort_worlds
from npa_envs.ops.static_worlds import StaticRows, StaticWorlds, static_worlds


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

    def __repr__(self) -> str:
        """Return the names and shapes of the fields."""
        shapes = (f"{name}={list(field.shape)}" for name, field in self._asdict().items())
        return f"PerceptionFields({', '.join(shapes)})"


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
    (arXiv 2601.16096, section 3). Bit-identical from run to run, and for a world alone or in any
    batch.

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
        Perception vectors z, dimensionless, shape [B, N, P], P = C(2+D)+D with both gradients; the
        backward pass reads them, so change a clone.

    Raises:
        NPAError: Shapes, dtypes or devices do not fit, a position is not finite, eps or eps0 is
            not positive and finite, a box side is below 2 eps, or `moment_inverse` is unknown.
    """
    options = state_gradient, moment_correction, density_gradient, moment_inverse
    physics = checked_physics(x, s, eps, eps0, box, *options)
    seen, states = x.contiguous(), s.contiguous()
    if checked_flag("detach_positions", detach_positions) and seen.requires_grad:
        seen = seen.detach()
    perception: Tensor
    with checked_positions(seen):
        if torch.is_grad_enabled() and (seen.requires_grad or states.requires_grad):
            perception = _Perceive.apply(seen, states, physics)  # type: ignore[no-untyped-call]
        else:
            (perception,) = _perceive(seen, states, physics, False, False)
    return perception


@custom_op("npa::perceive", of_all=True)
def _perceive(
    x: Tensor, s: Tensor, physics: Physics, for_adjoint: bool, with_positions: bool
) -> list[Tensor]:
    """Return every particle's perception, [B, N, P], and a block of bytes `for_adjoint`."""
    world_count, particle_count, space_dim = map(int, x.shape)
    total, state_dim = world_count * particle_count, s.shape[2]
    plan = plan_kernels(x, x.shape, state_dim, total, False, physics)
    out = x.new_empty(
        world_count, particle_count, physics.terms.perception_dim(space_dim, plan.state_dim)
    )
    results, saved, into = [out], None, {}
    if for_adjoint:
        block, saved = saved_together(plan, out.view(total, -1), with_positions)
        results.append(block)
        parts = saved._asdict().items()
        into = {k: v for k, v in parts if k in SortedWorlds._fields and v is not None}
    ordered = sort_worlds(plan, x, s, None, into=into)
    densities = compute_densities(
        plan, ordered, with_particles=for_adjoint, particles=saved and saved.particles
    )
    launch(
        *perception_launch(
            plan,
            ordered,
            densities,
            out.view(total, -1),
            destination=ordered.original_index,
            row_kernel_sum=saved and saved.row_kernel_sum,
        )
    )
    return results


class _Perceive(torch.autograd.Function):
    """Autograd function of `_perceive`; its backward pass is `perceive_backward`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, s: Tensor, physics: Physics) -> Tensor:
        perception: Tensor
        perception, block = _perceive(x, s, physics, True, ctx.needs_input_grad[0])
        ctx.shapes, ctx.physics = (x.shape, s.shape), physics
        ctx.save_for_backward(perception, block)
        return perception

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        perception, block = ctx.saved_tensors
        x_shape, s_shape = ctx.shapes
        bar, moving = bar.contiguous(), ctx.needs_input_grad[0]
        states_bar, *positions_bar = perceive_backward(
            bar, perception, block, x_shape[2], s_shape[2], moving, ctx.physics
        )
        return positions_bar[0] if moving else None, states_bar, None


def checked_physics(x: Tensor, s: Tensor, *options: Any) -> Physics:
    """Check worlds to perceive, except values, and options; return these as a `Physics`.

    The options are those of `perceive`, but for `detach_positions`, in their order.
    """
    physics = _physics(x, s, *options)
    check_derivatives(x=x, s=s)
    return physics


@checked_once
def _physics(
    x: Tensor,
    s: Tensor,
    eps: float,
    eps0: float | None,
    box: Box,
    state_gradient: bool = True,
    moment_correction: bool = True,
    density_gradient: bool = True,
    moment_inverse: str = "threshold",
) -> Physics:
    inverse = checked_choice("moment_inverse", moment_inverse, get_args(MomentInverse))
    terms = Terms(
        checked_flag("state_gradient", state_gradient),
        inverse if checked_flag("moment_correction", moment_correction) else None,
        checked_flag("density_gradient", density_gradient),
    )
    check_world(x, s)
    space_dim, state_dim = x.shape[2], s.shape[2]
    if eps0 is not None:
        eps0 = checked_eps("eps0", eps0, space_dim, x.dtype)
    return make_physics(space_dim, state_dim, x.dtype, eps=eps, eps0=eps0, box=box, terms=terms)


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

    Arguments and errors are those of `perceive`; `moment_inverse` is how `grad1` is corrected.
    """
    physics = checked_physics(x, s, eps, None, box, True, True, True, moment_inverse)
    with checked_positions(x):
        *fields, gradients, row_of = _gather_fields(x.contiguous(), s.contiguous(), physics)
        fields.append(gradients.index_select(0, row_of).to(x.dtype).view(x.shape))
    return PerceptionFields._make(fields)


@custom_op("npa::perception_fields", of_all=True)
def _gather_fields(x: Tensor, s: Tensor, physics: Physics) -> list[Tensor]:
    """Return all fields but density gradients; then these of rows, [B N, D], and each one's row."""
    world_count, particle_count, space_dim = worlds = tuple(map(int, x.shape))
    shape, state_dim = worlds[:2], int(s.shape[2])
    plan = plan_kernels(x, worlds, state_dim, world_count * particle_count, False, physics)
    ordered = sort_worlds(plan, x, s, None)
    densities = compute_densities_in_cells(plan, ordered)
    kernels = portable_kernels(plan)
    fields = [
        x.new_empty(shape),
        x.new_empty(*shape, state_dim),
        x.new_empty(*shape, state_dim, space_dim),
        x.new_empty(*shape, space_dim, space_dim),
        x.new_empty(*shape, state_dim, space_dim),
    ]
    launch(
        kernels.gather_fields,
        (search_threads(plan.total, plan.on_cpu), plan.group_count),
        x.device,
        plan.domain,
        particle_count,
        state_dim,
        plan.group_count,
        ordered.starts,
        densities.particles,
        ordered.states,
        ordered.original_index,
        *(field.flatten(0, 1) for field in fields),
    )
    return [*fields, densities.density_gradient, ordered.row_of]


class Rows(NamedTuple):
    """Which row of a perception matrix is of which particle; only active particles have rows."""

    row_of: Tensor
    """Row of each particle, -1 for none, int32, shape [B N]."""
    row_particle: Tensor
    """Particle of each row, int32, shape [K]; undefined beyond the last active row."""
    starts: Tensor
    """`SortedWorlds.starts`; the last entry minus `row_base` is the number of active rows."""
    row_base: int


@custom_op("npa::perceive_rows")
def _perceive_rows(
    x: Tensor,
    s: Tensor,
    mask: Tensor | None,
    static: list[Tensor],
    masked: bool,
    row_capacity: int,
    row_width: int,
    physics: Physics,
    for_adjoint: bool,
) -> list[Tensor]:
    """Return the tensors of a `SavedPerception`, and then `Rows.row_particle`.

    For static worlds only the first two: the others are in `static`, [] for worlds that move.
    """
    plan = plan_kernels(x, x.shape, s.shape[2], row_capacity, masked, physics)
    if static:
        rows, worlds = StaticRows(*static[:4]), StaticWorlds.from_list(static[4:])
        ordered, densities = static_worlds(plan, worlds, rows, x, s)
    else:
        ordered = sort_worlds(plan, x, s, mask)
        densities = compute_densities(plan, ordered, with_particles=for_adjoint)
    perception = x.new_empty(row_capacity, row_width)
    kernel_sum = x.new_empty(row_capacity if for_adjoint else 0, plan.space_dim)
    written = kernel_sum if for_adjoint else None
    launch(*perception_launch(plan, ordered, densities, perception, row_kernel_sum=written))
    if static:
        return [perception, kernel_sum]
    sorted_worlds = ordered.row_of, ordered.starts, ordered.original_index, densities.particles
    of_rows = ordered.row_positions, ordered.states, ordered.row_particle
    return [perception, kernel_sum, *sorted_worlds, *of_rows]


class _PerceiveRows(torch.autograd.Function):
    """Autograd function of `saved_perception`; its backward pass is `perceive_rows_backward`."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        saved, row_particle = saved_perception(*arguments, True)
        _, s, _, static, _, masked, *_, physics = arguments
        ctx.set_materialize_grads(False)
        ctx.shape, ctx.masked, ctx.physics = s.shape, masked, physics
        tensors = saved if ctx.needs_input_grad[0] else saved[:-1]
        neighbours = () if static is None else static.neighbours or ()
        ctx.saved_count = len(tensors)
        ctx.save_for_backward(*tensors, *neighbours)
        if static is not None:
            return (saved.perception,)
        ctx.mark_non_differentiable(saved.row_of, row_particle, saved.starts)
        return saved.perception, saved.row_of, row_particle, saved.starts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        states_bar = x_bar = None
        if bar is not None:
            # Read once: under a checkpoint each reading recomputes them.
            tensors = list(ctx.saved_tensors)
            count, shape = ctx.saved_count, ctx.shape
            saved, neighbours = tensors[:count], tensors[count:]
            states_bar, positions_bar = perceive_rows_backward(
                bar, saved, neighbours, shape[1], shape[2], ctx.masked, ctx.physics
            )
            states_bar = states_bar.view(shape)
            x_bar = positions_bar.view(*shape[:2], -1) if ctx.needs_input_grad[0] else None
        return x_bar, states_bar, *[None] * 7


def saved_perception(
    x: Tensor,
    s: Tensor,
    mask: Tensor | None,
    static: StaticWorlds | None,
    rows: StaticRows | None,
    *options: Any,
) -> tuple[SavedPerception, Tensor]:
    """Return the results of `_perceive_rows`; `options` are its arguments from `masked` on."""
    if static is None or rows is None:
        *saved_tensors, row_particle = _perceive_rows(x, s, mask, [], *options)
        return SavedPerception(*saved_tensors), row_particle
    perception, kernel_sum = _perceive_rows(x, s, None, [*rows, *static.to_list()], *options)
    saved = SavedPerception(
        perception,
        kernel_sum,
        row_of=rows.row_of,
        starts=rows.starts,
        original_index=static.all_indices,
        particles=static.particles,
        row_positions=rows.row_positions,
    )
    return saved, rows.row_particle


def perceive_rows(
    x: Tensor,
    s: Tensor,
    physics: Physics,
    *,
    mask: Tensor | None,
    row_capacity: int,
    row_width: int,
    static: StaticWorlds | None = None,
    static_rows: StaticRows | None = None,
) -> tuple[Tensor, Rows]:
    """Return perception vectors of active particles as rows; x and s are not checked.

    Args:
        mask: Which particles are active, uint8, shape [B, N], or None for all.
        row_capacity: Number K of rows; active particles beyond it are left out.
        row_width: Columns of a row, at least P: the perception vector, a one, then zeros.
        static: Result of `prepare_static` for worlds whose particles do not move. Then x and s are
            in its sorted order, no gradient flows into x, and the mask is not read.
        static_rows: Active particles of static worlds, a result of `static_rows`; None: all.

    Returns:
        The rows, shape [K, row_width], zero beyond the last active particle's, and the indices
        between rows and particles.
    """
    x, s, rows = x.contiguous(), s.contiguous(), static_rows
    masked = (mask if static is None else static_rows) is not None
    if static is not None:
        x, every = x.detach(), static.all_indices
        rows = rows or StaticRows(every, every, static.starts, x.flatten(0, 1))
    arguments = x, s, mask, static, rows, masked, row_capacity, row_width, physics
    if torch.is_grad_enabled() and (x.requires_grad or s.requires_grad):
        perception, *maps = _PerceiveRows.apply(*arguments)  # type: ignore[no-untyped-call]
    else:
        saved, row_particle = saved_perception(*arguments, False)
        perception, maps = saved.perception, [saved.row_of, row_particle, saved.starts]
    row_of, row_particle, starts = maps if rows is None else rows[:3]
    return perception, Rows(row_of, row_particle, starts, x.shape[0] * x.shape[1] if masked else 0)


ROWS_TOGETHER = 2**22
"""Number of rows of huge worlds that are perceived and mapped to updates at a time."""


def updates_in_parts(
    x: Tensor,
    s: Tensor,
    physics: Physics,
    mask: Tensor | None,
    network: Callable[[Tensor], Tensor],
    row_capacity: int,
    row_width: int,
) -> tuple[Tensor, Rows]:
    """Return updates of huge worlds' active particles, [K, A'], and `Rows`; not differentiable.

    They are computed in parts, as all rows of `perceive_rows` would take most of the memory. The
    network maps rows [any, row_width] to A' outputs each, independently, so results are the same.
    """
    x, s = x.detach().contiguous(), s.detach().contiguous()
    plan = plan_kernels(x, x.shape, s.shape[2], row_capacity, mask is not None, physics)
    ordered = sort_worlds(plan, x, s, mask)
    densities = compute_densities(plan, ordered, with_particles=False)
    perception = x.new_empty(min(ROWS_TOGETHER, row_capacity), row_width)
    updates = None
    for first in range(0, row_capacity, ROWS_TOGETHER):
        part = perception[: min(ROWS_TOGETHER, row_capacity - first)]
        arguments = perception_launch(
            plan, ordered, densities, part, first_row=first, row_count=len(part)
        )
        launch(*arguments)
        mapped = network(part)
        if updates is None:
            updates = mapped.new_empty(row_capacity, mapped.shape[1])
        updates[first : first + len(part)] = mapped
    assert updates is not None, "worlds have particles"
    return updates, Rows(ordered.row_of, ordered.row_particle, ordered.starts, plan.row_base)


# For environments: every particle, in the caller's order, clipped, without gradients.


class NeighbourState:
    """Worlds x and s, unchecked, sorted into cells with densities; changes need an `update`.

    `world_indices`, int64, shape [B], are the worlds' indices in a larger batch, into which
    perception is written; None: the worlds are the whole batch.
    """

    def __init__(
        self, x: Tensor, s: Tensor, physics: Physics, world_indices: Tensor | None = None
    ) -> None:
        self._worlds = x, s, world_indices
        self._shape = *x.shape[:2], physics.perception_dim
        sizes = x.shape, s.shape[2], x.shape[:2].numel()
        self._plan = plan_kernels(x, *sizes, False, physics, for_environments=True)
        self._sorting: RecordedLaunches | None = None
        self._sort()

    def _sort(self) -> None:
        plan, (x, s, world_indices) = self._plan, self._worlds
        x, s = x.contiguous(), s.contiguous()
        with_lists = plan.lists_neighbours
        in_place = with_lists and plan.state_dim % plan.width == 0 and is_aligned(s)
        ordered = sort_worlds(plan, x, None if in_place else s, None, with_rows=not with_lists)
        densities = compute_densities(
            plan,
            ordered,
            state_index=ordered.original_index if in_place else None,
            with_particles=False,
        )
        destination = ordered.original_index
        if world_indices is not None:
            moved = world_indices - torch.arange(len(world_indices), device=x.device)
            shift = (moved * plan.particle_count).int()[:, None]
            destination = (destination.view(plan.world_count, -1) + shift).view(-1)
        self._launch_of = functools.partial(
            perception_launch,
            plan,
            ordered,
            densities,
            states=s if in_place else None,
            destination=destination,
            limit=plan.physics.limits.perception,
        )
        self._sorted = ordered, densities
        self._smoothing: tuple[Tensor, Tensor, Tensor, RecordedLaunches] | None = None
        self._perceived = False
        self._recorded: RecordedLaunches | None = None

    def update(self) -> None:
        """Sort contiguous worlds, the whole batch, again after they changed in place.

        Later calls for small worlds on a CPU take less time.
        """
        if self._sorting is not None:
            self._sorting.replay()
        elif self._plan.runs("sort") == "world":
            self._sorting = RecordedLaunches()
            with self._sorting.recording():
                self._sort()
        else:
            self._sort()

    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return every particle's perception, clipped to `Limits.perception`, shape [B, N, P].

        It is written to `out`, with `world_indices` of the larger batch's shape; None: to a new
        tensor. Later calls take less CPU time.
        """
        if out is None:
            out = self._worlds[0].new_empty(self._shape)
        rows = out.view(-1, self._shape[-1])
        if not self._perceived:
            # Many worlds are perceived once: recorded launches would cost more than they save.
            self._perceived = True
            launch(*self._launch_of(rows))
            return out
        layout = rows.shape, rows.dtype, rows.device, rows.is_contiguous()
        if self._recorded is None:
            self._recorded, self._layout = RecordedLaunches(), layout
            self._recorded.add(*self._launch_of(rows))
            self._slots = self._recorded.argument_slots(rows)
        assert layout == self._layout, "only the address may change"
        self._recorded.move(self._slots, rows)
        self._recorded.replay()
        return out

    def smoothed_species(self, species: Tensor, species_count: int) -> Tensor:
        """Return tags of each species, smoothed as `perceive` smooths states, [B, N, S].

        A tag is 1 for particles of its species, int64 [N], and 0 for others; only on a CPU. Later
        calls, for the same species, overwrite the result and take less CPU time.
        """
        ordered, densities = self._sorted
        if self._smoothing is None:
            assert self._plan.on_cpu, "CUDA's lists of neighbours are of the worlds' states"
            width = channel_width(species_count)
            physics = self._plan.physics._replace(terms=Terms(False, None, False))
            plan = self._plan._replace(state_dim=species_count, width=width, physics=physics)
            tags = (species[:, None] == torch.arange(plan.group_count * width)).to(densities[0])
            tags = tags.repeat(plan.world_count, 1)
            states, out = torch.empty_like(tags), tags.new_empty(plan.total, 2 * species_count)
            ordered, destination = ordered._replace(states=states), ordered.original_index
            recorded = RecordedLaunches()
            recorded.add(*perception_launch(plan, ordered, densities, out, destination=destination))
            smoothed = out.view(*self._shape[:2], -1)[..., species_count:]
            self._smoothing = tags, states, smoothed, recorded
        tags, states, smoothed, recorded = self._smoothing
        torch.index_select(tags, 0, ordered.original_index, out=states)
        recorded.replay()
        return smoothed
