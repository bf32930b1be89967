"""Launches of Warp kernels on tensors, on torch's current stream or on CPU threads.

There are four ways to launch a kernel, each with less CPU time than the one before:

- The first `launch` of a kernel on a device has Warp compile and load the kernel and pack its
  arguments. The thread keeps the result, a `_PreparedLaunch`.
- Each later `launch` of it overwrites the arguments that changed, and repeats the prepared launch.
- `RecordedLaunches` keeps a sequence of prepared launches, each with arguments of its own, and
  replays them. Between replays only the addresses of chosen tensors can be changed.
- `repeated` does so for a whole operator: from the third call with tensors of the same forms on, it
  allocates results, and one block of memory for all other tensors, and repeats the launches.
"""

from __future__ import annotations

import collections
import contextlib
import ctypes
import functools
import inspect
import itertools
import math
import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from npa_envs.compile_lock import cached_under_lock, kernel_lock
from npa_envs.errors import NPAError
from npa_envs.kernels.lanes_and_memory import CUDA_BLOCK
from npa_envs.kernels.native_functions import MIN_RANGES
from npa_envs.ops.cpu_threads import even_ranges, run_together
from npa_envs.ops.cuda_driver import DriverLaunch
from npa_envs.runtime import in_turn, quiet_warp, start_warp

SCALARS: dict[torch.dtype, Any] = {
    torch.float32: wp.float32,
    torch.float64: wp.float64,
    torch.uint8: wp.uint8,
    torch.int64: wp.int64,
}
"""Warp's scalar type for each dtype."""

GROUP_WIDTHS = (4, 8, 16)
"""Numbers of state channels that one thread sums; worlds with more than 16 have several groups."""


def channel_width(state_dim: int) -> int:
    """Return how many of `state_dim` channels one thread sums: one of `GROUP_WIDTHS`."""
    return next((width for width in GROUP_WIDTHS if width >= state_dim), GROUP_WIDTHS[-1])


def warp_device(device: torch.device) -> Any:
    """Return Warp's device for a torch device, starting Warp (silently) where needed."""
    start_warp()
    return wp.device_from_torch(device)


class _ThreadState(threading.local):
    """A thread's prepared launches, and whether it records or traces launches."""

    def __init__(self) -> None:
        self.by_kernel: dict[tuple[Any, torch.device, int], _PreparedLaunch] = {}
        """Prepared launches by kernel, device and threads of a block."""
        self.recording: RecordedLaunches | None = None
        """Sequence to which this thread's launches are appended; None: they are not recorded."""
        self.traced = False
        """Whether tensors have no memory, so that nothing is launched."""
        self.calls: collections.OrderedDict[Hashable, int | _Repeat] = collections.OrderedDict()
        """Number of an operator's calls, or their launches, by function and forms of arguments."""


_thread = _ThreadState()


def launch(
    kernel: Any,
    size: int | tuple[int, ...],
    device: torch.device,
    *arguments: Any,
    block_dim: int = CUDA_BLOCK,
) -> None:
    """Launch a kernel with `size` threads along each dimension on torch's current stream.

    Arguments follow the kernel's signature, without its first one if that is `range_start`: tensors
    on the device (None: an absent array), structs and numbers. For a 1D array of the kernel, a
    contiguous tensor of any shape is flattened. A CUDA block has `block_dim` threads.
    """
    if _thread.traced:
        return
    size = (size,) if isinstance(size, int) else size
    if 0 in size:
        return
    for noted in _observers:
        noted.append(_described_launch(kernel, size))
    if _thread.recording is not None:
        _thread.recording.add(kernel, size, device, *arguments, block_dim=block_dim).run(size)
        return
    if kernel in MIN_RANGES:
        arguments = (0, *arguments)
    key = (kernel, device, block_dim)
    prepared = _thread.by_kernel.get(key)
    if prepared is None:
        prepared = _thread.by_kernel[key] = _prepare(kernel, size, device, block_dim, *arguments)
    prepared.set(arguments)
    prepared.run(size)


@contextlib.contextmanager
def tracing() -> Iterator[None]:
    """Make this thread's `launch` do nothing in the block: torch asks only for results' shapes."""
    _thread.traced, before = True, _thread.traced
    try:
        yield
    finally:
        _thread.traced = before


def is_traced() -> bool:
    """Return whether this thread is in a `tracing` block, where tensors have no memory."""
    return _thread.traced


ALIGNED_BYTES = 16
"""Largest alignment of tensors that a choice of kernels depends on [bytes]."""


def is_aligned(tensor: Tensor, size: int = ALIGNED_BYTES) -> bool:
    """Return whether a tensor begins at a multiple of `size` bytes, at most `ALIGNED_BYTES`."""
    return _thread.traced or tensor.data_ptr() % size == 0


def aligned(tensor: Tensor) -> Tensor:
    """Return a contiguous tensor that can be read 16 bytes at a time."""
    tensor = tensor.contiguous()
    return tensor if is_aligned(tensor) else tensor.clone()


def _prepare(
    kernel: Any, size: tuple[int, ...], device: torch.device, block_dim: int, *arguments: Any
) -> _PreparedLaunch:
    """Return a prepared launch of a kernel with these arguments; nothing is launched yet."""
    values = [
        _array_descriptor(value, _type_of(declared)) if isinstance(value, Tensor) else value
        for value, declared in zip(arguments, kernel.adj.args, strict=True)
    ]
    target = warp_device(device)
    loaded = (kernel.module, device) in loaded_modules
    one_process = contextlib.nullcontext() if loaded else in_turn(kernel.module.name)
    with kernel_lock, quiet_warp(), one_process:
        packed = wp.launch(
            kernel,
            size,
            inputs=values,
            device=target,
            block_dim=block_dim if target.is_cuda else None,
            record_tape=False,
            record_cmd=True,
        )
        loaded_modules.add((kernel.module, device))
    return (_CudaLaunch if target.is_cuda else _CpuLaunch)(packed, device, *arguments)


loaded_modules: set[tuple[Any, torch.device]] = set()
"""Modules of kernels that have been loaded, each with its device."""

MAX_DESCRIPTORS = 64
"""Maximum number of shapes whose descriptors are cached for an argument of a kernel."""

MAX_BOUNDS = 4096
"""Maximum number of launch sizes whose structs are cached for a kernel."""


class _PreparedLaunch:
    """A kernel on a device with memory for its arguments; a launch overwrites those that changed.

    A launch of five arrays and two numbers takes 2.5 µs of CPU time here. `wp.launch`, which packs
    all arguments, takes 17 µs, and Warp's recorded launches with new arguments take 14 µs; a step
    has about ten launches. So Warp packs only the first arguments. Launches repeat that one by
    fields of Warp's `Launch` that it does not document: `bounds`, `params`, `params_addr`, `hooks`.
    """

    def __init__(self, packed: Any, device: torch.device, *arguments: Any) -> None:
        self._warp_launch = packed
        self._device = device
        self._bounds: dict[tuple[int, ...], Any] = {}
        parameters = packed.params[1:]
        fields = [(f"a{k}", type(value)) for k, value in enumerate(parameters)]
        self.memory: Any = _argument_struct(tuple(fields))(*parameters)
        """Struct of all arguments, which the kernel reads."""
        self.names = [name for name, _ in fields]
        self._writers: list[tuple[int, Callable[[Any], None]]] = []
        """Index of each argument that is an array or a struct, and the function that writes it."""
        self._number_indices: list[int] = []
        for k, (name, argument) in enumerate(zip(self.names, packed.kernel.adj.args, strict=True)):
            memory, declared = getattr(self.memory, name), _type_of(argument)
            if isinstance(declared, wp.array):
                self._writers.append((k, _ArrayArgument(memory, declared).set))
            elif hasattr(arguments[k], "__ctype__"):
                self._writers.append((k, _StructArgument(memory).set))
            else:
                self._number_indices.append(k)
        self._last_numbers: list[Any] = [None] * len(parameters)

    def set(self, arguments: tuple[Any, ...]) -> None:
        """Replace the kernel's arguments for the next launch."""
        for k, write in self._writers:
            write(arguments[k])
        last = self._last_numbers
        for k in self._number_indices:
            value = arguments[k]
            if value != last[k]:
                last[k] = value
                declared = self._warp_launch.kernel.adj.args[k].type
                number = declared(*value) if isinstance(value, tuple) else value
                setattr(self.memory, self.names[k], number)

    def run(self, size: tuple[int, ...]) -> None:
        """Launch the kernel with `size` threads along each dimension."""
        raise NotImplementedError

    def _bounds_of(self, size: tuple[int, ...]) -> Any:
        """Return Warp's struct of a launch of `size` threads along each dimension."""
        bounds = self._bounds.get(size)
        if bounds is None:
            # CPU threads share Warp's launch.
            with kernel_lock:
                if len(self._bounds) > MAX_BOUNDS:
                    self._bounds.clear()
                self._warp_launch.set_dim(size)
                bounds = self._bounds[size] = self._warp_launch.bounds
        return bounds


@functools.lru_cache(maxsize=1024)
def _argument_struct(fields: tuple[tuple[str, type], ...]) -> Any:
    return type("Arguments", (ctypes.Structure,), {"_fields_": list(fields)})


class _CpuLaunch(_PreparedLaunch):
    """A launch on CPU threads, which share the first dimension if the kernel is in `MIN_RANGES`."""

    def run(self, size: tuple[int, ...]) -> None:
        smallest = MIN_RANGES.get(self._warp_launch.kernel)
        ranges = [] if smallest is None else even_ranges(size[0], smallest)
        if len(ranges) > 1:
            run_together([functools.partial(self._run_range, size, part) for part in ranges])
        else:
            self._run_in_this_thread(self.memory, size)

    def _run_range(self, size: tuple[int, ...], indices: range) -> None:
        """Run the threads whose first index is in `indices`, on a copy of the arguments."""
        memory = type(self.memory).from_buffer_copy(self.memory)
        setattr(memory, self.names[0], indices.start)
        self._run_in_this_thread(memory, (len(indices), *size[1:]))

    def _run_in_this_thread(self, memory: Any, size: tuple[int, ...]) -> None:
        self._warp_launch.hooks.forward(ctypes.byref(self._bounds_of(size)), ctypes.byref(memory))


class _CudaLaunch(_PreparedLaunch):
    """A launch on torch's current stream, by CUDA's driver or, where that cannot, by Warp."""

    def __init__(self, packed: Any, device: torch.device, *arguments: Any) -> None:
        super().__init__(packed, device, *arguments)
        begin, layout = ctypes.addressof(self.memory), type(self.memory)
        addresses = [begin + getattr(layout, name).offset for name in self.names]
        self._addresses = (ctypes.c_void_p * (1 + len(addresses)))(0, *addresses)
        """Addresses of the launch's size, which `run` writes, and of each argument."""
        packed.params_addr = self._addresses
        self._by_driver = DriverLaunch(packed, device, self._addresses)

    def run(self, size: tuple[int, ...]) -> None:
        bounds = self._bounds_of(size)
        self._addresses[0] = ctypes.addressof(bounds)
        index = self._device.index
        index = torch.cuda.current_device() if index is None else index
        # Ten times faster than `torch.cuda.current_stream`, which makes an object of it.
        stream = torch._C._cuda_getCurrentRawStream(index)
        if not self._by_driver.run(bounds.size, stream):
            self._warp_launch.bounds = bounds
            self._warp_launch.launch(_warp_stream(self._device, stream))


@cached_under_lock(64)
def _warp_stream(device: torch.device, handle: int) -> Any:
    return wp.Stream(wp.device_from_torch(device), cuda_stream=handle)


class _ArrayArgument:
    """Warp's array descriptor of one tensor argument, updated in place for each launch."""

    def __init__(self, descriptor: Any, array_type: Any) -> None:
        self._descriptor = descriptor
        self._type = array_type
        self._size: tuple[int, ...] | None = None
        """Shape of the described tensor; (): describe the next one again; None: it is absent."""
        self._dtype: torch.dtype | None = None
        self._described: dict[tuple[Any, ...], Any] = {}
        """Descriptors by shape, dtype and, unless tensors are contiguous, strides."""

    def set(self, tensor: Tensor | None) -> None:
        """Write a tensor's address, and its shape if that changed; None: an absent array."""
        if tensor is None:
            # Kernels read the size of an absent array.
            if self._size is not None:
                _overwrite(self._descriptor, self._type.__ctype__())
                self._size = None
            return
        size, dense = tensor.shape, tensor.is_contiguous()
        if size != self._size or tensor.dtype is not self._dtype or not dense:
            key = size, tensor.dtype, None if dense else tensor.stride()
            described = self._described.get(key)
            if described is None:
                described = _array_descriptor(tensor, self._type)
                if len(self._described) < MAX_DESCRIPTORS:
                    self._described[key] = described
            _overwrite(self._descriptor, described)
            self._size, self._dtype = size if dense else (), tensor.dtype
        self._descriptor.data = tensor.data_ptr() or _empty_address(tensor)


def _empty_address(tensor: Tensor) -> int:
    """Return 0, the address of an empty tensor; raise NPAError if the tensor is not empty."""
    if tensor.numel():
        raise NPAError(
            "tensors must have memory of their own, got a tensor subclass that wraps others "
            f"({type(tensor).__name__}): give the plain tensors within it"
        )
    return 0


def _overwrite(memory: Any, value: Any) -> None:
    ctypes.memmove(ctypes.byref(memory), ctypes.byref(value), ctypes.sizeof(value))


def _array_descriptor(tensor: Tensor, array_type: Any) -> Any:
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


class RecordedLaunches:
    """A sequence of launches to replay with the same arguments, but for tensors that are moved."""

    def __init__(self) -> None:
        self.launches: list[tuple[_PreparedLaunch, tuple[int, ...]]] = []
        """All launches and their sizes."""
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
        """Append a launch, with the arguments of `launch`, and return it; nothing is launched."""
        size = (size,) if isinstance(size, int) else size
        arguments = (0, *arguments) if kernel in MIN_RANGES else arguments
        prepared = _prepare(kernel, size, device, block_dim, *arguments)
        prepared.set(arguments)
        self.launches.append((prepared, size))
        self._tensors.append(list(arguments))
        return prepared

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        """Append the launches that this thread makes in the block."""
        _thread.recording, before = self, _thread.recording
        try:
            yield
        finally:
            _thread.recording = before

    def __len__(self) -> int:
        """Return the number of launches."""
        return len(self.launches)

    def addresses(self) -> Iterator[tuple[Any, Tensor]]:
        """Yield each tensor that is not empty, with the number that is its address in arguments."""
        for (prepared, _), arguments in zip(self.launches, self._tensors, strict=True):
            for k, value in enumerate(arguments):
                if isinstance(value, Tensor) and value.numel():
                    descriptor = getattr(prepared.memory, prepared.names[k])
                    offset = type(descriptor).data.offset
                    yield ctypes.c_uint64.from_buffer(descriptor, offset), value

    def argument_slots(self, tensor: Tensor) -> list[Any]:
        """Return the addresses of `tensor` in arguments; the caller keeps it alive."""
        begin = tensor.data_ptr()
        found = [(slot, value) for slot, value in self.addresses() if value.data_ptr() == begin]
        gone = {id(value) for _, value in found}
        self._tensors = [[None if id(v) in gone else v for v in each] for each in self._tensors]
        return [slot for slot, _ in found]

    def move(self, slots: list[Any], tensor: Tensor) -> None:
        """Put a tensor of the same shape and dtype at these `slots`; the caller keeps it alive."""
        address = tensor.data_ptr() or _empty_address(tensor)
        for slot in slots:
            slot.value = address

    def replay(
        self, begin: int = 0, end: int | None = None, *, last_count: int | None = None
    ) -> None:
        """Repeat launches [begin, end); `last_count` replaces the first size of the last one."""
        launches = self.launches[begin:end]
        for prepared, size in launches[:-1]:
            prepared.run(size)
        prepared, size = launches[-1]
        prepared.run(size if last_count is None else (last_count, *size[1:]))


MAX_REPEATED = 128
"""Maximum number of kinds of operator calls that a thread counts."""

CALLED_FIRST = 2
"""Number of calls of a kind before its launches are recorded."""

ALIGNMENT = 512
"""Alignment of tensors within a block of memory [bytes], that of torch's allocators."""


def repeated(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """Return `function(*arguments)`, from the third call of a kind on by repeating its launches.

    The function allocates and launches. All else that it does must follow from numbers in the
    arguments, and from the tensors' shapes, dtypes, devices and alignment. If it calls any other
    operator of torch, it is always called. Results are new tensors in each call.
    """
    if _thread.traced or _thread.recording is not None or _observers:
        return function(*arguments)
    tensors: list[Tensor] = []
    key: list[Hashable] = [function]
    values = [*arguments]
    for value in values:
        cls = type(value)
        if cls is Tensor or cls is nn.Parameter:
            if not value.is_contiguous():
                return function(*arguments)
            tensors.append(value)
            key += (value.shape, value.dtype, value.device, value.data_ptr() % ALIGNED_BYTES)
        elif cls is list:
            # Its entries follow after all arguments.
            key.append(len(value))
            values += value
        elif isinstance(value, Tensor):
            return function(*arguments)
        else:
            key.append(value)
    of_thread, kind = _thread.calls, tuple(key)
    calls = of_thread.get(kind, 0)
    if isinstance(calls, _Repeat):
        return calls.run(tensors)
    of_thread[kind] = calls + 1
    if len(of_thread) > MAX_REPEATED:
        of_thread.popitem(last=False)
    if calls != CALLED_FIRST:
        return function(*arguments)
    recorded, watch = RecordedLaunches(), _WatchedOperators()
    with recorded.recording(), watch:
        results = function(*arguments)
    if watch.only_allocates:
        with contextlib.suppress(LookupError):
            of_thread[kind] = _Repeat(recorded, tensors, results, watch.allocated)
    return results


class _WatchedOperators(TorchDispatchMode):
    """Notes whether torch's operators in the block only allocate memory, and make views of it."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.only_allocates = True
        self.allocated: set[int] = set()
        """Addresses of the memory."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Return False, as torch would import its compiler for this mode, which takes seconds."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operator of torch."""
        result = func(*args, **(kwargs or {}))
        if func.name().startswith(("aten::empty", "aten::new_empty")):
            self.allocated.add(result.untyped_storage().data_ptr())
        else:
            self.only_allocates &= func.is_view
        return result


class _Repeat:
    """The launches of an operator's call, to repeat with other tensors of the same forms.

    Raises LookupError if tensors share memory, or are neither arguments nor `allocated`.
    """

    def __init__(
        self,
        recorded: RecordedLaunches,
        inputs: Sequence[Tensor],
        results: Any,
        allocated: set[int],
    ) -> None:
        self._several = None if isinstance(results, Tensor) else type(results)
        made: list[Tensor] = [results] if self._several is None else [*results]
        self._makes = [
            functools.partial(torch.empty, (*each.shape,), dtype=each.dtype, device=each.device)
            for each in made
        ]
        self._launches, self._block_bytes = recorded.launches, 0
        self._addresses: list[tuple[Any, int, int]] = []
        """Addresses in arguments, each with the index of a result or input, and a distance [bytes]
        from its begin; the index after the last is that of the block for all other tensors."""
        regions = [(each.data_ptr(), each.data_ptr() + each.nbytes) for each in (*made, *inputs)]
        filled = sorted(region for region in regions if region[0] < region[1])
        if any(end > begin for (_, end), (begin, _) in itertools.pairwise(filled)):
            raise LookupError("tensors share memory")
        places: dict[int, int] = {}
        for address, tensor in recorded.addresses():
            storage, begin = tensor.untyped_storage(), tensor.data_ptr()
            extents = zip(tensor.shape, tensor.stride(), strict=True)
            end = begin + (1 + sum((n - 1) * stride for n, stride in extents)) * tensor.itemsize
            owners = [k for k, (first, last) in enumerate(regions) if first <= begin < last]
            whole = storage.data_ptr()
            if owners:
                index, distance = owners[0], begin - regions[owners[0]][0]
                if end > regions[index][1]:
                    raise LookupError("an array is larger than the tensor that it begins in")
            elif whole in allocated:
                if whole not in places:
                    places[whole] = self._block_bytes
                    self._block_bytes += -(-storage.nbytes() // ALIGNMENT) * ALIGNMENT
                index, distance = len(regions), places[whole] + begin - whole
            else:
                raise LookupError("a tensor is not one of the call's")
            self._addresses.append((address, index, distance))

    def run(self, inputs: Sequence[Tensor]) -> Any:
        """Return the operator's results for other tensors."""
        made = [make() for make in self._makes]
        begins = [tensor.data_ptr() for tensor in (*made, *inputs)]
        if self._block_bytes:
            device = inputs[0].device
            block = torch.empty(self._block_bytes, dtype=torch.uint8, device=device)
            begins.append(block.data_ptr())
        for address, index, distance in self._addresses:
            address.value = begins[index] + distance
        for prepared, size in self._launches:
            prepared.run(size)
        return made[0] if self._several is None else self._several(made)


class NotedLaunch(NamedTuple):
    """Description of one launch of a Warp kernel."""

    kernel: str
    """The kernel's name."""
    module: str
    """The Warp module of its variant, without the package's name."""
    threads: str
    """Threads along each dimension."""
    purpose: str
    """First line of the kernel's docstring."""


@contextlib.contextmanager
def noted_launches() -> Iterator[list[NotedLaunch]]:
    """Yield a list that receives each launch made within the block, by any thread."""
    noted: list[NotedLaunch] = []
    _observers.append(noted)
    try:
        yield noted
    finally:
        _observers.remove(noted)


_observers: list[list[NotedLaunch]] = []
"""Lists to which launches are added."""


def _described_launch(kernel: Any, size: tuple[int, ...]) -> NotedLaunch:
    purpose = (inspect.getdoc(kernel.func) or "").split("\n")[0]
    module = kernel.module.name.removeprefix("npa_envs.").removeprefix("kernels.")
    return NotedLaunch(kernel.func.__name__, module, " x ".join(map(str, size)), purpose)
