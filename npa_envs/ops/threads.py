"""CPU threads beside the calling one, as many as torch is set to use.

Where torch brings GNU's OpenMP, these are torch's own: threads of another pool would compete for
the cores with torch's, which after each operation wait for the next one in a busy loop.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import torch

SHARES = 4
"""Ranges of a thread, at most: one that is held up, as by another process, runs fewer."""

_Task = ctypes.CFUNCTYPE(None, ctypes.c_void_p)

_forked = False

_DEFAULT_THREADS = torch.get_num_threads()
"""What torch chose, unless somebody has chosen before."""


@functools.cache
def _team() -> Any:
    """Return OpenMP's function that runs a task on each thread of a team, or None."""
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
    """Forget what a forked process has of its parent's threads: none of them runs here."""
    global _forked
    _forked = True
    _pool.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_threads)


def thread_count() -> int:
    """Return how many threads kernels run on: torch's number.

    In a process that Python's `multiprocessing` has started it is one, unless the number was
    chosen: such processes, as vector environments start them, are meant to share the cores.
    """
    threads = torch.get_num_threads()
    chosen = threads != _DEFAULT_THREADS or "OMP_NUM_THREADS" in os.environ
    return threads if chosen or multiprocessing.parent_process() is None else 1


def even_ranges(count: int, smallest: int) -> list[range]:
    """Return ranges of [0, count) for all threads, of `smallest` indices or more; or one."""
    if count < 2 * smallest:
        return [range(count)]
    threads = thread_count()
    parts = min(threads * SHARES, count // smallest) if threads > 1 else 1
    ends = [count * k // parts for k in range(parts + 1)]
    return [range(begin, end) for begin, end in itertools.pairwise(ends)]


def run_together(calls: Sequence[Callable[[], object]]) -> None:
    """Run calls that release the GIL, side by side; each thread takes the next one in turn.

    Raises:
        BaseException: The first error of a call; the other calls have been run.
    """
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
        _run_in_pool(run_pending, min(torch.get_num_threads(), len(calls)))
    else:
        # Of all threads: OpenMP would end those that a smaller team leaves out.
        team(_Task(run_pending), None, torch.get_num_threads(), 0)
    if errors:
        raise errors[0]


def _run_in_pool(run: Callable[[], None], threads: int) -> None:
    """Run the same in this thread and, at the same time, in others of a pool of Python's."""
    helpers = [_pool().submit(run) for _ in range(threads - 1)]
    run()
    # One that has not begun by now would find nothing left to do.
    wait([helper for helper in helpers if not helper.cancel()])
