"""Launches through CUDA's driver API: less CPU time than Warp's, and overlapped in CUDA graphs.

Rollouts and environments are chains of kernels of some microseconds each, and the gaps between
kernels take a large part of the time. With programmatic dependent launch (compute capability 9.0
and above) a kernel that begins with `wait_for_previous_kernel` is started before the previous one
has ended, and waits inside until it has: the results are the same.

Such a kernel must not load with `ld.global.nc` or `__ldg`, which declare that nothing writes to
the memory while the kernel runs: the compiler moves these loads ahead of the wait.

Only a kernel that follows one kernel of the same graph is launched early: the first kernel of a
graph would not wait for earlier work of the stream.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch

OVERLAPPING_CAPABILITY = 90
"""Lowest compute capability, times ten, with programmatic dependent launch."""

MAX_THREADS = 2**31 - 1
"""Maximum number of threads of a launch: kernels number them along one dimension of a grid."""

# Constants and structs of CUDA's driver API, cuda.h.

PROGRAMMATIC_STREAM_SERIALIZATION = 6
KERNEL_NODE = 0
NON_BLOCKING_STREAM = 1


class _AttributeValue(ctypes.Union):
    _fields_ = [("flag", ctypes.c_int), ("size", ctypes.c_char * 64)]


class _Attribute(ctypes.Structure):
    _fields_ = [("id", ctypes.c_int), ("unused", ctypes.c_int), ("value", _AttributeValue)]


_SIZES = ("grid_x", "grid_y", "grid_z", "block_x", "block_y", "block_z", "shared_bytes")


class _Config(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_uint) for name in _SIZES),
        ("stream", ctypes.c_void_p),
        ("attributes", ctypes.POINTER(_Attribute)),
        ("attribute_count", ctypes.c_uint),
    ]


@functools.cache
def _driver() -> Any:
    """Return CUDA's driver library, or None where it is missing or too old."""
    for name in ("libcuda.so.1", "nvcuda.dll"):
        try:
            driver = ctypes.CDLL(name)
        except OSError:
            continue
        needed = ("cuLaunchKernelEx", "cuStreamGetCaptureInfo_v3", "cuGraphNodeGetType")
        return driver if all(hasattr(driver, function) for function in needed) else None
    return None


def new_stream(device: torch.device) -> torch.cuda.Stream:
    """Return a new CUDA stream, which torch uses nowhere else; it lives as long as the process.

    `torch.cuda.Stream` returns the same 32 streams in turn, so another thread could use one that is
    being captured.
    """
    driver, handle = _driver(), ctypes.c_void_p()
    with torch.cuda.device(device):
        torch.cuda.current_stream()
        if driver is None or driver.cuStreamCreate(ctypes.byref(handle), NON_BLOCKING_STREAM):
            return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    return torch.cuda.ExternalStream(handle.value, device)  # type: ignore[no-untyped-call]


def _follows_kernel(stream: int) -> bool:
    """Return whether the next launch captured on a stream depends on exactly one kernel."""
    driver = _driver()
    status, identifier, graph = ctypes.c_int(), ctypes.c_uint64(), ctypes.c_void_p()
    nodes, edges = ctypes.POINTER(ctypes.c_void_p)(), ctypes.c_void_p()
    count = ctypes.c_size_t()
    results = (status, identifier, graph, nodes, edges, count)
    failed = driver.cuStreamGetCaptureInfo_v3(ctypes.c_void_p(stream), *map(ctypes.byref, results))
    if failed or count.value != 1:
        return False
    node_type = ctypes.c_int(-1)
    failed = driver.cuGraphNodeGetType(ctypes.c_void_p(nodes[0]), ctypes.byref(node_type))
    return not failed and node_type.value == KERNEL_NODE


class DriverLaunch:
    """Warp's `launch`, repeated by the driver API with the parameters at `addresses` in memory."""

    def __init__(self, launch: Any, device: torch.device, addresses: Any) -> None:
        capability = launch.device.get_cuda_compile_arch() or 0
        self._waits = (
            capability >= OVERLAPPING_CAPABILITY
            and "wait_for_previous_kernel()" in launch.kernel.adj.source
        )
        self._device = device
        self._block = launch.block_dim
        driver = _driver()
        self._launch = None if driver is None else driver.cuLaunchKernelEx
        self._function = ctypes.c_void_p(launch.hooks.forward)
        self._addresses = addresses
        early = _Attribute(PROGRAMMATIC_STREAM_SERIALIZATION)
        early.value.flag = 1
        shared_bytes = launch.hooks.forward_smem_bytes
        self._config = _Config(
            1, 1, 1, self._block, 1, 1, shared_bytes, None, ctypes.pointer(early), 0
        )
        self._config_address = ctypes.byref(self._config)

    def run(self, thread_count: int, stream: int) -> bool:
        """Launch `thread_count` threads on a stream; return False if nothing was launched."""
        # Torch's public functions also ask whether CUDA has been initialised.
        other_device = torch._C._cuda_getDevice() != self._device.index
        if self._launch is None or thread_count > MAX_THREADS or other_device:
            return False
        config = self._config
        config.grid_x = -(-thread_count // self._block)
        config.stream = stream
        if self._waits:
            early = torch._C._cuda_isCurrentStreamCapturing() and _follows_kernel(stream)
            config.attribute_count = int(early)
        return not self._launch(self._config_address, self._function, self._addresses, None)
