"""Files of a training run: its folder, the log, TensorBoard's events, checkpoints."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import zipfile
from io import FileIO
from pathlib import Path
from typing import Any

import torch

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.files import atomic_path, write_bytes, write_text
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.overrides import config_to_dict


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


CHECKPOINT_FORMAT = "npa-envs checkpoint"
"""Marks a file as ours."""

CHECKPOINT_VERSION = 1
"""Raised whenever what a checkpoint holds changes."""

MAY_DIFFER = frozenset(
    {
        "out",
        "repeats",
        "log_interval",
        "picture_interval",
        "checkpoint_interval",
        "tensorboard",
        "cuda_graph",
    }
)
"""Fields that a resumed run may set anew: they do not change what is learned, only how long."""

NEEDED: dict[str, tuple[type, ...]] = {
    "task_name": (str,),
    "config": (dict,),
    "iteration": (int,),
    "seconds": (int, float),
    "rule": (dict,),
    "optimiser": (dict,),
    "pool": (dict,),
    "meter": (dict,),
    "random_states": (dict,),
}
"""What a run is resumed from, and of what types it is."""

NEEDED_WITHIN = {
    "config": {"task"},
    "pool": {"x", "s"},
    "random_states": {"schedule", "worlds", "masks"},
}
"""What some of it must hold in turn."""


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all.

    Args:
        path: The file; an existing one stays as it is until the new one is complete.
        content: Tensors, numbers, strings, and lists and dicts of them.

    Raises:
        NPAError: The file cannot be written.
    """
    with atomic_path(path) as temporary, _PatientFile(temporary, "wb") as file:
        torch.save(
            {"format": CHECKPOINT_FORMAT, "format_version": CHECKPOINT_VERSION, **content}, file
        )
        if file.error is not None:
            raise file.error


class _PatientFile(FileIO):
    """A file that keeps its first error of writing, and writes no more from then on.

    Torch would raise an error of its own instead, which hides the system's reason (disk full).
    """

    error: OSError | None = None
    """What went wrong first."""

    def write(self, data: Any, /) -> int:
        """Write all of the data, unless something went wrong before."""
        rest = memoryview(data)
        try:
            while self.error is None and len(rest) > 0:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        return len(data)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint on to the CPU; nothing in it is executed.

    Raises:
        NPAError: There is no such file, it cannot be read, or it is no checkpoint of this version.
    """
    if not path.is_file():
        raise NPAError(
            f"there is no checkpoint to resume from at {str(path)!r}: give the folder of an "
            "earlier run as `out`, or start a new run"
        )
    try:
        # Torch does not look at the checksums.
        with zipfile.ZipFile(path) as archive:
            bad = archive.testzip()
        if bad is not None:
            raise zipfile.BadZipFile(f"wrong checksum of {bad!r}")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise NPAError(f"cannot read the checkpoint {str(path)!r}: {error}") from error
    except Exception as error:
        # What is raised for garbage depends on where in the readers the garbage lands.
        raise NPAError(
            f"{str(path)!r} is not a checkpoint or is damaged ({type(error).__name__}): "
            "start a new run with overwrite, or put a copy of it in its place"
        ) from error
    if not isinstance(content, dict) or content.get("format") != CHECKPOINT_FORMAT:
        raise NPAError(f"{str(path)!r} is not a checkpoint of npa-envs: choose another folder")
    version = content.get("format_version")
    if version != CHECKPOINT_VERSION:
        raise NPAError(
            f"{str(path)!r} has checkpoint format {version}, this version reads "
            f"{CHECKPOINT_VERSION}: resume it with the version of npa-envs that wrote it"
        )
    return content


def check_same_run(
    content: dict[str, Any], task_name: str, config: TrainConfig[Any], path: Path
) -> None:
    """Check that a checkpoint belongs to the run that is to be resumed.

    Raises:
        NPAError: It lacks something, is of another task, of another configuration, or further
            than the run goes.
    """
    _check_complete(content, path)
    if content["task_name"] != task_name:
        raise NPAError(
            f"the checkpoint {str(path)!r} is of task {content['task_name']!r}, "
            f"not of {task_name!r}: resume it with that task, or choose another folder"
        )
    theirs, ours = _flat(content["config"]), _flat(config_to_dict(config))
    differences = [
        f"{name}: {theirs.get(name, 'absent')!r} there, {ours.get(name, 'absent')!r} here"
        for name in sorted(theirs.keys() | ours.keys())
        if name not in MAY_DIFFER and theirs.get(name) != ours.get(name)
    ]
    if differences:
        raise NPAError(
            f"the checkpoint {str(path)!r} is of another configuration ({'; '.join(differences)}): "
            f"resume with the configuration in {str(path.with_name('config.json'))!r}, or start a "
            "new run in another folder"
        )
    if content["iteration"] > config.total_iterations:
        raise NPAError(
            f"the checkpoint {str(path)!r} is at iteration {content['iteration']}, beyond the "
            f"{config.total_iterations} of this run: raise repeats"
        )


def _check_complete(content: dict[str, Any], path: Path) -> None:
    wrong = [name for name, kinds in NEEDED.items() if not isinstance(content.get(name), kinds)]
    for outer, names in NEEDED_WITHIN.items():
        if outer not in wrong:
            wrong += [f"{outer}.{name}" for name in sorted(names - content[outer].keys())]
    if not wrong and not isinstance(content["config"]["task"], dict):
        wrong = ["config.task"]
    if wrong:
        raise NPAError(
            f"the checkpoint {str(path)!r} must hold all that a run needs to go on, but lacks "
            f"{', '.join(wrong)} or has it of a wrong type: start a new run with overwrite, or put "
            "a copy of it in its place"
        )


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    own = {name: value for name, value in config.items() if name != "task"}
    return own | {f"task.{name}": value for name, value in config["task"].items()}
