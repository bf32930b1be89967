"""The check that positions are finite, which overlaps with the work that follows it."""

from __future__ import annotations

import contextlib
import ctypes
import threading
import time
from collections.abc import Iterator

import torch
from torch import Tensor

from npa_envs.checks import FiniteCheck
from npa_envs.kernels.portable.update import NOT_FINITE, report_finite
from npa_envs.ops.launch import SCALARS, is_aligned, launch

THREADS = 2048
"""Threads that check positions."""

MAX_NUMBERS = 2**18
"""Maximum number of coordinates that they check; work on more hides torch's slower check."""

PATIENT_READS = 64
"""Number of times that the host reads all reports before it lets other threads run."""

QUERY_INTERVAL = 4096
"""Number of reads after which the host asks whether the device has failed."""


class _Reports(threading.local):
    """A thread's pinned memory, to which threads of a device report, by device."""

    def __init__(self) -> None:
        self.by_device: dict[torch.device, Tensor] = {}


_reports = _Reports()


@contextlib.contextmanager
def checked_positions(x: Tensor) -> Iterator[None]:
    """Check that all positions are finite while the block launches work; raise NPAError after it.

    On a CPU it is checked first. Nothing is checked while torch compiles or captures a CUDA graph.
    """
    # In this order: torch.compile cannot trace the other calls.
    if torch.compiler.is_compiling() or (
        x.is_cuda and torch.cuda.is_current_stream_capturing()
    ):
        yield
    else:
        check = PositionCheck(x.detach())
        yield
        check.wait()


class PositionCheck:
    """A check that all positions are finite: it starts when it is made, and `wait` raises.

    On CUDA it is on the current stream, so that `wait` waits only for earlier work. x must not
    change until then.
    """

    def __init__(self, x: Tensor) -> None:
        self._x, self._slow = x, None
        if not x.is_cuda:
            FiniteCheck(x).wait()
        elif x.numel() > MAX_NUMBERS or not (x.is_contiguous() and is_aligned(x)):
            self._slow = FiniteCheck(x)
        else:
            found = _reports.by_device.get(x.device)
            if found is None:
                found = torch.empty(THREADS, dtype=torch.uint8, device="cpu", pin_memory=True)
                _reports.by_device[x.device] = found
            self._address = found.data_ptr()
            # Threads write to the host's memory: a copy and an event would take more CPU time.
            ctypes.memset(self._address, 0, THREADS)
            kernel = report_finite(SCALARS[x.dtype])
            launch(kernel, THREADS, x.device, THREADS, x, found)

    def wait(self) -> None:
        """Wait for the check, not for work after it; raise NPAError if a position is not finite."""
        if self._slow is not None:
            self._slow.wait()
        if self._slow is not None or not self._x.is_cuda:
            return
        reads = 0
        while 0 in (reports := ctypes.string_at(self._address, THREADS)):
            reads += 1
            if reads > PATIENT_READS:
                time.sleep(0.0)
            if reads % QUERY_INTERVAL == 0:
                # Raises the device's error, if there is one.
                torch.cuda.current_stream(self._x.device).query()
        if NOT_FINITE in reports:
            FiniteCheck(self._x).wait()
