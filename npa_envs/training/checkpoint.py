"""Checkpoints: everything a killed run needs to go on as if it had never stopped."""

from __future__ import annotations

import zipfile
from io import FileIO
from pathlib import Path
from typing import Any

import torch

from npa_envs.errors import NPAError
from npa_envs.files import atomic_path
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.overrides import config_to_dict

FORMAT = "npa-envs checkpoint"
"""Marks a file as ours."""

FORMAT_VERSION = 1
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
        torch.save({"format": FORMAT, "format_version": FORMAT_VERSION, **content}, file)
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
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise NPAError(f"{str(path)!r} is not a checkpoint of npa-envs: choose another folder")
    version = content.get("format_version")
    if version != FORMAT_VERSION:
        raise NPAError(
            f"{str(path)!r} has checkpoint format {version}, this version reads "
            f"{FORMAT_VERSION}: resume it with the version of npa-envs that wrote it"
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
