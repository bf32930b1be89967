"""Work on CUDA that is recorded once and replayed from then on, or done beside other work."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor


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


def sent(values: NDArray[Any], device: torch.device) -> Tensor:
    """Return an array as a tensor on a device; the host does not wait for what the device does.

    Args:
        values: An array that nobody changes until the device has read it.
        device: Where it is to go.
    """
    tensor = torch.from_numpy(values)
    # Unpinned memory would be copied once the stream is idle, and the host would wait for that.
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor


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

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the graph, which cannot be pickled: it is captured anew."""
        return self.__dict__ | {"_warm": False, "_graph": None}

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
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._mark = torch.cuda.Event()  # type: ignore[no-untyped-call]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the device alone: streams and events are a process's own."""
        return Beside, (self._device,)

    @contextlib.contextmanager
    def aside(self) -> Iterator[None]:
        """What is launched inside begins once the current stream has done its work so far."""
        self._stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(self._stream):
            yield

    def join(self) -> None:
        """Let what the current stream is given from now on wait until the work is done."""
        torch.cuda.current_stream(self._device).wait_stream(self._stream)

    def mark(self) -> None:
        """Remember what the current stream has been given so far."""
        self._mark.record()

    def wait(self) -> None:
        """Wait on the host until what was remembered is done."""
        self._mark.synchronize()
