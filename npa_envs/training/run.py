"""Runs that are kept in a folder: one writer, checkpoints, and a stop in order."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from npa_envs.errors import NPAError, shown
from npa_envs.training.checkpoint import load_checkpoint, save_checkpoint
from npa_envs.training.ranks import Ranks
from npa_envs.training.run_folder import RunFolder, check_choice

ONE_REQUEST = 1.0
"""Time within which signals are one request to stop [s]: a scheduler may ask both a run and its
launcher, which passes it on."""

Check = Callable[[dict[str, Any], Path], None]
"""Raises NPAError where a checkpoint, given with its path, is of another run."""


class Run:
    """A run of any learner; the first of the processes that share it reads and writes its files.

    Args:
        folder: Where the run is kept; None: nowhere, and no signal stops it.
        ranks: The processes that share it.
        check: Of the checkpoint that it goes on from.
        resume: Go on from the checkpoint in the folder.
        overwrite: Begin anew although the folder holds a run; its files are removed.

    Raises:
        NPAError: The folder holds a run, without `resume` or `overwrite`; or none, or another one,
            with `resume`; or another process writes to it.
    """

    def __init__(
        self,
        folder: RunFolder | None,
        ranks: Ranks,
        check: Check,
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> None:
        self.folder = folder
        """Where the run is kept."""
        self.iteration = 0
        """Iterations done."""
        self._ranks = ranks
        self._overwrite = overwrite
        content = None
        if folder is not None and ranks.first:
            check_choice(resume=resume, overwrite=overwrite)
            content = self._opened(folder, check, resume)
        self._content: dict[str, Any] | None = ranks.broadcast(content)

    def take_content(self) -> dict[str, Any] | None:
        """Return the checkpoint to go on from, or None, and keep it no longer."""
        content, self._content = self._content, None
        return content

    @contextlib.contextmanager
    def held(self, *, begin: bool = False) -> Iterator[None]:
        """Keep other runs out of the folder within the block; at the beginning, also tidy it."""
        folder = self.folder if self._ranks.first else None
        with contextlib.nullcontext() if folder is None else folder.locked():
            if begin and folder is not None:
                folder.tidy()
                if self._overwrite:
                    folder.clear()
            yield

    def go(
        self,
        step: Callable[[], None],
        *,
        over: Callable[[], bool],
        end: Callable[[bool], None],
        begin: Callable[[], None] = lambda: None,
        late: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Repeat a step until all is done, or until SIGTERM, Ctrl-C or the clock asks to stop.

        Args:
            step: One iteration; it counts `iteration`.
            over: Whether all is done, the same on all processes.
            end: Called when a signal may still come, with whether the run was asked to stop.
            begin: Called before the first step, when a signal may come.
            late: Whether the time of this process is up.

        Returns:
            Whether a signal came.
        """
        if self.folder is None:
            begin()
            while not over():
                step()
            end(False)
            return False
        with stop_flag(patient=self._ranks.together) as stop:
            begin()
            stopped = False
            while not stopped and not over():
                asked = stop.is_set() or late()
                stopped = self._ranks.agree_to_stop(asked, self.iteration)
                if not stopped:
                    step()
            end(stopped)
            return self._ranks.any(stop.is_set())

    def keep(self, content: dict[str, Any]) -> None:
        """Write the checkpoint; for the first process."""
        assert self.folder is not None, "kept in a folder"
        save_checkpoint(self.folder.checkpoint, content)
        self.folder.note_checkpoint()

    def _opened(self, folder: RunFolder, check: Check, resume: bool) -> dict[str, Any] | None:
        folder.note_checkpoint()
        path = folder.checkpoint
        if path.exists():
            # Refused before anything is made where another run goes on there.
            with folder.locked():
                pass
        if resume:
            content = load_checkpoint(path)
            check(content, path)
            return content
        if path.exists() and not self._overwrite:
            raise NPAError(
                f"out must be a folder without a run, but {shown(str(folder.path))} holds one: "
                "resume it (--resume), choose another folder (--out), or overwrite it (--overwrite)"
            )
        return None


@contextlib.contextmanager
def stop_flag(*, patient: bool = False) -> Iterator[threading.Event]:
    """Within the block, the first SIGINT or SIGTERM sets the event; later ones act as usual.

    What comes within `ONE_REQUEST` of the first one is the same request. In a thread other than
    the main one, where signals cannot be caught, it stays unset.

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
