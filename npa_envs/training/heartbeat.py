"""Processes of a run that tell each other that they live, and end where one has fallen silent."""

from __future__ import annotations

import os
import sys
import threading
from typing import Protocol

BEAT_SECONDS = 5.0
"""Pause between two signs of life [s]."""

SILENT_BEATS = 8
"""A process that gave no sign in so many pauses of another one is lost."""

LOST_CODE = 2
"""Exit code of a process that has lost another one: the command line's for errors."""

_LEFT = -(2**62)


class Counters(Protocol):
    """What Heartbeat needs of a store of torch.distributed's."""

    def add(self, key: str, amount: int, /) -> int:
        """Add to a counter, which begins at 0, and return it."""
        ...


class Heartbeat:
    """Ends this process, with a message, where another one gives no sign of life.

    Collectives alone may wait for a process that was stopped, or whose machine is gone, for NCCL's
    10 minutes. Time counts in this process's own pauses: one that was stopped itself blames nobody
    for that. A process that waits or computes gives signs all the same.

    Args:
        store: What all processes reach; no other thread may use the object.
        rank: Number of this process, from 0.
        count: Number of processes, R.
    """

    def __init__(self, store: Counters, rank: int, count: int) -> None:
        self._store, self._rank = store, rank
        self._signs = [0] * count
        self._ended = threading.Event()
        self._left = self._store_gone = False
        # Two, as a store that does not answer holds up whoever asks it.
        self._threads = [
            threading.Thread(target=task, daemon=True) for task in (self._beat, self._watch)
        ]
        for thread in self._threads:
            thread.start()

    def end(self, *, left: bool) -> None:
        """Watch no longer.

        Args:
            left: This process has done its part, and the others need not miss it.
        """
        self._left = left
        self._ended.set()
        for thread in self._threads:
            thread.join(BEAT_SECONDS)

    def _beat(self) -> None:
        try:
            while not self._ended.is_set():
                for other in range(len(self._signs)):
                    self._signs[other] = self._store.add(str(other), int(other == self._rank))
                self._ended.wait(BEAT_SECONDS)
            if self._left:
                self._store.add(str(self._rank), _LEFT)
        except RuntimeError:
            # From now on all seem silent that have not left.
            self._store_gone = True

    def _watch(self) -> None:
        count = len(self._signs)
        seen, silent = self._signs.copy(), [0] * count
        while not self._ended.wait(BEAT_SECONDS):
            signs = self._signs.copy()
            for other in range(count):
                alive = other == self._rank or signs[other] != seen[other] or signs[other] < 0
                silent[other] = 0 if alive else silent[other] + 1
            seen = signs
            lost = [str(other) for other in range(count) if silent[other] >= SILENT_BEATS]
            if lost:
                why = (
                    "as the store that processes meet in is gone"
                    if self._store_gone
                    else "which was killed or stopped, or cannot be reached"
                )
                print(
                    f"npa-envs: error: process {self._rank} of {count} has heard nothing from "
                    f"process {', '.join(lost)} for {SILENT_BEATS * BEAT_SECONDS:.0f} s, {why}: "
                    "the last checkpoint is intact; resume it",
                    file=sys.stderr,
                    flush=True,
                )
                # The main thread may wait in a collective for ever.
                os._exit(LOST_CODE)
