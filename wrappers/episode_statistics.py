"""A wrapper that records returns, lengths and times of episodes, with tensors on a device."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import check_count
from npa_envs.wrappers.base import AnyVectorEnv, RewardSums, world_indices


class TorchRecordEpisodeStatistics(RewardSums):
    """Record returns, lengths and times of episodes in the infos and in queues.

    A step in which episodes end has `infos["episode"]` with the tensors `r` (returns), `l` (lengths
    in steps) and `t` (time [s]), shape [B], 0 for the other worlds, and `infos["_episode"]`, True
    where an episode ended.

    Args:
        env: A vector environment with torch tensors.
        buffer_length: Number of last episodes in the queues.
        stats_key: Replaces "episode" as the key in `infos`.
    """

    def __init__(
        self, env: AnyVectorEnv, buffer_length: int = 100, stats_key: str = "episode"
    ) -> None:
        super().__init__(env)
        check_count("buffer_length", buffer_length, at_most=2**31 - 1)
        self._key = stats_key
        self.episode_count = 0
        """Episodes that have ended."""
        self.length_queue: deque[int] = deque(maxlen=buffer_length)
        """Lengths of the last episodes [steps]."""
        self.time_queue: deque[float] = deque(maxlen=buffer_length)
        """Times that the last episodes took [s]."""
        # On the device; each entry has at least one episode.
        self._returns: deque[Tensor] = deque(maxlen=buffer_length)
        self._began = np.full(env.num_envs, time.perf_counter())

    @property
    def episode_returns(self) -> Tensor | None:
        """Sum of the rewards of each running episode, float64, shape [B]."""
        return self.sums

    @property
    def return_queue(self) -> deque[float]:
        """Returns of the last episodes; reading them waits for the device."""
        returns = torch.cat(tuple(self._returns)).tolist() if self._returns else []
        return deque(returns, maxlen=self._returns.maxlen)

    def use_sums(self, rewards: Tensor, sums: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Return rewards [B] unchanged, and infos of ended episodes; `sums` has their returns."""
        ended, device = self.clock.ended, sums.device
        if not ended.any():
            return rewards, {}
        lengths = np.where(ended, self.clock.lengths, 0)
        seconds = np.where(ended, np.round(time.perf_counter() - self._began, 6), 0.0)
        mask = torch.from_numpy(ended).to(device)
        self.episode_count += int(ended.sum())
        self.length_queue.extend(lengths[ended].tolist())
        self.time_queue.extend(seconds[ended].tolist())
        self._returns.append(sums[world_indices(ended, device)])
        episode = {
            "r": torch.where(mask, sums, 0.0),
            "l": torch.from_numpy(lengths).to(device),
            "t": torch.from_numpy(seconds).to(device),
        }
        return rewards, {self._key: episode, f"_{self._key}": mask}

    def reset_sums(self, worlds: NDArray[np.bool_]) -> None:
        """Reset reward sums and starting times of the worlds at which a mask [B] is True."""
        super().reset_sums(worlds)
        self._began[worlds] = time.perf_counter()
