"""Updates of particles: by a rule's outputs, as a torch operator, and by actions, in place."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import check_world
from npa_envs.errors import NPAError
from npa_envs.kernels.portable.update import (
    MOVED_TOGETHER,
    OPEN,
    PERIODIC,
    REFLECTING,
    THREAD_CHANNELS,
    UPDATE_ALIGNMENT,
    VALUES_PER_THREAD,
    action_kernel,
    flag_not_finite,
    update_kernels,
)
from npa_envs.ops.custom_op import check_derivatives, custom_op, once_differentiable
from npa_envs.ops.launch import SCALARS, RecordedLaunches, aligned, is_aligned, launch
from npa_envs.ops.perceive import Rows
from npa_envs.ops.physics import Physics
from npa_envs.ops.sort import MAX_INDEX

BOUNDARY_NUMBERS = {"open": OPEN, "periodic": PERIODIC, "reflecting": REFLECTING}
"""The kernels' constant for each boundary."""


@custom_op("npa::update_particles")
def _update_particles(
    update: Tensor,
    x: Tensor,
    s: Tensor,
    path_length: Tensor,
    row_of: Tensor,
    physics: Physics,
    within: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    space_dim, state_dim = int(x.shape[2]), s.shape[2]
    total, particle_threads = x.shape[0] * x.shape[1], 1 + -(-state_dim // THREAD_CHANNELS)
    on_cpu = x.device.type == "cpu"
    kernels = update_kernels(space_dim, SCALARS[x.dtype], on_cpu)
    if update.numel() >= MAX_INDEX:
        raise NPAError(
            f"updates must stay below {MAX_INDEX} numbers in one batch, got "
            f"{update.numel()}: split the batch"
        )
    outputs = torch.empty_like(x), torch.empty_like(s), torch.empty_like(path_length)
    update = update.contiguous()
    # Adjacent channels are read and written at once where their addresses are aligned.
    alignment = UPDATE_ALIGNMENT[space_dim]
    aligned = state_dim % THREAD_CHANNELS == 0 and is_aligned(s)
    aligned = aligned and (4 * update.shape[1]) % alignment == 0
    aligned = aligned and is_aligned(update, alignment)
    launch(
        kernels.apply_update,
        -(-total // MOVED_TOGETHER) * (1 if on_cpu else MOVED_TOGETHER * particle_threads),
        x.device,
        physics.max_displacement * physics.dt,
        physics.dt,
        BOUNDARY_NUMBERS[physics.boundary] if within else OPEN,
        physics.box or (1.0,) * space_dim,
        int(physics.moving),
        state_dim,
        update.shape[1],
        int(aligned),
        row_of,
        update,
        x,
        s,
        path_length,
        *outputs,
    )
    return outputs


@custom_op("npa::update_particles_backward")
def update_particles_backward(
    update: Tensor,
    new_x_bar: Tensor,
    new_s_bar: Tensor,
    new_path_bar: Tensor,
    row_particle: Tensor,
    starts: Tensor,
    row_base: int,
    physics: Physics,
) -> Tensor:
    """Return the gradient of updates from those of new positions, states and path lengths."""
    space_dim, state_dim = int(new_x_bar.shape[2]), new_s_bar.shape[2]
    kernels = update_kernels(space_dim, SCALARS[update.dtype], update.device.type == "cpu")
    update_bar = torch.empty_like(update, memory_format=torch.contiguous_format)
    launch(
        kernels.pull_back_update,
        update.shape[0] * -(-update.shape[1] // THREAD_CHANNELS),
        update.device,
        physics.max_displacement * physics.dt,
        physics.dt,
        int(physics.moving),
        row_base,
        state_dim,
        update.shape[1],
        int(update.shape[1] % THREAD_CHANNELS == 0),
        starts,
        row_particle,
        update.contiguous(),
        new_x_bar.contiguous(),
        new_s_bar.contiguous(),
        new_path_bar.contiguous(),
        update_bar,
    )
    return update_bar


class _UpdateParticles(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        update: Tensor,
        x: Tensor,
        s: Tensor,
        path_length: Tensor,
        rows: Rows,
        physics: Physics,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.row_base, ctx.physics = rows.row_base, physics
        before = (x, rows.row_of) if physics.boundary == "reflecting" else ()
        ctx.save_for_backward(update, rows.row_particle, rows.starts, *before)
        return _update_particles(update, x, s, path_length, rows.row_of, physics, True)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        update, row_particle, starts, *before = ctx.saved_tensors
        x_bar, s_bar, path_bar = bars
        physics: Physics = ctx.physics
        if before and physics.box is not None:
            # Where walls reflected a position, its gradient is mirrored. Positions do not depend on
            # states and paths: any tensors of their shapes will do.
            x, row_of = before
            others = s_bar.contiguous(), path_bar.contiguous()
            free, *_ = _update_particles(update, x, *others, row_of, physics, False)
            x_bar = x_bar * _mirror_signs(free, physics.box)
        update_bar = update_particles_backward(
            update, x_bar, s_bar, path_bar, row_particle, starts, ctx.row_base, physics
        )
        return update_bar, x_bar, s_bar, path_bar, None, None


def update_particles(
    update: Tensor, x: Tensor, s: Tensor, path_length: Tensor, rows: Rows, physics: Physics
) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions, states and path lengths after a rule's updates of the active particles.

    `update` has a row [displacement δ (D) ; change of states Δs (C)] for each, shape [K, A];
    further columns are not read.
    """
    x, s = x.contiguous(), s.contiguous()
    tensors = (update, x, s, path_length)
    if not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)):
        return _update_particles(*tensors, rows.row_of, physics, True)
    outputs: tuple[Tensor, Tensor, Tensor] = _UpdateParticles.apply(*tensors, rows, physics)  # type: ignore[no-untyped-call]
    return outputs


def _images(x: Tensor, sides: tuple[float, ...]) -> Tensor:
    """Return the number of the box's periodic image that each coordinate is in; 0: the box."""
    images = [torch.floor(x.detach()[..., d] / side + 0.5) for d, side in enumerate(sides)]
    return torch.stack(images, dim=-1)


def _mirror_signs(x: Tensor, sides: tuple[float, ...]) -> Tensor:
    """Return -1 for coordinates in odd images of the box, which walls mirror; 1 for others."""
    return 1.0 - 2.0 * (_images(x, sides) % 2.0)


def wrapped(x: Tensor, box: tuple[float, ...] | None) -> Tensor:
    """Return a copy of positions, wrapped into the periodic box if there is one."""
    if box is None:
        return x.clone()
    images = _images(x, box).unbind(dim=-1)
    return x - torch.stack([side * image for side, image in zip(box, images, strict=True)], dim=-1)


def bounded(x: Tensor, physics: Physics) -> Tensor:
    """Return a copy of positions, wrapped into a periodic box or reflected at walls."""
    inside, box = wrapped(x, physics.box), physics.box
    if box is not None and physics.boundary == "reflecting":
        return inside * _mirror_signs(x, box)
    return inside


class ActedWorlds(NamedTuple):
    """Worlds that actions change in place, and the other tensors of `apply_actions`."""

    x: Tensor
    """Positions [length units], shape [B, N, D]."""
    s: Tensor
    """States, dimensionless, shape [B, N, C]."""
    mask: Tensor | None
    """Which particles act, uint8, shape [B, N]; None: all."""
    noise: Tensor | None
    """Added to every position [length units], shape [B, N, D]."""
    enabled: Tensor | None
    """Whether anything changes, uint8, shape [1]."""
    diverged: Tensor
    """Set to 1 for worlds that diverged, uint8, shape [B]."""

    def check(self, action: Tensor, physics: Physics) -> None:
        """Check shapes, dtypes, devices and strides of the worlds and of actions."""
        x, s = self.x, self.s
        check_world(x, s)
        check_derivatives(action=action, x=x, s=s, noise=self.noise)
        worlds = x.shape[:2]
        for name, tensor, size, dtype in (
            ("x", x, x.shape, x.dtype),
            ("s", s, s.shape, x.dtype),
            ("action", action, (*worlds, physics.action_dim), x.dtype),
            ("mask", self.mask, worlds, torch.uint8),
            ("noise", self.noise, x.shape, x.dtype),
            ("enabled", self.enabled, (1,), torch.uint8),
            ("diverged", self.diverged, worlds[:1], torch.uint8),
        ):
            if tensor is None:
                continue
            shape = tuple(size)
            if tuple(tensor.shape) != shape or tensor.dtype != dtype or tensor.device != x.device:
                raise NPAError(
                    f"{name} must be {dtype} of shape {shape} on {x.device}, got {tensor.dtype} of "
                    f"shape {tuple(tensor.shape)} on {tensor.device}: convert or reshape it"
                )
            if not tensor.is_contiguous():
                raise NPAError(
                    f"{name} must be contiguous, got strides {tensor.stride()}: "
                    f"make it so with {name}.contiguous()"
                )
        if action.numel() >= MAX_INDEX:
            raise NPAError(
                f"actions must stay below {MAX_INDEX} numbers in one batch, got "
                f"{action.numel()}: split the batch"
            )

    def launch_of(self, action: Tensor, physics: Physics, aligned: bool) -> tuple[Any, ...]:
        """Return the arguments of the `launch` that applies actions.

        `aligned`: states and actions begin at multiples of 16 bytes in memory.
        """
        x, s, mask, noise, enabled, diverged = self
        world_count, particle_count, space_dim = x.shape
        state_dim = s.shape[2]
        # Then adjacent channels are read and written at once.
        aligned = aligned and state_dim % THREAD_CHANNELS == 0
        aligned = aligned and (space_dim % 2 == 0 or not physics.moving)
        return (
            action_kernel(space_dim, SCALARS[x.dtype]),
            world_count * particle_count * -(-state_dim // THREAD_CHANNELS),
            x.device,
            particle_count,
            physics.max_displacement * physics.dt,
            physics.limits.state_scale * physics.dt,
            BOUNDARY_NUMBERS[physics.boundary],
            physics.box or (1.0,) * space_dim,
            int(physics.moving),
            physics.limits.position,
            physics.limits.state,
            mask,
            noise,
            enabled,
            state_dim,
            int(aligned),
            action,
            x,
            s,
            diverged,
        )


def apply_actions(
    action: Tensor,
    x: Tensor,
    s: Tensor,
    physics: Physics,
    *,
    mask: Tensor | None,
    noise: Tensor | None,
    enabled: Tensor | None,
    diverged: Tensor,
) -> None:
    """Apply actions to particles in place, without gradient and without waiting for the device.

    With the mask m: x ← wrap(x + noise + m dt max_displacement a_x / max(1, |a_x|)) and
    s ← s + m dt state_scale clip(a_s, -1, 1), each computed in float64 and rounded once. NaN
    becomes 0, and a value beyond its limit is clipped; both mark the world as diverged.

    Actions are [a_x (D) ; a_s (C)], shape [B, N, A], or only a_s where particles do not move.
    Particles in `mask` (uint8, [B, N]) act, by default all. `noise`, shape [B, N, D], is added to
    every position. Nothing changes if `enabled` (uint8, [1]) is 0. `diverged` (uint8, [B]) is set
    to 1 for worlds that diverged and not changed for others.
    """
    worlds = ActedWorlds(x, s, mask, noise, enabled, diverged)
    worlds.check(action, physics)
    launch(*worlds.launch_of(action, physics, is_aligned(s) and is_aligned(action)))


def load_async(values: Tensor, buffer: Tensor) -> None:
    """Copy values of any dtype and device into a buffer of their shape, without waiting."""
    if buffer.is_cuda and not values.is_cuda:
        # A copy from memory that is not pinned would wait for the device.
        values = values.to(buffer.dtype).pin_memory()
    buffer.copy_(values, non_blocking=True)


def flag_unless_finite(values: Tensor, enabled: Tensor) -> None:
    """Set `enabled`, uint8 [1], to 0 if a value is not finite, without waiting for the device."""
    values, threads = aligned(values), -(-values.numel() // VALUES_PER_THREAD)
    check = flag_not_finite(SCALARS[values.dtype])
    launch(check, threads, values.device, threads, values, enabled)


class PreparedActions:
    """Applies actions as `apply_actions`, to worlds in fixed tensors, by recorded launches.

    The values of mask and noise may change before each call. `enabled` is set to 0 if an action is
    not finite, and never set to 1.
    """

    def __init__(self, worlds: ActedWorlds, physics: Physics) -> None:
        self._buffer = worlds.s.new_zeros(*worlds.s.shape[:2], physics.action_dim)
        self._worlds = worlds
        self._physics = physics
        self._recorded: RecordedLaunches | None = None
        self._action_slots: Any = None
        worlds.check(self._buffer, physics)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the recorded launches, which cannot be pickled."""
        return self.__dict__ | {"_recorded": None, "_action_slots": None}

    def __call__(self, action: Tensor) -> None:
        """Apply actions, shape [B, N, A], of any dtype, on any device."""
        buffer = self._buffer
        fits = action.dtype == buffer.dtype and action.device == buffer.device
        fits = fits and action.shape == buffer.shape and action.is_contiguous()
        if fits and is_aligned(action):
            self._run(action)
        else:
            self.load(action)
            self.apply_loaded()

    def load(self, action: Tensor) -> None:
        """Copy actions of any dtype and device into the buffer that `apply_loaded` reads."""
        if action.shape != self._buffer.shape:
            raise NPAError(
                f"action must have shape {tuple(self._buffer.shape)}, got {tuple(action.shape)}"
            )
        load_async(action, self._buffer)

    def apply_loaded(self) -> None:
        """Apply the actions of the last `load`; may be captured in a CUDA graph."""
        self._run(self._buffer)

    def _run(self, action: Tensor) -> None:
        if self._recorded is None:
            self._recorded = RecordedLaunches()
            x, s = self._worlds[:2]
            threads = -(-action.numel() // VALUES_PER_THREAD)
            check = flag_not_finite(SCALARS[x.dtype])
            self._recorded.add(check, threads, x.device, threads, action, self._worlds.enabled)
            self._recorded.add(*self._worlds.launch_of(action, self._physics, is_aligned(s)))
            self._action_slots = self._recorded.argument_slots(action)
        self._recorded.move(self._action_slots, action)
        self._recorded.replay()
