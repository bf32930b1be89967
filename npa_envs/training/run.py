"""Runs that are kept in a folder: one writer, checkpoints, and a stop in order."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from npa_envs.errors import NPAError, shown
from npa_envs.training.checkpoint import load_checkpoint, save_checkpoint
from npa_envs.training.ranks import Ranks
from npa_envs.training.run_folder import RunFolder, check_choice
from npa_envs.training.stopping import stop_flag


class Run:
    """A run of any learner; the first of the processes that share it reads and writes its files.

    Args:
        folder: Where the run is kept.
        ranks: The processes that share it.
        check: Raises NPAError where a checkpoint, given with its path, is of another run.
        resume: Go on from the checkpoint in the folder.
        overwrite: Begin anew although the folder holds a run; its files are removed.

    Raises:
        NPAError: The folder holds a run, without `resume` or `overwrite`; or none, or another one,
            with `resume`; or another process writes to it.
    """

    def __init__(
        self,
        folder: RunFolder,
        ranks: Ranks,
        check: Callable[[dict[str, Any], Path], None],
        *,
        resume: bool,
        overwrite: bool,
    ) -> None:
        self.folder = folder
        """Where the run is kept."""
        self.ranks = ranks
        """The processes that share it."""
        self.iteration = 0
        """Iterations done."""
        self._overwrite = overwrite
        content = self._opened(check, resume) if ranks.first else None
        self._content: dict[str, Any] | None = ranks.broadcast(content)

    def take_content(self) -> dict[str, Any] | None:
        """Return the checkpoint to go on from, or None, and keep it no longer."""
        content, self._content = self._content, None
        return content

    @contextlib.contextmanager
    def held(self, *, begin: bool = False) -> Iterator[None]:
        """Keep other runs out of the folder within the block; at the beginning, also tidy it."""
        with self.folder.locked() if self.ranks.first else contextlib.nullcontext():
            if begin and self.ranks.first:
                self.folder.tidy()
                if self._overwrite:
                    self.folder.clear()
            yield

    def go(
        self,
        step: Callable[[], None],
        *,
        over: Callable[[], bool],
        late: Callable[[], bool] = lambda: False,
        end: Callable[[bool], None],
    ) -> bool:
        """Repeat a step until all is done, or until SIGTERM, Ctrl-C or the clock asks to stop.

        Args:
            step: One iteration; it counts `iteration`.
            over: Whether all is done, the same on all processes.
            late: Whether the time of this process is up.
            end: Called when a signal may still come, with whether the run was asked to stop.

        Returns:
            Whether a signal came.
        """
        with stop_flag(patient=self.ranks.together) as stop:
            stopped = False
            while not stopped and not over():
                asked = stop.is_set() or late()
                stopped = self.ranks.agree_to_stop(asked, self.iteration)
                if not stopped:
                    step()
            end(stopped)
            return self.ranks.any(stop.is_set())

    def keep(self, content: dict[str, Any]) -> None:
        """Write the checkpoint; for the first process."""
        save_checkpoint(self.folder.checkpoint, content)
        self.folder.note_checkpoint()

    def _opened(
        self, check: Callable[[dict[str, Any], Path], None], resume: bool
    ) -> dict[str, Any] | None:
        check_choice(resume=resume, overwrite=self._overwrite)
        folder, path = self.folder, self.folder.checkpoint
        folder.note_checkpoint()
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
