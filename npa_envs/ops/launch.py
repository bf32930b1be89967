"""Launches of Warp kernels on tensors, on torch's current stream or its number of CPU threads."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import inspect
import itertools
import math
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.native_functions import MIN_RANGES
from npa_envs.kernels.primitives import CUDA_BLOCK
from npa_envs.ops.cuda_driver import DriverLaunch
from npa_envs.runtime import in_turn, quiet_warp, start_warp
from npa_envs.thread_lock import cached_under_lock, kernel_lock

SCALARS: dict[torch.dtype, Any] = {
    torch.float32: wp.float32,
    torch.float64: wp.float64,
    torch.uint8: wp.uint8,
    torch.int64: wp.int64,
}
"""Warp's scalar type for each dtype."""

GROUP_WIDTHS = (4, 8, 16)
"""Channels that one thread sums together; worlds with more channels than 16 have several groups."""


def channel_width(state_dim: int) -> int:
    """Return how many of a particle's `state_dim` channels one thread sums: a group."""
    return next((width for width in GROUP_WIDTHS if width >= state_dim), GROUP_WIDTHS[-1])


def warp_device(device: torch.device) -> Any:
    """Return Warp's device for a torch device, starting Warp (silently) where needed."""
    start_warp()
    return wp.device_from_torch(device)


@cached_under_lock(64)
def _warp_stream(device: torch.device, handle: int) -> Any:
    return wp.Stream(wp.device_from_torch(device), cuda_stream=handle)


class _ArrayArgument:
    """Warp's array descriptor of one tensor argument, updated in place for each launch."""

    def __init__(self, descriptor: Any, array_type: Any) -> None:
        self._descriptor = descriptor
        self._type = array_type
        self._size: tuple[int, ...] | None = None
        """Shape of the described tensor; () to describe it again, None if it is absent."""
        self._dtype: torch.dtype | None = None

    def set(self, tensor: Tensor | None) -> None:
        """Write a tensor's descriptor; None stands for an absent array."""
        if tensor is None:
            # Kernels read the size of an absent array.
            if self._size is not None:
                _overwrite(self._descriptor, self._type.__ctype__())
                self._size = None
            return
        size, dense = tensor.shape, tensor.is_contiguous()
        if size != self._size or tensor.dtype is not self._dtype or not dense:
            _overwrite(self._descriptor, _description(tensor, self._type))
            self._size, self._dtype = size if dense else (), tensor.dtype
        self._descriptor.data = tensor.data_ptr() or _null(tensor)


def _null(tensor: Tensor) -> int:
    """Return 0, the address of an empty tensor; raise for tensor subclasses without memory."""
    if tensor.numel():
        raise NPAError(
            "tensors must have memory of their own, got a tensor subclass that wraps others "
            f"({type(tensor).__name__}): give the plain tensors within it"
        )
    return 0


def _overwrite(memory: Any, value: Any) -> None:
    ctypes.memmove(ctypes.addressof(memory), ctypes.addressof(value), ctypes.sizeof(value))


def _description(tensor: Tensor, array_type: Any) -> Any:
    """Return Warp's array descriptor of a tensor, flattened where the kernel's array is 1D."""
    tensor = tensor.detach()
    if array_type.ndim == 1:
        entry = getattr(array_type.dtype, "_shape_", ())
        tensor = tensor.view(tensor.numel() // math.prod(entry), *entry)
    descriptor = wp.from_torch(
        tensor, dtype=array_type.dtype, requires_grad=False, return_ctype=True
    )
    # Launches are cached, and must not keep their first tensors alive.
    descriptor._ref = None
    return descriptor


def _type_of(argument: Any) -> Any:
    """Return the Warp type of a kernel's argument; `wp.array2d[...]` becomes a `wp.array`."""
    declared = argument.type
    is_array = hasattr(declared, "ndim")
    return wp.array(dtype=declared.dtype, ndim=declared.ndim) if is_array else declared


class _StructArgument:
    """A struct argument, updated in place for each launch."""

    def __init__(self, memory: Any) -> None:
        self._memory = memory
        self._last: Any = None

    def set(self, value: Any) -> None:
        """Copy a struct's bytes; nothing is done if `value` is the object of the last call."""
        if value is not self._last:
            _overwrite(self._memory, value.__ctype__())
            self._last = value


class _PreparedLaunch:
    """A kernel on a device with memory for its arguments; a launch overwrites those that changed.

    A launch of five arrays and two numbers takes 2.5 µs of CPU time here. `wp.launch`, which packs
    all arguments, takes 17 µs, and Warp's recorded launches with new arguments take 14 µs; a step
    has about ten launches. So Warp makes only the first launch. Later ones repeat it by fields of
    its `Launch`, which Warp does not document: `bounds`, `params`, `params_addr` and `hooks`.
    """

    def __init__(
        self,
        kernel: Any,
        size: tuple[int, ...],
        device: torch.device,
        block_dim: int,
        arguments: tuple[Any, ...],
    ) -> None:
        on_device = warp_device(device)
        types = [_type_of(argument) for argument in kernel.adj.args]
        values = [
            _description(value, declared) if isinstance(value, Tensor) else value
            for value, declared in zip(arguments, types, strict=True)
        ]
        loaded = (kernel.module, device) in loaded_modules
        # One process at a time compiles a module.
        alone = contextlib.nullcontext() if loaded else in_turn(kernel.module.name)
        with kernel_lock, quiet_warp(), alone:
            self._launch = wp.launch(
                kernel,
                size,
                inputs=values,
                device=on_device,
                block_dim=block_dim if on_device.is_cuda else None,
                record_tape=False,
                record_cmd=True,
            )
            loaded_modules.add((kernel.module, device))
        self._device = device
        self._bounds = {size: self._launch.bounds}
        parameters = self._launch.params[1:]
        fields = [(f"a{k}", type(value)) for k, value in enumerate(parameters)]
        self._memory: Any = _struct(tuple(fields))(*parameters)
        self._names = [name for name, _ in fields]
        self._described: list[tuple[int, Callable[[Any], None]]] = []
        self._numbers: list[int] = []
        for k, (name, declared) in enumerate(zip(self._names, types, strict=True)):
            memory = getattr(self._memory, name)
            if isinstance(declared, wp.array):
                self._described.append((k, _ArrayArgument(memory, declared).set))
            elif hasattr(arguments[k], "__ctype__"):
                self._described.append((k, _StructArgument(memory).set))
            else:
                self._numbers.append(k)
        self._last: list[Any] = [None] * len(parameters)
        self._addresses: Any = None
        self._driven: DriverLaunch | None = None
        if on_device.is_cuda:
            begin, layout = ctypes.addressof(self._memory), type(self._memory)
            addresses = [begin + getattr(layout, name).offset for name in self._names]
            self._addresses = (ctypes.c_void_p * (1 + len(parameters)))(0, *addresses)
            self._launch.params_addr = self._addresses
            self._driven = DriverLaunch(self._launch, device, self._addresses)

    def set(self, arguments: tuple[Any, ...]) -> None:
        """Replace the kernel's arguments for the next launch."""
        for k, write in self._described:
            write(arguments[k])
        last = self._last
        for k in self._numbers:
            value = arguments[k]
            if value != last[k]:
                last[k] = value
                declared = self._launch.kernel.adj.args[k].type
                number = declared(*value) if isinstance(value, tuple) else value
                setattr(self._memory, self._names[k], number)

    def set_address(self, index: int, tensor: Tensor) -> None:
        """Point an array argument at another tensor of the same shape and dtype."""
        getattr(self._memory, self._names[index]).data = tensor.data_ptr() or _null(tensor)

    def _bounds_of(self, size: tuple[int, ...]) -> Any:
        bounds = self._bounds.get(size)
        if bounds is None:
            if len(self._bounds) > MAX_BOUNDS:
                self._bounds.clear()
            self._launch.set_dim(size)
            bounds = self._bounds[size] = self._launch.bounds
        return bounds

    def run(self, size: tuple[int, ...]) -> None:
        """Launch the kernel on torch's current stream, or on the CPU's threads."""
        if self._driven is not None:
            bounds = self._bounds_of(size)
            self._addresses[0] = ctypes.addressof(bounds)
            index = self._device.index
            index = torch.cuda.current_device() if index is None else index
            # Ten times faster than `torch.cuda.current_stream`, which makes an object of it.
            stream = torch._C._cuda_getCurrentRawStream(index)
            if not self._driven.run(bounds.size, stream):
                self._launch.bounds = bounds
                self._launch.launch(_warp_stream(self._device, stream))
            return
        # Kernels without a smallest range are not split.
        smallest = MIN_RANGES.get(self._launch.kernel)
        ranges = [] if smallest is None else even_ranges(size[0], smallest)
        if len(ranges) > 1:
            run_together([functools.partial(self._run_range, size, part) for part in ranges])
        else:
            self._run_on_cpu(self._memory, size)

    def _run_range(self, size: tuple[int, ...], indices: range) -> None:
        """Run the threads of a CPU launch whose first index is in `indices`."""
        memory = type(self._memory).from_buffer_copy(self._memory)
        setattr(memory, self._names[0], indices.start)
        self._run_on_cpu(memory, (len(indices), *size[1:]))

    def _run_on_cpu(self, memory: Any, size: tuple[int, ...]) -> None:
        self._launch.hooks.forward(ctypes.byref(self._bounds_of(size)), ctypes.byref(memory))


loaded_modules: set[tuple[Any, torch.device]] = set()
"""Modules of kernels that have been loaded, each with its device."""

MAX_BOUNDS = 4096
"""Launch bounds that are cached for a kernel, at most."""


@functools.lru_cache(maxsize=1024)
def _struct(fields: tuple[tuple[str, type], ...]) -> Any:
    return type("Arguments", (ctypes.Structure,), {"_fields_": list(fields)})


class Launch(NamedTuple):
    """Description of one launch of a Warp kernel."""

    kernel: str
    """The kernel's name."""
    module: str
    """The Warp module of its variant, without the package's name."""
    threads: str
    """Threads along each dimension."""
    purpose: str
    """First line of its docstring."""


@contextlib.contextmanager
def noted_launches() -> Iterator[list[Launch]]:
    """Yield a list that receives each launch made within the block, by any thread."""
    noted: list[Launch] = []
    _observers.append(noted)
    try:
        yield noted
    finally:
        _observers.remove(noted)


_observers: list[list[Launch]] = []
"""Lists to which launches are added."""


def _described(kernel: Any, size: tuple[int, ...]) -> Launch:
    purpose = (inspect.getdoc(kernel.func) or "").split("\n")[0]
    module = kernel.module.name.removeprefix("npa_envs.").removeprefix("kernels.")
    return Launch(kernel.func.__name__, module, " x ".join(map(str, size)), purpose)


class _ThreadState(threading.local):
    """A thread's prepared launches, and whether it records or traces launches."""

    def __init__(self) -> None:
        self.by_kernel: dict[tuple[Any, torch.device, int], _PreparedLaunch] = {}
        self.recording: RecordedLaunches | None = None
        """What this thread's launches are appended to, if it records them."""
        self.traced = False
        """Whether tensors have no memory, so that nothing is launched."""


_thread = _ThreadState()


def launch(
    kernel: Any,
    size: int | tuple[int, ...],
    device: torch.device,
    *arguments: Any,
    block_dim: int = CUDA_BLOCK,
) -> None:
    """Launch a kernel with `size` threads along each dimension on torch's current stream.

    Arguments follow the kernel's signature, without its first argument if that is `range_start`:
    tensors on the device (None: an absent array), structs and numbers. A 1D array is the whole of
    a contiguous tensor, whatever the tensor's shape.
    """
    if _thread.traced:
        return
    size = (size,) if isinstance(size, int) else size
    if 0 in size:
        return
    for noted in _observers:
        noted.append(_described(kernel, size))
    if _thread.recording is not None:
        _thread.recording.add(kernel, size, device, *arguments, block_dim=block_dim).run(size)
        return
    if kernel in MIN_RANGES:
        arguments = (0, *arguments)
    key = (kernel, device, block_dim)
    prepared = _thread.by_kernel.get(key)
    if prepared is None:
        prepared = _PreparedLaunch(kernel, size, device, block_dim, arguments)
        _thread.by_kernel[key] = prepared
    prepared.set(arguments)
    prepared.run(size)


@contextlib.contextmanager
def tracing() -> Iterator[None]:
    """Make `launch` do nothing in the block, in this thread: torch needs only results' shapes."""
    _thread.traced, before = True, _thread.traced
    try:
        yield
    finally:
        _thread.traced = before


def is_traced() -> bool:
    """Return whether this thread is in a `tracing` block: its tensors have no memory."""
    return _thread.traced


def is_aligned(tensor: Tensor, size: int = 16) -> bool:
    """Return whether a tensor begins at a multiple of `size` bytes in memory."""
    return _thread.traced or tensor.data_ptr() % size == 0


def aligned(tensor: Tensor) -> Tensor:
    """Return a contiguous tensor that can be read 16 bytes at a time."""
    tensor = tensor.contiguous()
    return tensor if is_aligned(tensor) else tensor.clone()


def is_recording() -> bool:
    """Return whether this thread records its launches."""
    return _thread.recording is not None


class RecordedLaunches:
    """A sequence of launches that is replayed on the same tensors in the same memory."""

    def __init__(self) -> None:
        self._launches: list[tuple[_PreparedLaunch, tuple[int, ...]]] = []
        self._tensors: list[list[Any]] = []
        """Tensors in the arguments, kept alive: the arguments contain only their addresses."""

    def add(
        self,
        kernel: Any,
        size: int | tuple[int, ...],
        device: torch.device,
        *arguments: Any,
        block_dim: int = CUDA_BLOCK,
    ) -> _PreparedLaunch:
        """Append a launch with the arguments of `launch`, and return it; it is not made yet."""
        size = (size,) if isinstance(size, int) else size
        arguments = (0, *arguments) if kernel in MIN_RANGES else arguments
        prepared = _PreparedLaunch(kernel, size, device, block_dim, arguments)
        prepared.set(arguments)
        self._launches.append((prepared, size))
        self._tensors.append(list(arguments))
        return prepared

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        """Make this thread's launches in the block, and append them."""
        _thread.recording, before = self, _thread.recording
        try:
            yield
        finally:
            _thread.recording = before

    def __len__(self) -> int:
        """Return the number of launches."""
        return len(self._launches)

    def argument_slots(self, tensor: Tensor) -> list[tuple[_PreparedLaunch, int]]:
        """Return where a tensor is an argument: launch and index. The caller keeps it alive."""
        slots, address = [], tensor.data_ptr()
        for (prepared, _), arguments in zip(self._launches, self._tensors, strict=True):
            for k, value in enumerate(arguments):
                if isinstance(value, Tensor) and value.data_ptr() == address:
                    arguments[k] = None
                    slots.append((prepared, k))
        return slots

    def move(self, slots: list[tuple[_PreparedLaunch, int]], tensor: Tensor) -> None:
        """Put a tensor of the same shape and dtype at these slots; the caller keeps it alive."""
        for prepared, index in slots:
            prepared.set_address(index, tensor)

    def replay(
        self, begin: int = 0, end: int | None = None, *, last_count: int | None = None
    ) -> None:
        """Repeat launches [begin, end); `last_count`: size of the last one's first dimension."""
        launches = self._launches[begin:end]
        for prepared, size in launches[:-1]:
            prepared.run(size)
        prepared, size = launches[-1]
        prepared.run(size if last_count is None else (last_count, *size[1:]))


# CPU threads, as many as torch is set to use. Where torch ships GNU's OpenMP, they are torch's own
# threads: after each operation these wait for the next one in a busy loop, and would compete for
# the cores with another pool.

RANGES_PER_THREAD = 4
"""Ranges per thread, at most: a thread that is delayed, as by another process, runs fewer."""

_Task = ctypes.CFUNCTYPE(None, ctypes.c_void_p)

_forked = False

_DEFAULT_THREADS = torch.get_num_threads()
"""Torch's own number of threads, unless it was set before this import."""


@functools.cache
def _team() -> Any:
    """Return the function of GNU's OpenMP that runs a task on each thread of a team, or None."""
    try:
        parallel = ctypes.CDLL(None).GOMP_parallel if sys.platform == "linux" else None
    except AttributeError:
        return None
    if parallel is not None:
        parallel.argtypes = (_Task, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint)
        parallel.restype = None
    return parallel


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="npa_envs")


def _leave_threads() -> None:
    """Use one thread in a forked process, in which the parent's threads do not run.

    Torch would wait for its threads for ever.
    """
    global _forked
    _forked = True
    _pool.cache_clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_threads)


def thread_count() -> int:
    """Return how many CPU threads run a kernel: torch's number.

    In a process started by Python's `multiprocessing` it is one, unless the number was set: such
    processes, for example of vector environments, share the cores.
    """
    threads = torch.get_num_threads()
    chosen = threads != _DEFAULT_THREADS or "OMP_NUM_THREADS" in os.environ
    return threads if chosen or multiprocessing.parent_process() is None else 1


def even_ranges(count: int, smallest: int) -> list[range]:
    """Split [0, count) for the CPU threads into ranges of at least `smallest` indices each."""
    if count < 2 * smallest:
        return [range(count)]
    threads = thread_count()
    parts = min(threads * RANGES_PER_THREAD, count // smallest) if threads > 1 else 1
    ends = [count * k // parts for k in range(parts + 1)]
    return [range(begin, end) for begin, end in itertools.pairwise(ends)]


def run_together(calls: Sequence[Callable[[], object]]) -> None:
    """Call functions in parallel, which must release the GIL; raise the first error at the end."""
    pending = iter(calls)
    errors: list[BaseException] = []

    def run_pending(_: object = None) -> None:
        for call in pending:
            try:
                call()
            except BaseException as error:
                errors.append(error)

    team = None if _forked else _team()
    if team is None:
        # In this thread and in a pool of Python threads at the same time.
        threads = min(torch.get_num_threads(), len(calls))
        helpers = [_pool().submit(run_pending) for _ in range(threads - 1)]
        run_pending()
        # A task that has not begun by now would find no call left.
        wait([helper for helper in helpers if not helper.cancel()])
    else:
        # On all threads: OpenMP would end those that a smaller team leaves out.
        team(_Task(run_pending), None, torch.get_num_threads(), 0)
    if errors:
        raise errors[0]
