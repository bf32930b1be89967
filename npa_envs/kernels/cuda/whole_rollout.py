"""Whole rollouts of small 2D worlds on CUDA: one kernel runs all steps in shared memory.

A few warps own a world. `whole_rollout.cuh` explains the two phases of a step.
"""

from typing import NamedTuple

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native

SHARED_BYTES = 225 * 1024
"""Shared memory of a block [bytes]: on compute capability 9.0 the most, without 2 KiB for Warp."""

SIZES = (64, 128, 256, 512)
"""Numbers of particles that worlds are filled up to."""

MIN_PARTICLES = 32
"""Minimum number of particles: the fewer there are, the larger is a density gradient's rounding."""

MAX_CHANNELS = 16
"""Maximum number of state channels."""


class WorldVariant(NamedTuple):
    """A variant of the kernel."""

    size: int
    """Particles that a world has room for, one of `SIZES`."""
    warps: int
    """Warps of a block that own a world together."""
    cluster: int
    """Blocks that own a world together, 1 or 2."""
    groups: int
    """Worlds of a block at a time."""
    channel_blocks: int
    """Blocks of eight state channels, 1 or 2."""

    @property
    def threads(self) -> int:
        """Threads of a block."""
        return 32 * self.warps * self.groups

    def memory(self, hidden_dim: int) -> int:
        """Return the shared memory of a block [bytes], as `whole_rollout.cuh` divides it."""
        units, blocks, size = -(-hidden_dim // 32) * 2, self.channel_blocks, self.size
        weights = units * (2560 * blocks + 768) + 128
        rows = (size + 8) * (32 * blocks + 16 + 16)
        return weights + self.groups * (rows + size * (32 * blocks + 4) + 144)


def world_size(particle_count: int) -> int:
    """Return the number of particles, one of `SIZES`, that worlds are filled up to."""
    return next(size for size in SIZES if size >= particle_count)


def fits_block(particle_count: int, state_dim: int, hidden_dim: int) -> bool:
    """Return whether enough worlds of these sizes, with their rule, fit into shared memory."""
    if not MIN_PARTICLES <= particle_count <= SIZES[-1] or state_dim > MAX_CHANNELS:
        return False
    size = world_size(particle_count)
    shared = WorldVariant(size, 1, 1, SIZES[-1] // size, channel_blocks(state_dim))
    return shared.memory(hidden_dim) <= SHARED_BYTES


def channel_blocks(state_dim: int) -> int:
    """Return the number of blocks of eight channels."""
    return -(-state_dim // 8)


@cached_under_lock()
def whole_rollout(variant: WorldVariant) -> wp.Kernel:
    """Return the kernel that rolls out worlds; its blocks have `variant.threads` threads."""
    size, warps, cluster, groups, channel_blocks = variant
    name = f"npa_envs.kernels.whole_rollout_{size}_{warps}_{cluster}_{channel_blocks}_{groups}"
    roll_worlds = native.function(
        "roll_worlds",
        *(size, warps, cluster, channel_blocks),
        untyped="memory numbers choices hidden_weight hidden_bias output_weight masks noise x s "
        "new_x new_s",
    )

    @wp.kernel(module=native.module(name), launch_bounds=(variant.threads, 1), cluster_dim=cluster)
    def roll_out_worlds(
        numbers: wp.types.vector(7, wp.float32),
        choices: wp.types.vector(6, wp.int32),
        hidden_weight: wp.array2d[wp.float32],
        hidden_bias: wp.array[wp.float32],
        output_weight: wp.array2d[wp.float32],
        masks: wp.array[wp.uint8],
        noise: wp.array[wp.float32],
        x: wp.array3d[wp.float32],
        s: wp.array3d[wp.float32],
        # outputs
        new_x: wp.array3d[wp.float32],
        new_s: wp.array3d[wp.float32],
    ):
        """Run all steps of a rollout, each world in the shared memory of a few warps."""
        memory = wp.tile_empty(shape=(wp.static(SHARED_BYTES // 4),), dtype=float, storage="shared")
        roll_worlds(
            memory,
            numbers,
            choices,
            hidden_weight,
            hidden_bias,
            output_weight,
            masks,
            noise,
            x,
            s,
            new_x,
            new_s,
        )

    return roll_out_worlds
