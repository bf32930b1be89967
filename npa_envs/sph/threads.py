"""CPU threads beside the calling one, as many as torch is set to use."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

import torch

SHARES = 4
"""Ranges of a thread, at most: one that is held up, as by torch's own threads, runs fewer."""


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="npa_envs")


# A forked process has none of the threads that its parent's pool counts on: it starts its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def even_ranges(count: int, smallest: int) -> list[range]:
    """Return ranges of [0, count) for torch's threads, of `smallest` indices or more; or one."""
    threads = torch.get_num_threads()
    parts = max(min(threads * SHARES, count // smallest), 1) if threads > 1 else 1
    ends = [count * k // parts for k in range(parts + 1)]
    return [range(begin, end) for begin, end in itertools.pairwise(ends)]


def run_together(calls: Sequence[Callable[[], object]]) -> None:
    """Run calls that release the GIL, side by side; each thread takes the next one in turn."""
    pending = iter(calls)

    def run_pending() -> None:
        for call in pending:
            call()

    threads = min(torch.get_num_threads(), len(calls))
    helpers = [_pool().submit(run_pending) for _ in range(threads - 1)]
    try:
        run_pending()
    finally:
        # The arguments must outlive every call; what has not begun by now has nothing left to do.
        started = [helper for helper in helpers if not helper.cancel()]
        wait(started)
    for helper in started:
        helper.result()
