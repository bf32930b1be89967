"""Training runs in a folder: files, lock, checkpoints, log and pictures; clean stop on signals."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch.nn.functional as F
from torch import Tensor

from npa_envs.atomic_files import made_folder, read_bytes, remove_unfinished, write_text
from npa_envs.checks import is_real, is_whole
from npa_envs.errors import NPAError, shown
from npa_envs.render.colours import to_uint8
from npa_envs.render.picture_files import encode_frame, write_filmstrip
from npa_envs.training.checkpoint import load_checkpoint, save_checkpoint
from npa_envs.training.process_group import ProcessGroup

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

ONE_REQUEST = 1.0
"""Signals within this time are one request to stop [s]: a run's launcher may forward its own."""


def check_choice(*, resume: bool, overwrite: bool) -> None:
    """Raise NPAError if a run is to be both resumed and overwritten."""
    if resume and overwrite:
        raise NPAError(
            "resume and overwrite exclude each other: resume continues the run in the folder, "
            "overwrite removes it: leave one of them out"
        )


class Run:
    """A run of any learner, whose first process reads and writes the files in its folder.

    Without a folder nothing is written, and no signal stops the run. `resume` continues from the
    checkpoint, for which `check` raises NPAError if it is of another run; `overwrite` removes an
    earlier run's files. A folder that holds a run, without either, is an NPAError, and so is one
    that another process writes to.
    """

    def __init__(
        self,
        folder: RunFolder | None,
        processes: ProcessGroup,
        check: Callable[[dict[str, Any], Path], None],
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> None:
        self.folder = folder
        self.iteration = 0
        self._processes = processes
        self._overwrite = overwrite
        content = None
        if folder is not None and processes.first:
            check_choice(resume=resume, overwrite=overwrite)
            folder.note_checkpoint()
            path = folder.checkpoint
            exists = path.exists()
            if exists:
                # Raises if another run is active in the folder, before anything is created.
                with folder.locked():
                    pass
            if resume:
                content = load_checkpoint(path)
                check(content, path)
            elif exists and not overwrite:
                raise NPAError(
                    f"out must be a folder without a run, but {shown(str(folder.path))} holds one: "
                    "resume it (--resume), choose another folder (--out), or overwrite it "
                    "(--overwrite)"
                )
        self._content: dict[str, Any] | None = processes.broadcast(content)

    def take_content(self) -> dict[str, Any] | None:
        """Return a resumed run's checkpoint, and forget it, so that the caller can free it."""
        content, self._content = self._content, None
        return content

    @contextlib.contextmanager
    def locked(self, *, begin: bool = False) -> Iterator[None]:
        """Lock the folder in the block; with `begin`, remove unfinished and overwritten files."""
        folder = self.folder if self._processes.first else None
        with contextlib.nullcontext() if folder is None else folder.locked():
            if begin and folder is not None:
                folder.tidy()
                if self._overwrite:
                    folder.clear()
            yield

    def repeat(
        self,
        step: Callable[[], None],
        *,
        is_over: Callable[[], bool],
        end: Callable[[bool], None],
        begin: Callable[[], None] = lambda: None,
        time_is_up: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Repeat `step` until the run is over, or until SIGTERM, Ctrl-C or a time limit stops it.

        `step` does an iteration and increments `iteration`. `is_over` returns the same on all
        processes, `time_is_up` whether this one has reached its limit. Signals are caught from
        `begin` to `end`, which is called with whether the run was stopped. Returns whether a
        signal came.
        """
        caught, patient = self.folder is not None, self._processes.distributed
        with stop_flag(caught=caught, patient=patient) as stop:
            begin()
            stopped = False
            while not stopped and not is_over():
                stopped = self._processes.agree_to_stop(stop.is_set() or time_is_up())
                if not stopped:
                    step()
            end(stopped)
            return self._processes.any(stop.is_set())

    def write_checkpoint(self, content: dict[str, Any]) -> None:
        """Write the checkpoint; to be called on rank 0."""
        assert self.folder is not None, "the run has a folder"
        save_checkpoint(self.folder.checkpoint, content)
        self.folder.note_checkpoint()


@contextlib.contextmanager
def stop_flag(*, caught: bool = True, patient: bool = False) -> Iterator[threading.Event]:
    """Within the block, the first SIGINT or SIGTERM sets the event; later ones act as usual.

    Signals within `ONE_REQUEST` of the first one are ignored; with `patient` all later ones, as
    torchrun forwards signals that a terminal has sent already. The event stays unset without
    `caught`, and in a thread other than the main one, where signals cannot be caught.
    """
    requested = threading.Event()
    if not caught or threading.current_thread() is not threading.main_thread():
        yield requested
        return
    first = 0.0

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if not requested.is_set():
            first = time.monotonic()
            requested.set()
            if not patient:
                print("\nstopping after this iteration; once more to stop at once", file=sys.stderr)
        elif not patient and time.monotonic() - first > ONE_REQUEST:
            restore()
            signal.raise_signal(number)

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield requested
    finally:
        restore()


MAX_LOG = 2**29
"""Maximum size of a run's log [bytes]."""


class RunFolder:
    """Paths of a run's files, and the lock; `prepare` creates the folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.log = path / "log.jsonl"
        """One JSON object a line: iteration, loss terms, learning rate, steps, seconds."""
        self.checkpoint = path / "checkpoint.pt"
        self.rule = path / "rule.safetensors"
        """The rule as of the last checkpoint, for `load_rule`."""
        self.config = path / "config.json"
        self.diagnosis = path / "diverged.pt"
        """State of the first iteration whose loss was not finite."""
        self.pictures = path / "pictures"
        """Pictures of a batch, named by iteration."""
        self.report = path / "report"
        """Metrics, films and model cards of the finished rules (`npa-envs train`)."""
        self.tensorboard = path / "tensorboard"
        self.lock = path / ".lock"
        """Locked while a trainer writes to the folder; names the trainer's process and computer."""
        self._files = (self.log, self.rule, self.diagnosis, self.checkpoint, self.config)
        self._known: tuple[int, ...] | None = None

    def prepare(self, byte_count: int, *, pictures: bool = True) -> None:
        """Create the folder; NPAError without room for two checkpoints of `byte_count` bytes."""
        # The old checkpoint exists until the new one is complete.
        needed = 2 * byte_count
        try:
            with made_folder(self.pictures if pictures else self.path):
                free = shutil.disk_usage(self.path).free
                if free < needed:
                    raise NPAError(
                        f"out must have room for two checkpoints ({needed / 2**20:.0f} MiB), but "
                        f"the disk of {str(self.path)!r} has {free / 2**20:.0f} MiB free: make "
                        "room, choose another folder, or lower pool_size"
                    )
        except OSError as error:
            raise self._unwritable("created and written to", error) from error

    def _unwritable(self, what: str, error: OSError) -> NPAError:
        return NPAError(
            f"out must be a folder that can be {what}, got {str(self.path)!r} "
            f"({error.strerror or error}): choose another one or change its permissions"
        )

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against other trainers within the block.

        The system releases the lock when the process ends, in any way. Where the system or the file
        system has no locks, nothing is locked. Raises NPAError also if another trainer has written
        a checkpoint since this one's last.
        """
        try:
            lock = self.lock.open("a+", encoding="utf-8", errors="replace")
        except OSError as error:
            raise self._unwritable("written to", error) from error
        with lock:
            if fcntl is not None:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    lock.seek(0)
                    holder = lock.read(200).strip() or "another process"
                    raise NPAError(
                        f"out must be a folder that no other run writes to, but {holder} is "
                        f"training in {str(self.path)!r}: let it end, stop it (it saves on "
                        "SIGTERM), or choose another folder"
                    ) from None
                except OSError:
                    pass  # The file system has no locks.
            if self._known != file_version(self.checkpoint):
                raise NPAError(
                    "out must be a folder that no other run writes to, but another one has written "
                    f"{str(self.checkpoint)!r} meanwhile: resume it, or choose another folder"
                )
            with contextlib.suppress(OSError):  # A full disk: the text is not needed.
                lock.truncate(0)
                lock.write(f"process {os.getpid()} on {socket.gethostname()}")
                lock.flush()
            yield

    def note_checkpoint(self) -> None:
        """Remember which checkpoint file there is, so that `locked` notices another trainer's."""
        self._known = file_version(self.checkpoint)

    def tidy(self) -> None:
        """Remove temporary files that interrupted writes have left."""
        for path in (*self._files, self.rule_of("*"), self.pictures / "[0-9]*.png"):
            remove_unfinished(path)

    def clear(self) -> None:
        """Remove an earlier run's files, and no others."""
        patterns = ["rule-[0-9]*.safetensors", "pictures/[0-9]*.png", "report/*.*"]
        for pattern in (*patterns, "tensorboard/events.out.tfevents.*"):
            for path in self.path.glob(pattern):
                path.unlink()
        # The checkpoint last but one: if this is interrupted, there is either a run that can be
        # resumed or none.
        for path in self._files:
            path.unlink(missing_ok=True)

    def rule_of(self, species: int | str) -> Path:
        """Return the path of a species' rule in a run of several rules."""
        return self.path / f"rule-{species}.safetensors"


def file_version(path: Path) -> tuple[int, ...] | None:
    """Return inode, size and time of a file, which change when it is written; None if missing."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


class JsonlLog:
    """A log with one JSON object per line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._is_complete = False
        """Whether the last line is known to be complete: a kill or a full disk cuts it short."""

    def append(self, record: dict[str, Any]) -> None:
        """Write a record as a line, in place of an incomplete last line.

        The file has no buffer, so that a kill right after the call does not lose the line.
        """
        line = (json.dumps(record, allow_nan=False) + "\n").encode()
        try:
            if not self._is_complete:
                self.truncate()
            self._is_complete = False
            with self.path.open("ab", buffering=0) as file:
                while line:
                    line = line[file.write(line) :]
            self._is_complete = True
        except OSError as error:
            raise NPAError(
                f"cannot write the log {str(self.path)!r} ({error.strerror or error}): free disk "
                "space or change the permissions, then resume the run"
            ) from error

    def truncate(self, iteration: int | None = None) -> None:
        """Rewrite the log without an incomplete last line, and without lines after `iteration`."""
        write_text(self.path, "".join(json.dumps(r) + "\n" for r in self.records(iteration)))
        self._is_complete = True

    def records(self, iteration: int | None = None) -> list[dict[str, Any]]:
        """Return the records, up to an iteration if given, without an incomplete last line."""
        if not os.path.exists(self.path):
            return []
        content = read_bytes(self.path, limit=MAX_LOG, what="the log")
        lines = content.decode("utf-8", errors="replace").split("\n")
        # The part after the last newline is incomplete, or empty.
        if _parsed_record(lines[-1]) is None:
            lines.pop()
        records: list[dict[str, Any]] = []
        for number, line in enumerate(lines, start=1):
            record = _parsed_record(line)
            last = records[-1]["iteration"] if records else -1
            if record is None or record["iteration"] <= last:
                raise NPAError(
                    f"the log {str(self.path)!r} must hold one JSON object of numbers a line, with "
                    f"growing iterations, but line {number} is {line[:60]!r}: correct "
                    "that line, or move the file away to continue without it"
                )
            if iteration is not None and record["iteration"] > iteration:
                break
            records.append(record)
        return records


def _parsed_record(line: str) -> dict[str, Any] | None:
    """Return the record of a line of a log, or None if it is damaged."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or not is_whole(record.get("iteration")):
        return None
    sound = all(isinstance(value, str) or is_real(value) for value in record.values())
    return record if sound else None


PICTURE_HEIGHT = 256
"""Minimum height of the pictures [pixels]; smaller ones are enlarged."""


class RunLog(JsonlLog):
    """The log lines and pictures of a run: in its folder, and for TensorBoard while opened."""

    def __init__(self, folder: RunFolder) -> None:
        super().__init__(folder.log)
        self._folder = folder
        self._board: Any = None

    @contextlib.contextmanager
    def opened(self, tensorboard: bool, iteration: int) -> Iterator[None]:
        """Within the block, also write to TensorBoard, if `tensorboard`.

        TensorBoard hides what an earlier process wrote after `iteration`.
        """
        if tensorboard:
            # TensorBoard imports TensorFlow if it is installed; this silences it.
            os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
            from torch.utils.tensorboard import SummaryWriter

            purge_step = iteration + 1 if iteration else None
            self._board = SummaryWriter(str(self._folder.tensorboard), purge_step=purge_step)
        try:
            yield
        finally:
            if self._board is not None:
                self._board.close()
                self._board = None

    def append(self, record: dict[str, Any]) -> None:
        """Write a record with its `iteration` as a line, and while opened to TensorBoard."""
        super().append(record)
        if self._board is not None:
            for name, value in record.items():
                if name != "iteration":
                    self._board.add_scalar(name, value, record["iteration"])

    def add_picture(self, picture: Tensor, captions: list[str], iteration: int) -> None:
        """Write pictures [K, H, W, 4] in a row, as a PNG with captions, for TensorBoard a JPEG."""
        scale = math.ceil(PICTURE_HEIGHT / picture.shape[1])
        large = F.interpolate(picture.movedim(-1, 1), scale_factor=scale, mode="bilinear")
        frames = to_uint8(large.movedim(1, -1))
        path = self._folder.pictures / f"{iteration:06d}.png"
        write_filmstrip(path, frames, captions, columns=len(captions))
        if self._board is None:
            return
        frame = np.concatenate(list(frames), axis=1)
        # Imported here: only runs with TensorBoard need it.
        from tensorboard.compat.proto.summary_pb2 import Summary

        # The writer's add_image makes a PNG, whose checksum TensorBoard computes in Python, byte by
        # byte, which takes longer than all the rest.
        height, width, channels = frame.shape
        image = Summary.Image(
            height=height,
            width=width,
            colorspace=channels,
            encoded_image_string=encode_frame(frame, "JPEG"),
        )
        summary = Summary(value=[Summary.Value(tag="batch", image=image)])
        self._board.file_writer.add_summary(summary, iteration)
