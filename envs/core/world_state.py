"""Particles of worlds on a device, and the check that they fit into its memory."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import check_device, number_tensor
from npa_envs.envs.core.config import WorldConfig
from npa_envs.envs.core.task import WorldTask
from npa_envs.errors import DivergedError, NPAError
from npa_envs.world.divergence import first_reports, term_name
from npa_envs.world.environment_steps import Physics
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom

OBSERVATION_COPIES = 4
"""Copies of the observation in memory at once: perceived, returned, final, and one spare."""

MAX_INDEX = 2**31 - 1
"""Maximum index of numbers in all particles' states, of 32 bits in kernels."""

LISTED_BYTES = 320
"""Maximum memory of a particle's neighbours on CUDA: a list of 128, and sorted copies [bytes]."""

CAPTURED_STARTS = 4 / 3
"""Particles of all captured starts, whose neighbours take memory as well, as a multiple of B N:
1 + 1/4 + 1/16 + ..."""


def needed_bytes(
    world_count: int, particle_count: int, physics: Physics, device: torch.device
) -> int:
    """Return an estimate of the memory that steps of B worlds need on a device [bytes]."""
    particles = world_count * particle_count
    worlds = 6 * (physics.space_dim + physics.state_dim)
    floats = OBSERVATION_COPIES * physics.perception_dim + 2 * physics.action_dim + worlds + 16
    listed = LISTED_BYTES * (1.0 + CAPTURED_STARTS) if device.type == "cuda" else 0.0
    return int(particles * (4 * floats + listed))


def free_bytes(device: torch.device) -> int | None:
    """Return the free memory of a device [bytes], or None if it is unknown."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return int(free) + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    try:
        for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def check_memory(
    world_count: int, particle_count: int, physics: Physics, device: torch.device, extra_bytes: int
) -> None:
    """Check that B worlds and `extra_bytes` fit into a device's memory and the kernels' indices."""
    what = f"{world_count} world(s) of {particle_count} particles"
    hint = "choose a smaller particle_count or fewer worlds"
    if world_count * particle_count * (1 + physics.state_dim) > MAX_INDEX:
        raise NPAError(f"particle_count is too large: {what} exceed 32-bit indices: {hint}")
    needed = needed_bytes(world_count, particle_count, physics, device) + extra_bytes
    free = free_bytes(device)
    if free is not None and needed > free:
        raise NPAError(
            f"particle_count must fit into memory: {what} need about {needed / 2**30:.1f} GiB "
            f"with pictures and pool, and {device} has {free / 2**30:.1f} GiB free: {hint}"
        )


def check_default_dtype() -> None:
    """Check that torch's default dtype is float32, which the worlds' tensors have."""
    dtype = torch.get_default_dtype()
    if dtype != torch.float32:
        raise NPAError(
            f"environments need torch's default dtype to be torch.float32, got {dtype}: call "
            "torch.set_default_dtype(torch.float32), and give other tensors their dtype"
        )


class WorldState:
    """Particles of B worlds on a device, and a stream of random numbers for each world."""

    def __init__(
        self,
        config: WorldConfig,
        task_type: type[WorldTask[Any]],
        world_count: int,
        particle_count: int,
        extra_bytes: int,
    ) -> None:
        check_default_dtype()
        self.device = device = check_device(config.device)
        self.world_count, self.particle_count = world_count, particle_count
        self.physics = physics = config.physics(task_type.space_dim, static=task_type.static)
        """Constants of perception and motion."""
        check_memory(world_count, particle_count, physics, device, extra_bytes)
        shape = world_count, particle_count
        self.x = torch.zeros(*shape, physics.space_dim, device=device)
        self.s = torch.zeros(*shape, physics.state_dim, device=device)
        self.particles = Particles(self.x, self.s)
        """The same two tensors, which are only written in place."""
        keys = torch.zeros(world_count, dtype=torch.int64, device=device)
        self.random = WorldRandom.from_keys(keys)
        """One random stream for each world."""

    def next_streams(self, world_indices: Tensor, keys: Tensor | None) -> WorldRandom:
        """Return streams of random numbers for the next episodes of worlds, int64 [B'].

        `keys`, int64 [B'], begin new sequences of episodes; None: the current ones continue.
        """
        if keys is not None:
            return WorldRandom.from_keys(keys.to(self.device))
        random = self.random.take(world_indices)
        random.restart()
        return random

    def checked_particles(self, x: Any, s: Any, world_count: int, particle_count: int) -> Particles:
        """Return `x` and `s`, float32, on the device; their shape and limits are checked."""
        checked, physics = [], self.physics
        for name, value, width, limit, limit_name in (
            ("x", x, physics.space_dim, physics.limits.position, "position_limit"),
            ("s", s, physics.state_dim, physics.limits.state, "observation_limit"),
        ):
            tensor = number_tensor(name, value).to(self.device, torch.float32)
            expected = (world_count, particle_count, width)
            if tuple(tensor.shape) != expected:
                raise NPAError(
                    f"{name} must have shape {expected} (worlds, particles, entries), "
                    f"got {tuple(tensor.shape)}: see env.unwrapped.particles()"
                )
            if not bool((tensor.abs() <= limit).all()):
                raise NPAError(
                    f"{name} must be finite and within {limit_name} = {limit:g}, got numbers up to "
                    f"{float(tensor.abs().max())}: clip it, or make the environment with a larger "
                    "limit"
                )
            checked.append(tensor)
        return Particles(*checked)

    def divergence_error(self, diverged: NDArray[np.int64], elapsed: Tensor) -> DivergedError:
        """Return the error that names diverged worlds, [B']; `elapsed`: all worlds' steps, [B]."""
        physics = self.physics

        def describe(world: int) -> str:
            numbers = torch.cat((self.x[world], self.s[world]), dim=1)
            outside = self.x[world].abs() >= physics.limits.position
            outside = torch.cat((outside, self.s[world].abs() >= physics.limits.state), dim=1)
            line = f"world {world} in step {int(elapsed[world])}"
            if bool(outside.any()):
                particle, entry = outside.nonzero()[0].tolist()
                line += (
                    f": {term_name(entry, physics.space_dim)} of particle {particle} got to "
                    f"{numbers[particle, entry].item():g} "
                    f"({int(outside.any(dim=1).sum())} such particles)"
                )
            return line

        reports = first_reports(diverged.tolist(), describe)
        return DivergedError(
            f"numbers must stay within position_limit = {physics.limits.position:g} and "
            f"observation_limit = {physics.limits.state:g}, but left them in {'; '.join(reports)}: "
            "take smaller actions, raise the limits, or choose on_divergence='terminate' or 'reset'"
        )

    def device_context(self) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which the worlds' device is the current one."""
        if not self.x.is_cuda or torch.cuda.current_device() == self.device.index:
            return contextlib.nullcontext()
        return torch.cuda.device(self.device)


def not_finite(action: Tensor, *, of_particles: bool) -> DivergedError:
    """Return the error for actions, [B, rows, columns], with a number that is not finite."""
    bad, word = ~torch.isfinite(action), "particle" if of_particles else "row"
    world, row, entry = (int(k) for k in bad.nonzero()[0])
    return DivergedError(
        f"action must be finite, got {action[world, row, entry].item()} at world {world}, "
        f"{word} {row}, entry {entry} ({int(bad.sum())} such numbers): check the policy"
    )
