"""CUDA graphs: work that is recorded once and replayed from then on."""

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

from npa_envs.ops.driver import new_stream


def to_device_async(values: NDArray[Any], device: torch.device) -> Tensor:
    """Return an array as a tensor on a device; the host does not wait for what the device does.

    On a CPU the tensor shares the array's memory.
    """
    tensor = torch.from_numpy(values)
    # Unpinned memory would be copied once the stream is idle, and the host would wait for that.
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

ABANDONED_POOLS = 8
"""Pools of graphs that are gone, at most, before their memory is given back."""

recording_lock = threading.RLock()
"""Held while something is captured or prepared for that: all graphs share one stream and torch's
state of captures."""


@functools.cache
def can_capture() -> bool:
    """Return whether torch's allocator keeps memory for graphs: its own one does, if it caches."""
    caching = "PYTORCH_NO_CUDA_MEMORY_CACHING" not in os.environ
    return caching and torch.cuda.get_allocator_backend() == "native"


CAPTURE_ATTEMPTS = 3
"""How often a capture is tried where other threads may have ended it."""

PINNED_OFFSET = 64
"""Bytes by which pinned memory lies further than torch's allocator knows it."""


def pinned_like(tensor: Tensor) -> Tensor:
    """Return pinned memory of a tensor's form, to which captured work may write.

    Torch's allocator notes which streams use its pinned memory, and asks them how far they are once
    that is freed. A stream that another thread captures by then must not be asked.
    """
    whole = torch.empty(
        PINNED_OFFSET + tensor.nbytes, dtype=torch.uint8, device="cpu", pin_memory=True
    )
    place = torch.from_numpy(whole.numpy()[PINNED_OFFSET:])
    return place.view(tensor.dtype).view(tensor.shape)


def _is_plain() -> bool:
    """Return whether tensors are made on the CPU by default, and not in inference mode."""
    return not (torch.is_inference_mode_enabled() or torch._C._len_torch_function_stack())


@contextlib.contextmanager
def plain_tensors() -> Iterator[None]:
    """Make tensors inside that can be written to anywhere, on the CPU unless a device is given.

    The caller may be in inference mode, or have set another default device.
    """
    with contextlib.ExitStack() as modes:
        if torch.is_inference_mode_enabled():
            modes.enter_context(torch.inference_mode(False))
            modes.enter_context(torch.no_grad())
        if not _is_plain():
            modes.enter_context(torch.device("cpu"))
        yield


def makes_plain_tensors(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function within `plain_tensors`."""

    @functools.wraps(function)
    def guarded(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if _is_plain():
            return function(*args, **kwargs)
        with plain_tensors():
            return function(*args, **kwargs)

    return guarded


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect no garbage inside: freeing an old graph would break a capture."""
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
    """Return torch's current stream of a CUDA device, which has a number: the same object again.

    `torch.cuda.current_stream` makes a new one each time, which takes ten times as long.
    """
    return _stream(device, torch._C._cuda_getCurrentRawStream(device.index))


@functools.cache
def _capture_stream(device_index: int) -> torch.cuda.Stream:
    """The one stream of a device that is captured: graphs can share memory only within a stream."""
    return new_stream(torch.device("cuda", device_index))


def prepare_capture(function: Callable[[], object], device: torch.device) -> None:
    """Run a function on the stream that is captured: loads kernels, allocates workspaces."""
    with recording_lock, torch.cuda.device(device), plain_tensors():
        stream = _capture_stream(torch.cuda.current_device())
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            function()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()


class GraphSequence:
    """Work that was recorded: CUDA graphs, one after the other, and what is done between them.

    `generator` draws anew in each replay; `alone`: nothing is drawn from torch's own generator.
    """

    abandoned = 0
    """Pools of graphs that are gone since memory was given back."""

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
        """Do the work on the current stream; the host waits only for what it does in between."""
        self._graphs[0].replay()
        for work, graph in zip(self._between, self._graphs[1:], strict=True):
            work()
            graph.replay()

    def begin(self) -> None:
        """Record what the current stream is given from now on."""
        graph = torch.cuda.CUDAGraph()
        if self._generator is not None:
            # Without this every replay would draw the numbers of the capture again.
            graph.register_generator_state(self._generator)
        self._graphs.append(graph)
        with _stand_in(graph) if self.alone else contextlib.nullcontext():
            # A backward pass runs on a thread of its own, whose calls the strict mode would refuse.
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")

    def end(self) -> None:
        """Record no more."""
        self._graphs[-1].capture_end()

    def pause(self, work: Callable[[], object]) -> None:
        """End a graph, begin another one, and let `work` be done between them in every replay."""
        self.end()
        self._between.append(work)
        if self._pool is None:
            self._pool = self._graphs[0].pool()
        self.begin()

    def __del__(self) -> None:
        # Freed here, memory would be taken from captures of other threads.
        GraphSequence.abandoned += self._owns_pool and bool(self._graphs)


@contextlib.contextmanager
def _stand_in(graph: torch.cuda.CUDAGraph) -> Iterator[None]:
    """Let a capture that begins inside register another generator than torch's own.

    Torch registers its own one with every graph, and until the capture ends other threads could not
    draw from it.
    """
    own = torch.cuda.default_generators[torch.cuda.current_device()]
    stand_in = torch.Generator(own.device)
    # What other threads draw meanwhile must not be the same each time.
    stand_in.seed()
    graph.register_generator_state(stand_in)
    state = own.graphsafe_get_state()
    own.graphsafe_set_state(stand_in)
    try:
        yield
    finally:
        own.graphsafe_set_state(state)


_capturing: ContextVar[GraphSequence | None] = ContextVar("capturing", default=None)
"""What this thread records, if anything."""


def host_call(work: Callable[[], object]) -> None:
    """Do what cannot be part of a graph: at once, or in a capture between two graphs, each replay.

    The work reads and writes tensors that stay where they are; what launches it keeps them.
    """
    captured = _capturing.get()
    if captured is None:
        work()
    else:
        captured.pause(work)


def draws_alone() -> bool:
    """Return whether what this thread records cannot draw from torch's own generator."""
    captured = _capturing.get()
    return captured is not None and captured.alone


def capture(
    function: Callable[[], object],
    device: torch.device,
    *,
    pool: Any = None,
    generator: torch.Generator | None = None,
    warm_up: Callable[[], object] | None = None,
    alone: bool = False,
) -> GraphSequence:
    """Record what a function launches as CUDA graphs, without running it.

    It is one graph, unless the function calls `host_call`. The function launches kernels that are
    loaded already (by `warm_up`, on the stream that is captured), and never waits for the device.
    A `pool` is shared with graphs that never run at the same time. Each replay draws anew from a
    CUDA `generator`; if `alone`, a draw from torch's own one is an error, and other threads may
    draw from that meanwhile. After an error of the function the device can be used as before.

    Without a warm-up the host waits for nothing. `torch.cuda.graph` waits for the device, frees the
    allocator's cache and may collect garbage at each capture, which can take longer than the
    capture itself. That makes room, as a graph's pool has no use for memory in that cache. Here
    room is made after the warm-up, which leaves most of it, and where a capture has not enough.
    """
    with recording_lock, torch.cuda.device(device), plain_tensors():
        stream = _capture_stream(torch.cuda.current_device())
        if GraphSequence.abandoned >= ABANDONED_POOLS:
            # Torch keeps the memory of pools whose graphs are gone, and uses it for nothing else.
            GraphSequence.abandoned = 0
            torch.cuda.empty_cache()
        if warm_up is not None:
            prepare_capture(warm_up, device)
        with contextlib.suppress(torch.OutOfMemoryError):
            return _captured(function, stream, GraphSequence(pool, generator, alone=alone))
        # Only here: the error that is gone by now held the memory of the first attempt.
        torch.cuda.empty_cache()
        return _captured(function, stream, GraphSequence(pool, generator, alone=alone))


def _captured(
    function: Callable[[], object], stream: torch.cuda.Stream, captured: GraphSequence
) -> GraphSequence:
    """Capture a stream while the function runs."""
    current = torch.cuda.current_stream()
    # A capture runs nothing, but for this: torch resets the generators' places on the device, which
    # the graphs before read and the next replay writes. So the two streams take turns.
    stream.wait_stream(current)
    try:
        with torch.cuda.stream(stream), no_garbage_collection():
            captured.begin()
            before = _capturing.set(captured)
            try:
                function()
            except BaseException:
                # What broke the capture says more than the complaint that it is broken.
                with contextlib.suppress(RuntimeError):
                    captured.end()
                raise
            finally:
                _capturing.reset(before)
            captured.end()
    except BaseException:
        with contextlib.suppress(RuntimeError):
            current.wait_stream(stream)
        raise
    current.wait_stream(stream)
    return captured


def may_be_disturbed(attempts: int) -> bool:
    """Return whether a capture that failed is worth another attempt.

    A thread that waits for the whole device (`torch.cuda.synchronize`) ends all captures.
    """
    return threading.active_count() > 1 and attempts < CAPTURE_ATTEMPTS


class WeakFunction:
    """A function that is kept, or a method whose object is not kept alive.

    An object that keeps its own method is freed only when garbage is collected, and with it graphs
    and their memory. What this returns is of no use once its object is gone.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._get = weakref.WeakMethod(function) if inspect.ismethod(function) else lambda: function

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the method of the copied object."""
        return WeakFunction, (self(),)

    def __call__(self) -> Callable[..., Any]:
        """Return the function, whose object must be there."""
        function = self._get()
        if function is None:
            raise ReferenceError("the object of this method is gone: keep it as long as the method")
        return function


class GraphedCallable:
    """A function without arguments that is run as it is on a CPU, and as a CUDA graph on CUDA.

    Launches of many short kernels would otherwise take longer than the kernels do. The first call
    runs the function kernel by kernel, which loads them; the second captures it. The function reads
    and writes the same tensors in every call, and never waits for the device; a method's object has
    to be kept by others (`WeakFunction`). Numbers of its `generator` are the same either way. A
    `pool` is shared with functions that never run at the same time, and of whose work nothing is
    needed that lies there.
    """

    def __init__(
        self,
        function: Callable[[], None],
        device: torch.device,
        generator: torch.Generator | None = None,
        *,
        recorded: bool = True,
        pool: Any = None,
    ) -> None:
        self._function = WeakFunction(function)
        self._device = device
        self._generator = generator
        self._recorded = recorded and device.type == "cuda" and can_capture()
        self._pool = pool
        self._warm = False
        self._graph: GraphSequence | None = None
        self._attempts = 0

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the graph, which cannot be pickled: it is captured anew."""
        return self.__dict__ | {"_warm": False, "_graph": None, "_attempts": 0}

    def __call__(self) -> None:
        """Run the function."""
        function = self._function()
        if not self._recorded or not self._warm:
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
    """A CUDA stream that overlaps the current one."""

    _free: ClassVar[dict[torch.device, collections.deque[torch.cuda.Stream]]] = {}
    """Streams whose objects are gone, by device."""

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
        """Return the one of a thread, for captures."""
        return SideStream(device)

    def __del__(self) -> None:
        if "_stream" in self.__dict__:
            self._free.setdefault(self._device, collections.deque()).append(self._stream)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the device alone: streams and events are a process's own."""
        return SideStream, (self._device,)

    @contextlib.contextmanager
    def overlap(self) -> Iterator[None]:
        """What is launched inside begins once the current stream has done its work so far."""
        self._begin.record(current_stream(self._device))
        self._stream.wait_event(self._begin)
        with torch.cuda.stream(self._stream):
            yield
        self._end.record(self._stream)

    def join(self) -> None:
        """Let what the current stream is given from now on wait until the work is done."""
        current_stream(self._device).wait_event(self._end)

    def mark(self) -> None:
        """Remember what the current stream has been given so far."""
        self._mark.record(current_stream(self._device))

    def wait(self) -> None:
        """Wait on the host until what was remembered is done."""
        self._mark.synchronize()
