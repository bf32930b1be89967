"""Next episodes for some worlds of a batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.world.actions import SurveyedWorlds
from npa_envs.world.cuda_graph import Replayed, WeakFunction, sent

GROWTH = 4
"""Each recorded size is so many times the one before it."""


class Restarts:
    """Starts of next episodes, on CUDA as one graph and one launch instead of some hundred.

    A recorded start serves a fixed number of worlds. Fewer are filled up by repeating the last one:
    it is then started twice in the same way, which is the same as once.

    Args:
        start: Starts the next episodes of worlds (indices, int64, shape [M]) and returns them made
            ready for perception in the rows of the whole batch. A method's object has to be kept
            by others.
        world_count: Worlds B.
        device: Where they live.
        recorded: Whether `start` may be recorded: it never waits for the device.
    """

    def __init__(
        self,
        start: Callable[[Tensor], SurveyedWorlds],
        world_count: int,
        device: torch.device,
        *,
        recorded: bool,
    ) -> None:
        self._start = WeakFunction(start)
        self._world_count = world_count
        self._device = device
        self._recorded = recorded and device.type == "cuda"
        self._chunks: dict[int, _Chunk] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out recorded starts, which cannot be pickled."""
        return self.__dict__ | {"_chunks": {}}

    def __call__(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of some worlds.

        Args:
            worlds: Which, shape [M].
            observation: Where to write what is perceived in them, shape [B, N, P].
        """
        if not self._recorded:
            self._start()(sent(worlds, self._device)).perceive(observation)
            return
        size = 1
        while size < len(worlds):
            size = min(size * GROWTH, self._world_count)
        if size not in self._chunks:
            self._chunks[size] = _Chunk(self._start, size, self._device)
        filled = np.full(size, worlds[-1])
        filled[: len(worlds)] = worlds
        self._chunks[size].restart(sent(filled, self._device), observation)


class _Chunk:
    """The recorded start of a fixed number of worlds."""

    def __init__(self, start: WeakFunction, size: int, device: torch.device) -> None:
        self._start = start
        self._index = torch.zeros(size, dtype=torch.int64, device=device)
        self._replayed = Replayed(self._run, device)

    def restart(self, worlds: Tensor, observation: Tensor) -> None:
        """Start the next episodes of as many worlds as the chunk is for."""
        self._index.copy_(worlds)
        self._replayed()
        self._surveyed.perceive(observation)

    def _run(self) -> None:
        self._surveyed: SurveyedWorlds = self._start()(self._index)
