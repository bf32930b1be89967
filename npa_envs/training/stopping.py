"""Signals that ask a run to stop in order."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

ONE_REQUEST = 1.0
"""Time within which signals are one request to stop [s]: a scheduler may ask both a run and its
launcher, which passes it on."""


@contextmanager
def stop_flag(*, patient: bool = False) -> Iterator[threading.Event]:
    """Within the block, the first SIGINT or SIGTERM sets the event; later ones act as usual.

    What comes within `ONE_REQUEST` of the first one is the same request.

    In a thread other than the main one, where signals cannot be caught, it stays unset.

    Args:
        patient: The next ones do nothing: torchrun passes on what a terminal has sent already.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    previous: dict[signal.Signals, Any] = {}
    first = 0.0

    def give_back() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if not asked.is_set():
            first = time.monotonic()
            asked.set()
            if not patient:
                print("\nstopping after this iteration; once more to stop at once", file=sys.stderr)
        elif not patient and time.monotonic() - first > ONE_REQUEST:
            give_back()
            signal.raise_signal(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, stop)
    try:
        yield asked
    finally:
        give_back()
