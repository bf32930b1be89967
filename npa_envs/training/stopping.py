"""Signals that ask a run to stop in order."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


@contextmanager
def stop_flag(*, patient: bool = False) -> Iterator[threading.Event]:
    """Within the block, the first SIGINT or SIGTERM sets the event; the next one acts as usual.

    In a thread other than the main one, where signals cannot be caught, it stays unset.

    Args:
        patient: The next ones do nothing: torchrun passes on what a terminal has sent already.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    previous: dict[signal.Signals, Any] = {}

    def give_back() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def stop(number: int, frame: FrameType | None) -> None:
        if patient:
            asked.set()
            return
        asked.set()
        print("\nstopping after this iteration; once more to stop at once", file=sys.stderr)
        give_back()

    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, stop)
    try:
        yield asked
    finally:
        give_back()
