"""Calls on several CPU threads, as many as torch is set to use, and the ranges that they share.

Where torch ships GNU's OpenMP, the threads are torch's own: after each operation these wait for the
next one in a busy loop, and would compete for the cores with another pool.
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

RANGES_PER_THREAD = 4
"""Maximum number of ranges per thread: several, so that a delayed thread can run fewer."""

_Task = ctypes.CFUNCTYPE(None, ctypes.c_void_p)

_forked = False

_DEFAULT_THREADS = torch.get_num_threads()
"""Torch's own number of threads, unless it was set before this import."""


@functools.cache
def _team() -> Any:
    """Return GNU OpenMP's function that runs a task on several threads; None: it is not there."""
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


def _use_one_thread() -> None:
    """Use one thread in a forked process, where torch would wait for its parent's threads."""
    global _forked
    _forked = True
    _pool.cache_clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_use_one_thread)


def thread_count() -> int:
    """Return the number of CPU threads that run a kernel: torch's number.

    In a process started by Python's `multiprocessing` it is one, unless the number was set: such
    processes, for example of vector environments, share the cores.
    """
    threads = torch.get_num_threads()
    chosen = threads != _DEFAULT_THREADS or "OMP_NUM_THREADS" in os.environ
    return threads if chosen or multiprocessing.parent_process() is None else 1


def even_ranges(count: int, smallest: int) -> list[range]:
    """Return ranges that split [0, count) evenly for CPU threads, of `smallest` indices or more."""
    if count < 2 * smallest:
        return [range(count)]
    threads = thread_count()
    parts = min(threads * RANGES_PER_THREAD, count // smallest) if threads > 1 else 1
    ends = [count * k // parts for k in range(parts + 1)]
    return [range(begin, end) for begin, end in itertools.pairwise(ends)]


def run_together(calls: Sequence[Callable[[], object]]) -> None:
    """Call functions on CPU threads, in parallel if they release the GIL; raise the first error."""
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
