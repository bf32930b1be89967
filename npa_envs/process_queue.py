"""A queue of child processes over devices, each of which runs one process at a time.

Machines that share a disk can divide the same runs among them (`part_of`), each with its own queue.
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

POLL_SECONDS = 0.1
"""Time between two polls of the processes [s]."""

STOPPING = ("SIGINT", "SIGTERM", "SIGHUP")
"""Signals that stop a queue: from Ctrl-C, a scheduler, a closed terminal."""


@dataclass(frozen=True)
class Slots:
    """The slots in which processes run."""

    devices: Sequence[str]
    """Devices; each process gets one."""
    jobs: int = 1
    """Number of processes at once, distributed over the devices in turn."""
    threads: int = 1
    """CPU threads of each process."""

    @property
    def ahead(self) -> bool:
        """Whether the next process starts early, during a run: not on CPUs, which it would slow."""
        return not any(name.startswith("cpu") for name in self.devices)


class Child(ABC):
    """A child process, which gets its device when its turn comes."""

    @abstractmethod
    def go(self, device: str) -> None:
        """Start its work on a device."""

    @property
    @abstractmethod
    def over(self) -> bool:
        """Whether the process has ended, successfully or not."""

    def stop(self, *, at_once: bool) -> None:  # noqa: B027 - not all have something to save
        """Ask the process to end, without saving if `at_once`; does not wait (`end` does)."""

    @abstractmethod
    def end(self) -> None:
        """End the process, or wait for it after `stop`, and release its resources."""


SomeChild = TypeVar("SomeChild", bound=Child)


def run_children(
    start: Callable[[Sequence[SomeChild]], SomeChild | None],
    finished: Callable[[SomeChild], None],
    slots: Slots,
    *,
    ahead: bool,
    max_seconds: float = math.inf,
) -> None:
    """Run child processes until none is left; an interruption ends all of them.

    All are asked to end before the first is waited for; a second signal ends them at once. `start`
    gets the children that are not over, and returns the next one, or None if none is left or can
    begin yet. With `ahead`, up to `slots.jobs` more children start early and wait for their turn.
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
                for number in range(slots.jobs):
                    one = None
                    if number not in running:
                        one = ready.popleft() if ready else next_child()
                    if one is not None:
                        running[number] = one
                        one.go(slots.devices[number % len(slots.devices)])
                        interruption.check()
                if not running:
                    return
                while ahead and len(ready) < slots.jobs and (one := next_child()) is not None:
                    ready.append(one)
                    interruption.check()
                for number, one in list(running.items()):
                    if one.over:
                        # The signal may have ended it too: then it is not finished.
                        interruption.check()
                        del running[number]
                        finished(one)
                time.sleep(POLL_SECONDS if running else 0.0)
        finally:
            interruption.came = True  # The next signal raises at once.
            _end([*running.values(), *ready])


def _end(children: Sequence[Child]) -> None:
    """End children: all are asked first, so that they save their work at the same time."""
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
    """Signals within a block: the first raises KeyboardInterrupt in `check`, the next one at once.

    So the first cannot interrupt the start of a process, which would then never be ended. Ignored
    signals, as with nohup, stay ignored. In threads other than the main one, where signals cannot
    be caught, nothing changes.
    """

    def __init__(self) -> None:
        self.came = False
        """Whether the first signal has come."""
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> _Interruption:
        if threading.current_thread() is not threading.main_thread():
            return self
        for name in STOPPING:
            # Some systems do not have all of them.
            number = getattr(signal, name, None)
            # None: a handler in C, which could not be restored.
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
        """Raise KeyboardInterrupt if a signal has come."""
        if self.came:
            # Printing to a closed terminal fails.
            with contextlib.suppress(OSError):
                print("\nending all runs; once more to end them at once", file=sys.stderr)
            raise KeyboardInterrupt


Item = TypeVar("Item")


def part_of(
    items: Sequence[Item], part: str | None, together: Callable[[Item], Hashable]
) -> list[Item]:
    """Return part K of N of the items, for `part` "K/N" such as "2/8"; None: all of them.

    Items must be in the same order on all machines. Items with equal `together` are in one part.
    """
    if part is None:
        return list(items)
    number, mark, count = part.partition("/")
    if not (mark and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise NPAError(f"part must be K/N with K from 1 to N, got {part!r}: --part 2/8")
    groups = list(dict.fromkeys(map(together, items)))
    mine = set(groups[int(number) - 1 :: int(count)])
    return [item for item in items if together(item) in mine]
