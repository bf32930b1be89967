"""CUDA graphs: capture a function's work on the device once, and replay it."""

from __future__ import annotations

import collections
import contextlib
import functools
import gc
import inspect
import os
import threading
import weakref
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, ClassVar, ParamSpec, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.ops.cuda_driver import new_stream


def to_device_async(values: NDArray[Any], device: torch.device) -> Tensor:
    """Return a NumPy array as a tensor on a device, copied without synchronising.

    On a CPU the tensor shares the array's memory.
    """
    tensor = torch.from_numpy(values)
    # A copy from memory that is not pinned would wait until the stream is idle.
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

ABANDONED_POOLS = 8
"""Number of memory pools of deleted graphs after which their memory is freed."""

capture_lock = threading.RLock()
"""Lock of captures and their preparation: all graphs share one stream and torch's capture state."""


@functools.cache
def can_capture() -> bool:
    """Return whether torch's allocator supports graphs: its own caching allocator does."""
    caching = "PYTORCH_NO_CUDA_MEMORY_CACHING" not in os.environ
    return caching and torch.cuda.get_allocator_backend() == "native"


CAPTURE_ATTEMPTS = 3
"""Maximum number of attempts at a capture that other threads may have invalidated."""

PINNED_OFFSET = 64
"""Offset of `pinned_like` [bytes], which makes torch's allocator not recognise the memory."""


def pinned_like(tensor: Tensor) -> Tensor:
    """Return a new pinned tensor of a tensor's shape and dtype, to which captured work may write.

    Torch's allocator records the streams that use its pinned memory, and queries them when the
    memory is freed. A query of a stream that another thread is capturing would break the capture.
    """
    size = PINNED_OFFSET + tensor.nbytes
    whole = torch.empty(size, dtype=torch.uint8, device="cpu", pin_memory=True)
    return torch.from_numpy(whole.numpy()[PINNED_OFFSET:]).view(tensor.dtype).view(tensor.shape)


def _is_plain() -> bool:
    """Return whether new tensors are on the CPU by default, and not in inference mode."""
    return not (torch.is_inference_mode_enabled() or torch._C._len_torch_function_stack())


@contextlib.contextmanager
def plain_tensors() -> Iterator[None]:
    """Leave inference mode and the caller's default device within the block.

    New tensors can then be written to anywhere, and are on the CPU unless a device is given.
    """
    with contextlib.ExitStack() as modes:
        if torch.is_inference_mode_enabled():
            modes.enter_context(torch.inference_mode(False))
            modes.enter_context(torch.no_grad())
        if not _is_plain():
            modes.enter_context(torch.device("cpu"))
        yield


def makes_plain_tensors(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Wrap a function so that it runs within `plain_tensors`."""

    @functools.wraps(function)
    def guarded(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if _is_plain():
            return function(*args, **kwargs)
        with plain_tensors():
            return function(*args, **kwargs)

    return guarded


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Disable garbage collection within the block: freeing an old graph would break a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@functools.lru_cache(maxsize=64)
def _stream(device: torch.device, handle: int) -> torch.cuda.Stream:
    return torch.cuda.current_stream(device)


def current_stream(device: torch.device) -> torch.cuda.Stream:
    """Return torch's current stream of a CUDA device with a number, as a cached object.

    `torch.cuda.current_stream` makes a new object each time, which takes ten times as long.
    """
    return _stream(device, torch._C._cuda_getCurrentRawStream(device.index))


@functools.cache
def _capture_stream(device_index: int) -> torch.cuda.Stream:
    """Return a device's one stream for captures: only graphs of one stream can share memory."""
    return new_stream(torch.device("cuda", device_index))


def prepare_capture(function: Callable[[], object], device: torch.device) -> None:
    """Run a function on the capture stream, which loads its kernels and allocates workspaces."""
    with capture_lock, torch.cuda.device(device), plain_tensors():
        stream = _capture_stream(torch.cuda.current_device())
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            function()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()


class GraphSequence:
    """A captured function: CUDA graphs, one after the other, and Python functions between them.

    Each replay draws new random numbers from `generator`. With `alone` the function does not use
    torch's default generator, so that other threads may use it during the capture.
    """

    abandoned = 0
    """Memory pools of graphs deleted since memory was last freed."""

    def __init__(
        self, pool: Any = None, generator: torch.Generator | None = None, *, alone: bool = False
    ) -> None:
        self._owns_pool = pool is None
        self._pool = pool
        self._generator = generator
        self.alone = alone
        self._graphs: list[torch.cuda.CUDAGraph] = []
        self._between: list[Callable[[], object]] = []

    def replay(self) -> None:
        """Replay on the current stream; waits only if a function between the graphs does."""
        self._graphs[0].replay()
        for work, graph in zip(self._between, self._graphs[1:], strict=True):
            work()
            graph.replay()

    def begin(self) -> None:
        """Begin to capture the current stream's work."""
        graph = torch.cuda.CUDAGraph()
        if self._generator is not None:
            # Without this every replay would draw the same numbers as the capture.
            graph.register_generator_state(self._generator)
        self._graphs.append(graph)
        with _stand_in(graph) if self.alone else contextlib.nullcontext():
            # A backward pass runs in another thread, whose calls the strict mode would refuse.
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")

    def end(self) -> None:
        """End the capture."""
        self._graphs[-1].capture_end()

    def pause(self, work: Callable[[], object]) -> None:
        """End a graph and begin another one; every replay calls `work` between them."""
        self.end()
        self._between.append(work)
        if self._pool is None:
            self._pool = self._graphs[0].pool()
        self.begin()

    def __del__(self) -> None:
        # Freeing memory at this point could break captures of other threads.
        GraphSequence.abandoned += self._owns_pool and bool(self._graphs)


@contextlib.contextmanager
def _stand_in(graph: torch.cuda.CUDAGraph) -> Iterator[None]:
    """Replace torch's default generator within the block, in which a capture begins.

    Torch registers its default generator with every graph, and then other threads cannot draw from
    it until the capture ends.
    """
    default = torch.cuda.default_generators[torch.cuda.current_device()]
    stand_in = torch.Generator(default.device)
    # Draws of other threads in the meantime must not be the same each time.
    stand_in.seed()
    graph.register_generator_state(stand_in)
    state = default.graphsafe_get_state()
    default.graphsafe_set_state(stand_in)
    try:
        yield
    finally:
        default.graphsafe_set_state(state)


_capturing: ContextVar[GraphSequence | None] = ContextVar("capturing", default=None)
"""The capture of this thread, if any."""


def host_call(work: Callable[[], object]) -> None:
    """Call a Python function; during a capture only note it, and each replay then calls it.

    `work` must use the same tensors in every replay; the caller keeps them alive.
    """
    sequence = _capturing.get()
    if sequence is None:
        work()
    else:
        sequence.pause(work)


def draws_alone() -> bool:
    """Return whether this thread is capturing a `GraphSequence` made with `alone`."""
    sequence = _capturing.get()
    return sequence is not None and sequence.alone


def capture(
    function: Callable[[], object],
    device: torch.device,
    *,
    pool: Any = None,
    generator: torch.Generator | None = None,
    warm_up: Callable[[], object] | None = None,
    alone: bool = False,
) -> GraphSequence:
    """Capture a function's launches as CUDA graphs, without running them.

    It is one graph, unless the function calls `host_call`. The function must not synchronise, and
    its kernels must be loaded (by `warm_up`, which runs on the capture stream). A `pool` of memory
    is shared with graphs that never run at the same time. Each replay draws new random numbers from
    a CUDA `generator`. With `alone`, torch's default generator must not be used by the function,
    and may be by other threads. After an error of the function the device is usable.

    Without `warm_up` nothing synchronises, unlike in `torch.cuda.graph`. A graph's pool cannot use
    cached memory, so the cache is freed after the warm-up, and if a capture runs out of memory.
    """
    with capture_lock, torch.cuda.device(device), plain_tensors():
        stream = _capture_stream(torch.cuda.current_device())
        if GraphSequence.abandoned >= ABANDONED_POOLS:
            # Torch does not reuse the memory of pools whose graphs are deleted.
            GraphSequence.abandoned = 0
            torch.cuda.empty_cache()
        if warm_up is not None:
            prepare_capture(warm_up, device)
        with contextlib.suppress(torch.OutOfMemoryError):
            return _capture(function, stream, GraphSequence(pool, generator, alone=alone))
        # Only here is the first error gone, which kept the memory of that attempt alive.
        torch.cuda.empty_cache()
        return _capture(function, stream, GraphSequence(pool, generator, alone=alone))


def _capture(
    function: Callable[[], object], stream: torch.cuda.Stream, sequence: GraphSequence
) -> GraphSequence:
    """Capture the launches of a function on a stream in `sequence`, and return it."""
    current = torch.cuda.current_stream()
    # A capture does run one thing: torch resets generator offsets on the device, which earlier
    # graphs read and the next replay writes. So the two streams wait for each other.
    stream.wait_stream(current)
    try:
        with torch.cuda.stream(stream), no_garbage_collection(), _own_workspaces():
            sequence.begin()
            before = _capturing.set(sequence)
            try:
                function()
            except BaseException:
                # The error that broke the capture says more than the error that it is broken.
                with contextlib.suppress(RuntimeError):
                    sequence.end()
                raise
            finally:
                _capturing.reset(before)
            sequence.end()
    except BaseException:
        with contextlib.suppress(RuntimeError):
            current.wait_stream(stream)
        raise
    current.wait_stream(stream)
    return sequence


@contextlib.contextmanager
def _own_workspaces() -> Iterator[None]:
    """Have a capture in the block allocate memory of its own for cuBLAS's intermediate results.

    Torch allocates it once for each stream and thread. Graphs captured on one stream would share
    it, and write over each other's products when they are replayed on several streams at once.
    """
    # Torch without CUDA does not have the function.
    clear = getattr(torch._C, "_cuda_clearCublasWorkspaces", lambda: None)
    clear()
    try:
        yield
    finally:
        clear()


def may_be_disturbed(attempts: int) -> bool:
    """Return whether to repeat a capture that failed `attempts` times, as threads may break it.

    A thread that waits for the whole device (`torch.cuda.synchronize`) breaks all captures.
    """
    return threading.active_count() > 1 and attempts < CAPTURE_ATTEMPTS


class WeakFunction:
    """A reference to a function, or to a method that does not keep its object alive.

    An object that refers to its own method is freed only by garbage collection, and with it graphs
    and their memory. The method cannot be called once its object is gone.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._get = weakref.WeakMethod(function) if inspect.ismethod(function) else lambda: function

    def __reduce__(self) -> tuple[Any, ...]:
        """Support copy and pickle: a copy refers to the method of the copied object."""
        return WeakFunction, (self(),)

    def __call__(self) -> Callable[..., Any]:
        """Return the function; raise an error if its object is gone."""
        function = self._get()
        if function is None:
            raise ReferenceError("the object of this method is gone: keep it as long as the method")
        return function


class GraphedCallable:
    """A function without arguments that runs as a CUDA graph on CUDA, and unchanged on a CPU.

    The first call runs the function kernel by kernel, which loads the kernels; the second captures
    it. The function must read and write the same tensors in every call and not synchronise; the
    caller keeps a method's object alive (`WeakFunction`). A `generator` draws the same numbers in a
    graph as without. A memory `pool` is shared with functions that never run at the same time and
    whose temporary results are not needed any more. Without `captured` no graph is used.
    """

    def __init__(
        self,
        function: Callable[[], None],
        device: torch.device,
        generator: torch.Generator | None = None,
        *,
        captured: bool = True,
        pool: Any = None,
    ) -> None:
        self._function = WeakFunction(function)
        self._device = device
        self._generator = generator
        self._captured = captured and device.type == "cuda" and can_capture()
        self._pool = pool
        self._warm = False
        self._graph: GraphSequence | None = None
        self._attempts = 0

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the graph, which cannot be pickled and is captured again."""
        return self.__dict__ | {"_warm": False, "_graph": None, "_attempts": 0}

    def __call__(self) -> None:
        """Run the function, kernel by kernel or as a graph."""
        function = self._function()
        if not self._captured or not self._warm:
            function()
            self._warm = True
            return
        if self._graph is None:
            self._attempts += 1
            try:
                self._graph = capture(
                    function, self._device, pool=self._pool, generator=self._generator, alone=True
                )
            except RuntimeError:
                if not may_be_disturbed(self._attempts):
                    raise
                function()
                return
        self._graph.replay()


class SideStream:
    """A second CUDA stream, whose work overlaps that of the current one."""

    _free: ClassVar[dict[torch.device, collections.deque[torch.cuda.Stream]]] = {}
    """Streams of deleted objects, for reuse, by device."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        try:
            self._stream = self._free[device].pop()
        except LookupError:
            self._stream = new_stream(device)
        self._begin, self._end, self._mark = (torch.cuda.Event() for _ in range(3))  # type: ignore[no-untyped-call]

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def of_thread(device: torch.device, thread: int) -> SideStream:
        """Return the cached side stream of a thread, for captures."""
        return SideStream(device)

    def __del__(self) -> None:
        if "_stream" in self.__dict__:
            self._free.setdefault(self._device, collections.deque()).append(self._stream)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the device: streams and events belong to a process."""
        return SideStream, (self._device,)

    @contextlib.contextmanager
    def overlap(self) -> Iterator[None]:
        """Launch on this stream within the block, after the current stream's work so far."""
        self._begin.record(current_stream(self._device))
        self._stream.wait_event(self._begin)
        with torch.cuda.stream(self._stream):
            yield
        self._end.record(self._stream)

    def join(self) -> None:
        """Make later work of the current stream wait for this stream's work."""
        current_stream(self._device).wait_event(self._end)

    def mark(self) -> None:
        """Record an event after the current stream's work so far."""
        self._mark.record(current_stream(self._device))

    def wait(self) -> None:
        """Block the host until the event of the last `mark` has completed."""
        self._mark.synchronize()
