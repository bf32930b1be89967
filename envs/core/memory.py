"""Memory that worlds need, compared with what is free before anything is allocated."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from npa_envs.errors import NPAError
from npa_envs.world.actions import Physics

OBSERVATION_COPIES = 4
"""Observations alive at once: the rows, the arrays handed out, the last ones, one to spare."""

LARGEST_INDEX = 2**31 - 1
"""Kernels index the particles' states with 32 bits."""

LISTED_BYTES = 320
"""What CUDA keeps of a particle's neighbours, at most: a list of 128, and what is sorted."""

RECORDED_STARTS = 4 / 3
"""Particles of all recorded restarts together, which have lists of their own, to those of a batch:
1 + 1/4 + 1/16 + ..."""


def needed_bytes(
    world_count: int, particle_count: int, physics: Physics, device: torch.device
) -> int:
    """Return about how much memory worlds take while they are stepped [bytes]."""
    particles = world_count * particle_count
    worlds = 6 * (physics.space_dim + physics.state_dim)
    numbers = OBSERVATION_COPIES * physics.perception_dim + 2 * physics.action_dim + worlds + 16
    listed = LISTED_BYTES * (1.0 + RECORDED_STARTS) if device.type == "cuda" else 0.0
    return int(particles * (4 * numbers + listed))


def free_bytes(device: torch.device) -> int | None:
    """Return the memory that is free on a device [bytes], or None where nobody says."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return int(free) + cached
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
    world_count: int,
    particle_count: int,
    physics: Physics,
    device: torch.device,
    extra_bytes: int = 0,
) -> None:
    """Check that B worlds fit into a device's memory and into the kernels' indices."""
    what = f"{world_count} world(s) of {particle_count} particles"
    cure = "choose a smaller particle_count or fewer worlds"
    if world_count * particle_count * (1 + physics.state_dim) > LARGEST_INDEX:
        raise NPAError(f"particle_count is too large: {what} exceed 32-bit indices: {cure}")
    needed = needed_bytes(world_count, particle_count, physics, device) + extra_bytes
    free = free_bytes(device)
    if free is not None and needed > free:
        raise NPAError(
            f"particle_count must fit into memory: {what} need about {needed / 2**30:.1f} GiB "
            f"with pictures and pool, and {device} has {free / 2**30:.1f} GiB free: {cure}"
        )
