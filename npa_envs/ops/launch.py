"""Launches: tensors become arguments of Warp kernels, which join torch's stream or CPU threads."""

from __future__ import annotations

import contextlib
import copy
import functools
from typing import Any

import torch
import warp as wp
from torch import Tensor

from npa_envs.kernels.access import CUDA_BLOCK
from npa_envs.kernels.cpu import SMALLEST_RANGES
from npa_envs.ops.threads import even_ranges, run_together
from npa_envs.runtime import quiet_warp, start_warp

SCALARS: dict[torch.dtype, Any] = {torch.float32: wp.float32, torch.float64: wp.float64}
"""Warp's scalar type for each floating dtype that the operators take."""

GROUP_WIDTHS = (4, 8, 16)
"""Channels of a group, which are summed together; there are several beyond the largest width."""


def scalar_type(dtype: torch.dtype) -> Any:
    """Return Warp's scalar type for a checked floating dtype."""
    return SCALARS[dtype]


def channel_width(state_dim: int) -> int:
    """Return how many channels form a group."""
    return next((width for width in GROUP_WIDTHS if width >= state_dim), GROUP_WIDTHS[-1])


def warp_device(device: torch.device) -> Any:
    """Return Warp's device for a torch device, starting Warp (silently) where needed."""
    start_warp()
    return wp.device_from_torch(device)


@functools.lru_cache(maxsize=1024)
def _array_types(kernel: Any) -> tuple[Any, ...]:
    return tuple(
        argument.type if isinstance(argument.type, wp.array) else None
        for argument in kernel.adj.args
    )


def _as_array(tensor: Tensor | None, array_type: Any) -> Any:
    if tensor is None:
        return None
    return wp.from_torch(
        tensor.detach(), dtype=array_type.dtype, requires_grad=False, return_ctype=True
    )


@functools.lru_cache(maxsize=64)
def _warp_stream(device: torch.device, handle: int) -> Any:
    return wp.Stream(wp.device_from_torch(device), cuda_stream=handle)


_launched: set[tuple[Any, torch.device]] = set()


def _converted(kernel: Any, arguments: tuple[Any, ...]) -> list[Any]:
    """Return a kernel's arguments as Warp takes them; one that is cut into ranges begins at 0."""
    arguments = (*_range_start(kernel), *arguments)
    return [
        value if array_type is None else _as_array(value, array_type)
        for value, array_type in zip(arguments, _array_types(kernel), strict=True)
    ]


def _range_start(kernel: Any) -> tuple[int, ...]:
    return (0,) if kernel in SMALLEST_RANGES else ()


def _ranges(kernel: Any, size: tuple[int, ...], device: torch.device) -> list[range]:
    """Return what threads of the CPU run of a launch's first dimension; one range: no cut."""
    smallest = SMALLEST_RANGES.get(kernel)
    if device.type != "cpu" or smallest is None:
        return [range(size[0])]
    return even_ranges(size[0], smallest)


def _launch_range(recorded: Any, size: tuple[int, ...], indices: range) -> None:
    """Launch a part of a recorded launch, with which it shares all other arguments."""
    part = copy.copy(recorded)
    part.params = list(recorded.params)
    part.set_dim((len(indices), *size[1:]))
    part.set_param_at_index(0, indices.start)
    part.launch()


def _launch_ranges(recorded: Any, size: tuple[int, ...], ranges: list[range]) -> None:
    run_together([functools.partial(_launch_range, recorded, size, part) for part in ranges])


def _current_stream(device: torch.device) -> Any:
    """Return torch's current stream of a CUDA device as Warp knows it, None for a CPU."""
    if device.type != "cuda":
        return None
    return _warp_stream(device, torch.cuda.current_stream(device).cuda_stream)


def _placement(device: torch.device, block_dim: int = CUDA_BLOCK) -> dict[str, Any]:
    """Return where `wp.launch` shall put a kernel."""
    where = warp_device(device)
    threads = block_dim if where.is_cuda else None
    return {"device": where, "stream": _current_stream(device), "block_dim": threads}


def _quiet_at_first(kernel: Any, device: torch.device) -> contextlib.AbstractContextManager[Any]:
    """Return a context for a launch: the first one of a kernel loads its module."""
    first = (kernel, device) not in _launched
    _launched.add((kernel, device))
    return quiet_warp() if first else contextlib.nullcontext()


def launch(
    kernel: Any,
    size: int | tuple[int, ...],
    device: torch.device,
    *arguments: Any,
    block_dim: int = CUDA_BLOCK,
) -> None:
    """Launch a kernel on torch's current stream of a device.

    Args:
        kernel: A Warp kernel; its own signature says how each tensor is read.
        size: Number of threads along each dimension.
        device: Device of every tensor among the arguments.
        arguments: Kernel arguments in order: tensors (None for an absent one), structs and numbers;
            without `range_start`, where the kernel has it.
        block_dim: Threads of a CUDA block.
    """
    size = (size,) if isinstance(size, int) else size
    converted = _converted(kernel, arguments)
    placement = _placement(device, block_dim)
    ranges = _ranges(kernel, size, device)
    with _quiet_at_first(kernel, device):
        recorded = wp.launch(
            kernel,
            size,
            inputs=converted,
            record_tape=False,
            record_cmd=len(ranges) > 1,
            **placement,
        )
    if len(ranges) > 1:
        _launch_ranges(recorded, size, ranges)


def _form(tensor: Tensor) -> tuple[Any, ...]:
    return tensor.shape, tensor.dtype, tensor.device, tensor.is_contiguous()


class PreparedLaunch:
    """A launch that is made again and again with one tensor changed: a tenth of the host's time.

    Args:
        kernel: As for `launch`.
        size: As for `launch`.
        device: As for `launch`.
        arguments: As for `launch`.
        changing: The tensor among them that changes; all others stay alive, where they are.
    """

    def __init__(
        self,
        kernel: Any,
        size: int | tuple[int, ...],
        device: torch.device,
        *arguments: Any,
        changing: Tensor,
    ) -> None:
        self._kernel = kernel
        self._size = (size,) if isinstance(size, int) else size
        self._device = device
        # The recorded launch knows addresses alone.
        self._kept = [value for value in arguments if value is not changing]
        converted = _converted(kernel, arguments)
        placement = _placement(device)
        with _quiet_at_first(kernel, device):
            self._recorded = wp.launch(
                kernel, size, inputs=converted, record_tape=False, record_cmd=True, **placement
            )
        self._form = _form(changing)
        place = next(k for k, value in enumerate(arguments) if value is changing)
        place += len(_range_start(kernel))
        self._argument = converted[place]
        self._recorded.set_param_at_index_from_ctype(place, self._argument)

    def __call__(self, tensor: Tensor) -> None:
        """Launch on torch's current stream.

        Args:
            tensor: The changing argument, contiguous like the first one, of its shape, dtype and
                device.
        """
        assert _form(tensor) == self._form, "only an address is replaced"
        self._argument.data = tensor.data_ptr()
        ranges = _ranges(self._kernel, self._size, self._device)
        if len(ranges) > 1:
            _launch_ranges(self._recorded, self._size, ranges)
        else:
            self._recorded.launch(_current_stream(self._device))
