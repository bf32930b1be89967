"""Checkpoint files: written completely or not at all, and checked before a run is resumed."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from npa_envs.atomic_files import check_torch_archive, open_regular, write_bytes
from npa_envs.checks import is_real, is_whole
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.task_table import config_to_dict, override

CHECKPOINT_FORMAT = "npa-envs checkpoint"

CHECKPOINT_VERSION = 1
"""Version of the content of checkpoints; a file of another version is an error."""

MAY_DIFFER = {"out", "repeats", "tensorboard", "cuda_graph"}
MAY_DIFFER |= {"log_interval", "picture_interval", "checkpoint_interval"}
"""Configuration fields that a resumed run may change."""

READ_FIRST = {
    "task_name": str,
    "config": dict,
    "rule_hyper_parameters": dict,
    "iteration": int,
    "seconds": float,
}
"""Types, by key, of the entries that are needed before the run is built."""


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint file, completely or not at all."""
    # Torch itself would hide the reason of an error of writing, such as a full disk.
    buffer = io.BytesIO()
    header = {"format": CHECKPOINT_FORMAT, "format_version": CHECKPOINT_VERSION}
    torch.save(header | content, buffer)
    write_bytes(path, buffer.getbuffer())


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Return the content of a checkpoint file, with tensors on the CPU; no code in it is run."""
    if not os.path.exists(path):
        raise NPAError(
            f"there is no checkpoint to resume from at {str(path)!r}: give the folder of an "
            "earlier run as `out`, or start a new run"
        )
    try:
        with open_regular(path, limit=sys.maxsize, what="the checkpoint") as file:
            check_torch_archive(file)
            file.seek(0)
            content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        # Damaged data raise exceptions of many kinds.
        raise NPAError(
            f"{str(path)!r} is not a checkpoint or is damaged ({shown(error)}): "
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


def has_per_world_streams(content: Mapping[str, Any]) -> bool:
    """Return whether a checkpoint is of a run with `per_world_streams` (`RunRandomness`)."""
    states = content.get("random_states")
    return isinstance(states, dict) and states.keys() == {"schedule"}


def check_task(content: Mapping[str, Any], task_name: str, path: Path) -> None:
    """Raise NPAError unless a checkpoint is of the task `task_name`."""
    if content.get("task_name") != task_name:
        raise NPAError(
            f"the checkpoint {str(path)!r} is of task {shown(content.get('task_name'))}, "
            f"not of {task_name!r}: resume it with that task, or choose another folder"
        )


def check_same_run(
    content: dict[str, Any], path: Path, task_name: str, config: TrainConfig[Any]
) -> None:
    """Raise NPAError unless a checkpoint is of the run of this task and configuration."""
    check_entries(content, READ_FIRST, path)
    check_task(content, task_name, path)
    try:
        # Settings that the run does not have are newer than it is.
        unset = type(config)(task=type(config.task)())
        stored = content["config"]
        theirs = _flat(config_to_dict(override(unset, **stored | {"task": stored["task"]})))
    except (NPAError, TypeError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise unusable_checkpoint(path, f"config cannot be read ({shown(error)})") from error
    ours = _flat(config_to_dict(config))
    differences = [
        f"{name}: {shown(theirs.get(name, 'absent'))} there, {shown(ours.get(name, 'absent'))} here"
        for name in sorted(theirs.keys() | ours.keys())
        if name not in MAY_DIFFER and theirs.get(name) != ours.get(name)
    ]
    if differences:
        written = (path.parent / "rule.safetensors").is_file()
        start = f", with the initial rule {str(path.parent)!r}" if written else ""
        raise NPAError(
            f"the checkpoint {str(path)!r} is of another configuration ({'; '.join(differences)}): "
            f"resume with the configuration in {str(path.with_name('config.json'))!r}, or start a "
            f"new run in another folder{start}"
        )
    if content["iteration"] > config.total_iterations:
        raise NPAError(
            f"the checkpoint {str(path)!r} is at iteration {content['iteration']}, beyond the "
            f"{config.total_iterations} of this run: raise repeats"
        )


def check_entries(content: Mapping[str, Any], types: Mapping[str, type], path: Path) -> None:
    """Raise NPAError unless `content` has an entry of each type in `types`, numbers at least 0."""
    for name, cls in types.items():
        value: Any = content.get(name)
        noun, right = cls.__name__, isinstance(value, cls)
        if cls is int:
            noun, right = "whole number of at least 0", is_whole(value) and value >= 0
        elif cls is float:
            noun, right = "finite number of at least 0", is_real(value) and value >= 0
        if not right:
            raise unusable_checkpoint(path, f"{name} must be a {noun}, got {shown(value)}")


def unusable_checkpoint(path: Path, reason: str) -> NPAError:
    """Return the error for a checkpoint file that cannot be resumed, with the reason."""
    return NPAError(
        f"the checkpoint {str(path)!r} must hold all that a run needs, but {reason}: "
        "start a new run with overwrite, or put a copy of it in its place"
    )


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    run = {name: value for name, value in config.items() if name != "task"}
    return run | {f"task.{name}": value for name, value in config["task"].items()}
