"""Processes over devices: a queue that gives each place one process at a time.

What a process does, and what becomes of its results, is its owner's matter. Machines that share a
disk take parts of the same runs (`part_of`), each with a queue of its own.
"""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any, TypeVar

from npa_envs.errors import NPAError

LOOK_SECONDS = 0.1
"""Pause between two looks at the processes [s]."""

STOPPING = ("SIGINT", "SIGTERM", "SIGHUP")
"""Signals that stop a queue: Ctrl-C, a scheduler, a terminal that is closed."""


@dataclass(frozen=True)
class Places:
    """Where processes run."""

    devices: Sequence[str]
    """Devices, of which each process gets one."""
    jobs: int = 1
    """Processes at once; they are dealt out over the devices."""
    threads: int = 1
    """CPU threads of each."""

    def device(self, number: int) -> str:
        """Return the device of the process of a number below `jobs`."""
        return self.devices[number % len(self.devices)]

    @property
    def ahead(self) -> bool:
        """Whether the next process gets ready during a run: not on CPUs, which it would slow."""
        return not any(name.startswith("cpu") for name in self.devices)


class Child(ABC):
    """A process that learns its device once its turn has come."""

    @abstractmethod
    def go(self, device: str) -> None:
        """Let it begin on a device."""

    @property
    @abstractmethod
    def over(self) -> bool:
        """Whether it has ended by itself, in whatever way."""

    def stop(self, *, at_once: bool) -> None:  # noqa: B027 - not all have something to save
        """Ask it to end, without time to save anything if `at_once`; `end` follows and waits."""

    @abstractmethod
    def end(self) -> None:
        """End it, or wait until it has ended after `stop`, and leave nothing of it."""


SomeChild = TypeVar("SomeChild", bound=Child)


def run_children(
    start: Callable[[Sequence[SomeChild]], SomeChild | None],
    finished: Callable[[SomeChild], None],
    places: Places,
    *,
    ahead: bool,
    max_seconds: float = math.inf,
) -> None:
    """Run children until none is left; if this is interrupted, all of them are ended.

    All are asked to end before one is waited for. A second signal ends them at once. `start` gets
    those that are not over, and returns the next one, or None where none is left or can begin yet.
    With `ahead` as many children start early, which get ready and wait.
    """
    ready, running = deque[SomeChild](), dict[int, SomeChild]()
    until = time.monotonic() + max_seconds

    def next_child() -> SomeChild | None:
        late = time.monotonic() >= until
        return None if late else start([*ready, *running.values()])

    with _Interruption() as interruption:
        try:
            while True:
                interruption.check()
                while ready and time.monotonic() >= until:
                    _end([ready.pop()])
                for number in range(places.jobs):
                    one = None
                    if number not in running:
                        one = ready.popleft() if ready else next_child()
                    if one is not None:
                        running[number] = one
                        one.go(places.device(number))
                        interruption.check()
                if not running:
                    return
                while ahead and len(ready) < places.jobs and (one := next_child()) is not None:
                    ready.append(one)
                    interruption.check()
                for number, one in list(running.items()):
                    if one.over:
                        # The same signal may have ended it: then it is to be run again.
                        interruption.check()
                        del running[number]
                        finished(one)
                time.sleep(LOOK_SECONDS if running else 0.0)
        finally:
            interruption.came = True  # The next signal acts at once.
            _end([*running.values(), *ready])


def _end(children: Sequence[Child]) -> None:
    """End children: all are asked first, so that they save what they have at the same time."""
    try:
        for one in children:
            one.stop(at_once=False)
        for one in children:
            one.end()
    except BaseException:
        for one in children:
            one.stop(at_once=True)
        for one in children:
            one.end()
        raise


class _Interruption:
    """Signals within a block: the first waits for `check`, the next one acts at once.

    So the first never comes while a process is being started, which nobody would end then. Both
    raise KeyboardInterrupt. Signals that are ignored, as by nohup, stay so. In a thread other than
    the main one, where signals cannot be caught, nothing is changed.
    """

    def __init__(self) -> None:
        self.came = False
        """Whether the first has come."""
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> _Interruption:
        if threading.current_thread() is not threading.main_thread():
            return self
        for name in STOPPING:
            # Not every system has each of them.
            number = getattr(signal, name, None)
            # None: a handler that is not Python's, which could not be put back.
            if number is not None and signal.getsignal(number) not in (None, signal.SIG_IGN):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.came:
            raise KeyboardInterrupt
        self.came = True

    def check(self) -> None:
        """Raise KeyboardInterrupt where a signal has come."""
        if self.came:
            # A terminal that was closed shows nothing.
            with contextlib.suppress(OSError):
                print("\nending all runs; once more to end them at once", file=sys.stderr)
            raise KeyboardInterrupt


Item = TypeVar("Item")


def part_of(
    items: Sequence[Item], words: str | None, together: Callable[[Item], Hashable]
) -> list[Item]:
    """Return the items of one of several machines, as "2/8" says; all of them for None.

    The order of items is the same on all machines. Items for which `together` is equal belong to
    the same part.
    """
    if words is None:
        return list(items)
    number, mark, count = words.partition("/")
    if not (mark and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise NPAError(f"part must be K/N with K from 1 to N, got {words!r}: --part 2/8")
    groups = list(dict.fromkeys(map(together, items)))
    mine = set(groups[int(number) - 1 :: int(count)])
    return [item for item in items if together(item) in mine]
