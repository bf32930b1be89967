"""The folder of a run: what lies where, and whether it can be written at all."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.files import write_bytes, write_text


class RunFolder:
    """Paths of a run's files.

    Args:
        path: The folder; `prepare` creates it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        """The folder itself."""
        self.log = path / "log.jsonl"
        """One JSON object a line: iteration, loss terms, learning rate, steps, seconds."""
        self.checkpoint = path / "checkpoint.pt"
        """Everything a killed run needs to go on."""
        self.rule = path / "rule.safetensors"
        """The rule as of the last checkpoint, for `load_rule`."""
        self.config = path / "config.json"
        """The configuration, for `load_config`."""
        self.diagnosis = path / "diverged.pt"
        """What the first iteration with a loss that is not finite saw."""
        self.pictures = path / "pictures"
        """Pictures of a batch, named by iteration."""
        self.tensorboard = path / "tensorboard"
        """TensorBoard's events."""

    def prepare(self, byte_count: int) -> None:
        """Create the folder and see that a checkpoint can be written there.

        Args:
            byte_count: About how large a checkpoint is [bytes].

        Raises:
            NPAError: The folder cannot be created or written to, or its disk has too little room.
        """
        try:
            self.pictures.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(self.path).free
        except OSError as error:
            raise NPAError(
                f"out must be a folder that can be created and written to, got {str(self.path)!r} "
                f"({error.strerror or error}): choose another one or mend its permissions"
            ) from error
        # A new checkpoint is written beside the old one.
        needed = 2 * byte_count
        if free < needed:
            raise NPAError(
                f"out must have room for two checkpoints ({needed / 2**20:.0f} MiB), but the disk "
                f"of {str(self.path)!r} has {free / 2**20:.0f} MiB free: make room, choose another "
                "folder, or lower pool_size"
            )
        probe = self.path / ".probe"
        write_bytes(probe, b"probe")
        probe.unlink()

    def clear(self) -> None:
        """Remove an earlier run's files, and nothing else that may lie in the folder."""
        for path in (self.checkpoint, self.rule, self.log, self.config, self.diagnosis):
            path.unlink(missing_ok=True)
        patterns = (
            "rule-[0-9]*.safetensors",
            "pictures/[0-9]*.png",
            "tensorboard/events.out.tfevents.*",
        )
        for pattern in patterns:
            for path in self.path.glob(pattern):
                path.unlink()

    def rule_of(self, species: int) -> Path:
        """Return the path of the rule of a species, of a run that trains several together."""
        return self.path / f"rule-{species}.safetensors"

    def picture(self, iteration: int) -> Path:
        """Return the path of the picture of an iteration."""
        return self.pictures / f"{iteration:06d}.png"


class JsonlLog:
    """A log of one JSON object a line.

    Args:
        path: The file; lines are appended.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, record: dict[str, Any]) -> None:
        """Add a line and hand it to the system, so that a kill right after it does not lose it.

        If that fails, the file is cut back to what it held before.

        Args:
            record: Numbers and strings; all of them finite.

        Raises:
            NPAError: The file cannot be written.
        """
        line = (json.dumps(record, allow_nan=False) + "\n").encode()
        try:
            # Without a buffer: one would be written again when the file closes.
            with self.path.open("ab", buffering=0) as file:
                size = file.tell()
                try:
                    while line:
                        line = line[file.write(line) :]
                except OSError:
                    with contextlib.suppress(OSError):
                        file.truncate(size)
                    raise
        except OSError as error:
            raise NPAError(
                f"cannot write the log {str(self.path)!r} ({error.strerror or error}): free disk "
                "space or mend the permissions, then resume the run"
            ) from error

    def truncate(self, iteration: int) -> None:
        """Drop the lines after an iteration, and a last line that a kill cut short.

        Args:
            iteration: The checkpoint's: lines up to it stay.

        Raises:
            NPAError: The file cannot be read or written.
        """
        write_text(self.path, "".join(json.dumps(r) + "\n" for r in self.records(iteration)))

    def records(self, iteration: int | None = None) -> list[dict[str, Any]]:
        """Return the lines read back, up to an iteration if one is given.

        Raises:
            NPAError: The file cannot be read.
        """
        if not self.path.exists():
            return []
        try:
            lines = self.path.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError as error:
            raise NPAError(f"cannot read the log {str(self.path)!r}: {error}") from error
        records: list[dict[str, Any]] = []
        for line in lines:
            try:
                record = json.loads(line)
            except json.JSONDecodeError:
                break
            if not isinstance(record, dict) or "iteration" not in record:
                break
            if iteration is not None and record["iteration"] > iteration:
                break
            records.append(record)
        return records


def open_tensorboard(folder: RunFolder, iteration: int) -> Any:
    """Return a TensorBoard writer that hides what an earlier process wrote after `iteration`.

    Raises:
        MissingDependencyError: TensorBoard is not installed.
        NPAError: Its folder cannot be written to.
    """
    # TensorBoard would look for TensorFlow, which takes seconds where it is installed.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise MissingDependencyError(
            "tensorboard=True needs TensorBoard: pip install tensorboard, "
            "or train with tensorboard=False (the JSONL log has the same numbers)"
        ) from error
    try:
        return SummaryWriter(
            str(folder.tensorboard), purge_step=iteration + 1 if iteration else None
        )
    except OSError as error:
        raise NPAError(
            f"cannot write to {str(folder.tensorboard)!r} ({error}): mend its permissions or "
            "train with tensorboard=False"
        ) from error
