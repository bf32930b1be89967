"""Processes over devices: a queue that gives each place one process at a time.

What a process does, and what becomes of its results, is its owner's matter. Machines that share a
disk take parts of the same runs (`part_of`), each with a queue of its own.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from npa_envs.errors import NPAError

LOOK_SECONDS = 0.1
"""Pause between two looks at the processes [s]."""


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
    """A process that is told where to run once its turn has come."""

    @abstractmethod
    def go(self, device: str) -> None:
        """Let it begin on a device."""

    @property
    @abstractmethod
    def over(self) -> bool:
        """Whether it has ended by itself, in whatever way."""

    @abstractmethod
    def end(self) -> None:
        """End it, and leave nothing of it."""


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

    Args:
        start: Returns the next child, given those that are not over; None where none is left, or
            those that are left wait for one that is not over.
        finished: Called with each that is over.
        places: Where.
        ahead: Start as many children early, which get ready and wait.
        max_seconds: None begins after so long [s].
    """
    ready, running = deque[SomeChild](), dict[int, SomeChild]()
    until = time.monotonic() + max_seconds

    def next_child() -> SomeChild | None:
        late = time.monotonic() >= until
        return None if late else start([*ready, *running.values()])

    try:
        while True:
            while ready and time.monotonic() >= until:
                ready.pop().end()
            for number in range(places.jobs):
                one = None
                if number not in running:
                    one = ready.popleft() if ready else next_child()
                if one is not None:
                    running[number] = one
                    one.go(places.device(number))
            if not running:
                return
            while ahead and len(ready) < places.jobs and (one := next_child()) is not None:
                ready.append(one)
            for number, one in list(running.items()):
                if one.over:
                    del running[number]
                    finished(one)
            time.sleep(LOOK_SECONDS if running else 0.0)
    finally:
        for one in [*running.values(), *ready]:
            one.end()


Item = TypeVar("Item")


def part_of(
    items: Sequence[Item], words: str | None, together: Callable[[Item], Hashable]
) -> list[Item]:
    """Return the items of one of several machines, as "2/8" says; all of them for None.

    Args:
        items: All of them, in the same order on all machines.
        words: Which part of how many, counted from 1.
        together: Items for which this is equal belong to the same part.

    Raises:
        NPAError: The words say no part.
    """
    if words is None:
        return list(items)
    number, mark, count = words.partition("/")
    if not (mark and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise NPAError(f"part must be K/N with K from 1 to N, got {words!r}: --part 2/8")
    groups = list(dict.fromkeys(map(together, items)))
    mine = set(groups[int(number) - 1 :: int(count)])
    return [item for item in items if together(item) in mine]
