"""What one thread at a time does: making, compiling and loading kernels.

Warp's tables of modules and kernels are not made for several threads. What is made once is found
without the lock from then on.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

P = ParamSpec("P")
R = TypeVar("R")

alone = threading.RLock()
"""Held by the thread that makes, compiles or loads kernels."""

if hasattr(os, "register_at_fork"):
    # A forked process has none of its parent's other threads, which would leave a half-made kernel
    # and the lock held for ever.
    os.register_at_fork(
        before=alone.acquire, after_in_parent=alone.release, after_in_child=alone.release
    )


def made_once(kept: int | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that caches a function as `functools.lru_cache` does, for all threads.

    Threads that call the function at the same time get the same object, of one call.
    """

    def decorate(make: Callable[P, R]) -> Callable[P, R]:
        made = cast("Callable[P, R]", functools.lru_cache(kept)(make))

        @functools.wraps(make)
        def make_alone(*arguments: P.args, **keywords: P.kwargs) -> R:
            with alone:
                return made(*arguments, **keywords)

        return cast("Callable[P, R]", functools.lru_cache(kept)(make_alone))

    return decorate
