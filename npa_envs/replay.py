"""Work on CUDA that is recorded once and replayed from then on, or done beside other work."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator

import torch


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect garbage now and none inside: freeing an old graph would break a capture."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Replayed:
    """A function without arguments that is run as it is on a CPU, and as a CUDA graph on CUDA.

    Launches of many short kernels would otherwise take longer than the kernels do. The first call
    runs the function kernel by kernel, which loads them; the second captures it.

    Args:
        function: Reads and writes the same tensors in every call, and never waits for the device.
        device: Where these are.
    """

    def __init__(self, function: Callable[[], None], device: torch.device) -> None:
        self._function = function
        self._device = device
        self._warm = False
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Run the function."""
        if self._device.type == "cpu" or not self._warm:
            self._function()
            self._warm = True
            return
        if self._graph is None:
            graph = torch.cuda.CUDAGraph()
            with no_garbage_collection(), torch.cuda.graph(graph):
                self._function()
            self._graph = graph
        self._graph.replay()


class Beside:
    """Work on a stream of its own, beside what the current stream does meanwhile.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        # First in line, so that the host can read its results soon.
        self._stream = torch.cuda.Stream(device, priority=-1)  # type: ignore[no-untyped-call]
        self._done = torch.cuda.Event()  # type: ignore[no-untyped-call]

    def run(self, work: Callable[[], None]) -> None:
        """Start work once the current stream has done what it was given so far.

        Args:
            work: Launches kernels; never waits for the device.
        """
        self._stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(self._stream):
            work()
            self._done.record()

    def join(self) -> None:
        """Let what the current stream is given from now on wait until the work is done."""
        torch.cuda.current_stream(self._device).wait_event(self._done)

    def wait(self) -> None:
        """Wait on the host until the work is done."""
        self._done.synchronize()
