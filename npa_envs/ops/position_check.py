"""The check that positions are finite, which overlaps with the work launched after it."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import threading
import time

import torch
from torch import Tensor

from npa_envs.checks import FiniteCheck
from npa_envs.kernels.portable.update import report_finite
from npa_envs.ops.launch import SCALARS, is_aligned, launch

THREADS = 2048
"""Threads that check positions."""

ALL_FINITE = bytes([1]) * THREADS
"""Their reports if all positions are finite."""

MAX_NUMBERS = 2**18
"""Maximum number of coordinates that they check; work on more hides torch's slower check."""

PATIENT_READS, QUERY_INTERVAL = 64, 2**17
"""Reads of all reports after which the host lets others run, and asks if the stream has failed."""

# On Linux a sleep of no time takes 50 µs.
_let_others_run = getattr(os, "sched_yield", functools.partial(time.sleep, 0.0))


def _new_reports(device: torch.device, _thread: int = 0) -> Tensor:
    """Return memory of the host that a device's threads write to: 1 if positions are finite."""
    return torch.ones(THREADS, dtype=torch.uint8, device="cpu", pin_memory=device.type == "cuda")


_reports_of = functools.cache(_new_reports)


def checked_positions(x: Tensor) -> contextlib.AbstractContextManager[object]:
    """Check that all positions are finite while the block launches work; raise NPAError after it.

    On a CPU they are checked first. Nothing is checked while torch compiles or captures.
    """
    # In this order: torch.compile cannot trace the other calls.
    if torch.compiler.is_compiling() or (x.is_cuda and torch.cuda.is_current_stream_capturing()):
        return contextlib.nullcontext()
    return PositionCheck(x)


class PositionCheck:
    """A check that all positions are finite: it starts when it is made, and `wait` raises.

    On CUDA it is on the current stream, so that `wait` waits only for earlier work. x must not
    change until then, and a thread waits for one check before it makes another. A `captured` check
    starts with each replay of the CUDA graph that calls `begin`, after `restart`.
    """

    def __init__(self, x: Tensor, *, captured: bool = False) -> None:
        self._x = x
        self._slow: FiniteCheck | None = None
        if captured:
            self._reports = _new_reports(x.device)
        elif is_slow(x):
            self._slow = FiniteCheck(x)
            if not x.is_cuda:
                self._slow.wait()
        else:
            self._reports = _reports_of(x.device, threading.get_ident())
            self.restart()
            self.begin()

    def restart(self) -> None:
        """Forget the last reports, for which after an error nobody has waited."""
        self._are_finite()
        ctypes.memset(self._reports.data_ptr(), 0, THREADS)

    def begin(self) -> None:
        """Launch the threads' reports."""
        # They write to the host's memory: a copy and an event would take more CPU time.
        kernel = report_finite(SCALARS[self._x.dtype])
        launch(kernel, THREADS, self._x.device, THREADS, 1, self._x, self._reports)

    def __enter__(self) -> None:
        """Begin the block that `checked_positions` describes."""

    def __exit__(self, *_: object) -> None:
        """Wait for the check and raise its error."""
        self.wait()

    def wait(self) -> None:
        """Wait for the check, not for work after it; raise NPAError if a position is not finite."""
        if self._slow is not None:
            self._slow.wait()
        elif not self._are_finite():
            FiniteCheck(self._x).wait()

    def _are_finite(self) -> bool:
        """Wait for all threads' reports; return whether all positions are finite."""
        address, reads = self._reports.data_ptr(), 0
        while (reports := ctypes.string_at(address, THREADS)) != ALL_FINITE:
            if 0 not in reports:
                return False
            reads += 1
            # It raises the device's error, if there is one.
            if reads % QUERY_INTERVAL == 0 and torch.cuda.current_stream(self._x.device).query():
                return False
            if reads > PATIENT_READS:
                _let_others_run()
        return True


def is_slow(x: Tensor) -> bool:
    """Return whether torch checks positions: on a CPU, or if they are many or in any places."""
    return not (x.is_cuda and x.numel() <= MAX_NUMBERS and x.is_contiguous() and is_aligned(x))
