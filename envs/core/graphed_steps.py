"""Steps and starts of worlds on their device, on CUDA as graphs and on two streams at once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.world.cuda_graph import (
    GraphedCallable,
    SideStream,
    WeakFunction,
    pinned_like,
    to_device_async,
)
from npa_envs.world.environment_steps import Actions, NeighbourState, Physics
from npa_envs.world.particles import Particles

MAX_GRAPHED_PARTICLES = 8192
"""Maximum number of particles in all worlds with which a step on CUDA is one graph. The kernels of
larger steps take longer than their launches."""

SIZE_RATIO = 4
"""Ratio of the numbers of worlds of captured starts: 1, 4, 16, ..."""


class GraphedSteps:
    """Applies actions to worlds, evaluates them and perceives, without waiting for the device.

    `actions` moves `particles` in place. `evaluate` writes their losses, on CUDA on `side_stream`
    while neighbours are searched; the reference to it is weak. With `to_host` steps that are one
    graph also copy the perception to the host.
    """

    def __init__(
        self,
        particles: Particles,
        physics: Physics,
        actions: Actions,
        evaluate: Callable[[], None],
        side_stream: SideStream | None,
        *,
        to_host: bool,
    ) -> None:
        self._particles, self._physics, self._actions = particles, physics, actions
        self._to_host, self._side_stream = to_host, side_stream
        self._evaluate = WeakFunction(evaluate)
        x, device = particles.x, particles.x.device
        self._is_one_graph = x.is_cuda and x.shape[:2].numel() <= MAX_GRAPHED_PARTICLES
        self._draw = GraphedCallable(actions.draw, device)
        self._evaluate_graph = GraphedCallable(self._evaluate_and_sort, device)
        self._step_graph = GraphedCallable(self._act_and_perceive, device)
        self._neighbours: NeighbourState | None = None
        self._perceived: Tensor | None = None
        """Perception, shape [B, N, P], that the graph of a step writes; None without one."""
        self.host_perceived: Tensor | None = None
        """The copy of `_perceived` in pinned memory, if `to_host`."""
        self.host_is_current = False
        """Whether `host_perceived` is of the last step, and no world restarted since."""

    def __getstate__(self) -> dict[str, Any]:
        # The next step makes these again.
        none = dict.fromkeys(("_neighbours", "_perceived", "host_perceived"))
        return self.__dict__ | none | {"host_is_current": False}

    def act(self, action: Tensor) -> None:
        """Apply actions, [B, N, A], and evaluate; then set the mark that the host waits for."""
        if self._is_one_graph:
            # Copying actions costs less than the launches that the graph replaces.
            self._actions.load(action)
            self._step_graph()
            self.host_is_current = self.host_perceived is not None
        else:
            self._draw()
            self._actions.apply(action)
            self._evaluate_graph()
        # The host reads the endings while the device perceives.
        if self._side_stream is not None:
            self._side_stream.mark()

    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return what particles perceive after `act`, [B, N, P], in `out` if it is given."""
        if not self._is_one_graph:
            assert self._neighbours is not None, "the evaluation builds them"
            return self._neighbours.perceive(out)
        assert self._perceived is not None, "the graph writes it"
        if out is not None:
            return out.copy_(self._perceived)
        # The next step overwrites what the graph writes; the host's copy is returned instead.
        return self._perceived if self.host_is_current else self._perceived.clone()

    def _act_and_perceive(self) -> None:
        self._actions.draw()
        self._actions.apply_loaded()
        x, s, *_ = self._particles
        with self._evaluating_on_side():
            if self._perceived is None:
                self._perceived = x.new_empty(*x.shape[:2], self._physics.perception_dim)
                if self._to_host:
                    self.host_perceived = pinned_like(self._perceived)
            NeighbourState(x, s, self._physics).perceive(self._perceived)
            if self.host_perceived is not None:
                self.host_perceived.copy_(self._perceived, non_blocking=True)

    def _evaluate_and_sort(self) -> None:
        x, s, *_ = self._particles
        with self._evaluating_on_side():
            self._neighbours = NeighbourState(x, s, self._physics)

    @contextlib.contextmanager
    def _evaluating_on_side(self) -> Iterator[None]:
        """Evaluate the worlds, on CUDA while the kernels of the `with` block run."""
        with contextlib.nullcontext() if self._side_stream is None else self._side_stream.overlap():
            self._evaluate()()
        yield
        if self._side_stream is not None:
            self._side_stream.join()


class GraphedStarts:
    """Starts episodes by CUDA graphs, one for each number of worlds, not by hundreds of launches.

    `start` starts worlds, by their indices [B']; the reference to it is weak.
    """

    def __init__(self, start: Callable[[Tensor], NeighbourState], world_count: int) -> None:
        self._start, self._world_count = WeakFunction(start), world_count
        self._graphs: dict[int, GraphedStart] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_graphs": {}}

    def __call__(self, world_indices: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of worlds, [B']; write their perception into `observation`."""
        size = 1
        while size < len(world_indices):
            size = min(size * SIZE_RATIO, self._world_count)
        if size not in self._graphs:
            self._graphs[size] = GraphedStart(self._start(), size, observation.device)
        padded = np.pad(world_indices, (0, size - len(world_indices)), mode="edge")
        self._graphs[size](padded).perceive(observation)


class GraphedStart:
    """Starts `size` episodes by a CUDA graph; a world given twice starts as if given once."""

    def __init__(
        self, start: Callable[[Tensor], NeighbourState], size: int, device: torch.device
    ) -> None:
        self._start = WeakFunction(start)
        self._world_indices = torch.zeros(size, dtype=torch.int64, device=device)
        self._replay = GraphedCallable(self._run, device)

    def __call__(self, world_indices: NDArray[np.int64]) -> NeighbourState:
        """Start the next episodes of worlds, [size]; return their `NeighbourState`."""
        self._world_indices.copy_(to_device_async(world_indices, self._world_indices.device))
        self._replay()
        return self._neighbours

    def _run(self) -> None:
        self._neighbours: NeighbourState = self._start()(self._world_indices)
