"""Randomness of a training run: of the batch at once, or of each world by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.ranks import Ranks
from npa_envs.world.randomness import Randomness, WorldRandom


@dataclass(frozen=True)
class RunRandomness:
    """What a run draws from.

    A process alone has one generator for all worlds and one for all masks. Where several share a
    run, each world has streams of its own, which follow from the seed, the world's number among
    those of all processes, and the iteration. So they are the same for any number of processes,
    and nothing of them has to be kept.
    """

    schedule: torch.Generator
    """Numbers of steps and first weights, on the CPU; the same on all processes."""
    pool: Randomness
    """The pool's first worlds."""
    worlds: Randomness
    """Which worlds a batch has, their damage, and fresh ones."""
    masks: Randomness
    """Update masks."""

    @classmethod
    def of_batch(
        cls, config: TrainConfig[Any], device: torch.device, schedule: torch.Generator
    ) -> RunRandomness:
        """Return the randomness of a process alone."""
        worlds = torch.Generator(device).manual_seed(config.seed + 1)
        masks = torch.Generator(device).manual_seed(config.seed + 2)
        return cls(schedule, worlds, worlds, masks)

    @classmethod
    def by_world(
        cls,
        config: TrainConfig[Any],
        device: torch.device,
        schedule: torch.Generator,
        ranks: Ranks,
    ) -> RunRandomness:
        """Return the randomness of worlds that several processes share."""
        batch, pool = config.world_count, config.pool_size

        def streams(purpose: int, total: int, places: Tensor) -> WorldRandom:
            return world_streams((config.seed, purpose), total, places, device)

        of_batch = ranks.places(batch)
        return cls(
            schedule,
            pool=streams(0, pool, ranks.places(pool, pool // batch)),
            worlds=streams(1, batch, of_batch),
            masks=streams(2, batch, of_batch),
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return the states of all generators, for a checkpoint."""
        named = {"schedule": self.schedule, "worlds": self.worlds, "masks": self.masks}
        return {
            name: source.get_state()
            for name, source in named.items()
            if isinstance(source, torch.Generator)
        }

    def load_state_dict(self, states: Mapping[str, Tensor], iteration: int) -> None:
        """Go on after so many iterations from what `state_dict` returned."""
        self.schedule.set_state(states["schedule"])
        for name, source in (("worlds", self.worlds), ("masks", self.masks)):
            if isinstance(source, torch.Generator):
                source.set_state(states[name])
            else:
                source.episodes.fill_(iteration)


def world_streams(
    seed: Sequence[int], total: int, places: Tensor, device: torch.device
) -> WorldRandom:
    """Return streams of this process's worlds, which do not depend on who else has which.

    Args:
        places: Which of them are this process's, on the CPU, int64, shape [B].
    """
    keys = np.random.default_rng(seed).integers(2**64, size=total, dtype=np.uint64)
    return WorldRandom.from_keys(torch.from_numpy(keys.view(np.int64))[places].to(device))


def restart(*sources: Randomness) -> None:
    """Begin anew what worlds draw by themselves; a generator just goes on."""
    for source in sources:
        if isinstance(source, WorldRandom):
            source.restart()


def registered(source: Randomness) -> torch.Generator | None:
    """Return what a CUDA graph has to know of: streams of worlds are tensors as all others."""
    return source if isinstance(source, torch.Generator) else None
