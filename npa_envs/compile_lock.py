"""A lock and a cache for making, compiling and loading kernels, by one thread at a time.

Warp's tables of modules and kernels are not thread-safe. Cached objects are found without the lock.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

P = ParamSpec("P")
R = TypeVar("R")

kernel_lock = threading.RLock()
"""Lock of the thread that makes, compiles or loads kernels."""

if hasattr(os, "register_at_fork"):
    # A forked process does not have its parent's other threads: one of them could have left a
    # half-made kernel and the lock.
    os.register_at_fork(
        before=kernel_lock.acquire,
        after_in_parent=kernel_lock.release,
        after_in_child=kernel_lock.release,
    )


def cached_under_lock(maxsize: int | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator like `functools.lru_cache(maxsize)` that calls functions under the lock.

    Threads that call it at the same time get the same object.
    """

    def decorate(make: Callable[P, R]) -> Callable[P, R]:
        cached = cast("Callable[P, R]", functools.lru_cache(maxsize)(make))

        @functools.wraps(make)
        def make_under_lock(*arguments: P.args, **keywords: P.kwargs) -> R:
            with kernel_lock:
                return cached(*arguments, **keywords)

        return cast("Callable[P, R]", functools.lru_cache(maxsize)(make_under_lock))

    return decorate
