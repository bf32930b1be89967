"""A queue of child processes, which run on several devices; signals end all of them.

Other children end with the process that started them (`end_with_parent`). Machines that share a
disk can divide the same runs among them (`part_of`), each with its own queue.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any, TypeVar

from npa_envs.errors import NPAError

STOPPING = ("SIGINT", "SIGTERM", "SIGHUP")
"""Names of the signals that stop a queue: of Ctrl-C, of a scheduler, of a closed terminal."""


@dataclass(frozen=True)
class Slots:
    """How many child processes run at once, and on which devices."""

    devices: Sequence[str]
    """Names of devices, such as "cuda:1"; each process runs on one."""
    jobs: int = 1
    """Number of processes at once, distributed over the devices in turn."""
    threads: int = 1
    """CPU threads of each process."""

    @property
    def starts_early(self) -> bool:
        """Whether processes start while others run: not if a device is a CPU, which they slow."""
        return not any(name.startswith("cpu") for name in self.devices)


class Child(ABC):
    """A child process that has started, and waits for its device (`begin_work`)."""

    @abstractmethod
    def begin_work(self, device: str) -> None:
        """Let the process begin its work on a device, such as "cuda:1"."""

    @property
    @abstractmethod
    def has_ended(self) -> bool:
        """Whether the process has ended, successfully or not."""

    def stop(self, *, at_once: bool) -> None:  # noqa: B027 - not all have something to save
        """Ask the process to end, without saving if `at_once`; do not wait until it has ended."""

    @abstractmethod
    def end(self) -> None:
        """End the process, or after `stop` wait until it has ended; release its resources."""


SomeChild = TypeVar("SomeChild", bound=Child)


def run_children(
    start: Callable[[Sequence[SomeChild]], SomeChild | None],
    finished: Callable[[SomeChild], None],
    slots: Slots,
    *,
    starts_early: bool = False,
    max_seconds: float = math.inf,
) -> None:
    """Run child processes until none runs and `start` returns None.

    `start` gets the children that have not ended, and returns the next one, or None if none is left
    or can start yet. `finished` gets each child that has ended. With `starts_early`, up to
    `slots.jobs` more children start and wait for a free slot. After `max_seconds` none begins its
    work. An error or a signal of `STOPPING` ends all children; a second signal ends them at once.
    """
    waiting, running = deque[SomeChild](), dict[int, SomeChild]()
    deadline = time.monotonic() + max_seconds

    def next_child() -> SomeChild | None:
        late = time.monotonic() >= deadline
        return None if late else start([*waiting, *running.values()])

    with _caught_signals() as signals:
        try:
            while True:
                _raise_if_any(signals)
                while waiting and time.monotonic() >= deadline:
                    _end([waiting.pop()])
                for slot in range(slots.jobs):
                    child = None
                    if slot not in running:
                        child = waiting.popleft() if waiting else next_child()
                    if child is not None:
                        running[slot] = child
                        child.begin_work(slots.devices[slot % len(slots.devices)])
                        _raise_if_any(signals)
                if not running:
                    return
                while starts_early and len(waiting) < slots.jobs and (child := next_child()):
                    waiting.append(child)
                    _raise_if_any(signals)
                for slot, child in list(running.items()):
                    if child.has_ended:
                        # The signal may have ended it too: then it is not finished.
                        _raise_if_any(signals)
                        del running[slot]
                        finished(child)
                time.sleep(0.1 if running else 0.0)
        finally:
            signals.append(0)  # The next signal raises at once.
            _end([*running.values(), *waiting])


def _end(children: Sequence[Child], *, at_once: bool = False) -> None:
    """Stop all children, which save in parallel, and wait until they have ended."""
    try:
        for child in children:
            child.stop(at_once=at_once)
        for child in children:
            child.end()
    except BaseException:
        if not at_once:
            _end(children, at_once=True)
        raise


@contextlib.contextmanager
def _caught_signals() -> Iterator[list[int]]:
    """Within a block, append signals of `STOPPING` to the list that is yielded.

    The second one also raises KeyboardInterrupt. The first does not, as it could interrupt the
    start of a process, which would then never end. Ignored signals, as with nohup, stay ignored. In
    threads other than the main one, where signals cannot be caught, the list stays empty.
    """
    signals: list[int] = []
    previous: dict[signal.Signals, Any] = {}

    def catch(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        if len(signals) > 1:
            raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        for name in STOPPING:
            # Some systems do not have all of them.
            number = getattr(signal, name, None)
            # None: a handler in C, which could not be restored.
            if number is not None and signal.getsignal(number) not in (None, signal.SIG_IGN):
                previous[number] = signal.signal(number, catch)
    try:
        yield signals
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _raise_if_any(signals: Sequence[int]) -> None:
    if signals:
        # Printing to a closed terminal fails.
        with contextlib.suppress(OSError):
            print("\nending all runs; once more to end them at once", file=sys.stderr)
        raise KeyboardInterrupt


Item = TypeVar("Item")


def part_of(
    items: Sequence[Item], part: str | None, group_of: Callable[[Item], Hashable]
) -> list[Item]:
    """Return part K of N parts of the items, for `part` "K/N" such as "2/8"; None: all items.

    Items of equal `group_of(item)` are in one part. All machines need the same items and order.
    """
    if part is None:
        return list(items)
    number, mark, count = part.partition("/")
    if not (mark and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise NPAError(f"part must be K/N with K from 1 to N, got {part!r}: --part 2/8")
    groups = list(dict.fromkeys(map(group_of, items)))
    mine = set(groups[int(number) - 1 :: int(count)])
    return [item for item in items if group_of(item) in mine]


PARENT_PIPE = "NPA_ENVS_PARENT_PIPE"
"""The environment variable by which a parent says that it holds the other end of the input."""

PARENT_GRACE = 10.0
"""Time in which a process saves and ends after its parent has gone [s]."""

LOST_CODE = 2
"""Exit code of a process that has lost another one, that of errors on the command line."""


def end_with_parent() -> None:
    """Let this process end soon after its parent, where `PARENT_PIPE` is in the environment.

    Such a parent starts it with a pipe as standard input, and never writes. When it closes the
    pipe or ends, also by SIGKILL, this process gets SIGTERM, on which a run saves, and is ended
    after `PARENT_GRACE`. The processes of torch's launcher inherit pipe and variable.
    """
    if PARENT_PIPE not in os.environ:
        return

    def watch() -> None:
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(PARENT_GRACE)
        os._exit(LOST_CODE)

    threading.Thread(target=watch, name="npa-envs parent", daemon=True).start()
