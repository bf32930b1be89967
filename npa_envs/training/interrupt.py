"""Stop between two iterations, not in the middle of one."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class StopFlag:
    """Set once the user (Ctrl-C) or the system (SIGTERM) asks for the end."""

    def __init__(self) -> None:
        self.requested = False
        """Whether to stop after the iteration at hand."""


@contextmanager
def stop_flag() -> Iterator[StopFlag]:
    """Within the block, the first SIGINT or SIGTERM sets the flag; the next one acts as usual.

    In a thread other than the main one, where signals cannot be caught, the flag stays unset.
    """
    flag = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    previous: dict[signal.Signals, Any] = {}

    def stop(number: int, frame: FrameType | None) -> None:
        flag.requested = True
        print("\nstopping after this iteration; once more to stop at once", file=sys.stderr)
        for signal_number, handler in previous.items():
            signal.signal(signal_number, handler)

    for signal_number in (signal.SIGINT, signal.SIGTERM):
        previous[signal_number] = signal.signal(signal_number, stop)
    try:
        yield flag
    finally:
        for signal_number, handler in previous.items():
            signal.signal(signal_number, handler)
