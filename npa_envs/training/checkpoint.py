"""Checkpoints: written completely or not at all, and checked before a run is resumed."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npa_envs.atomic_files import check_torch_archive, open_regular, write_bytes
from npa_envs.checks import is_real, is_whole
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.task_table import config_to_dict

CHECKPOINT_FORMAT = "npa-envs checkpoint"

CHECKPOINT_VERSION = 1
"""Incremented when the content of checkpoints changes."""

MAY_DIFFER = {"out", "repeats", "tensorboard", "cuda_graph"}
MAY_DIFFER |= {"log_interval", "picture_interval", "checkpoint_interval"}
"""Configuration fields that a resumed run may change."""

READ_FIRST: dict[str, Any] = {
    "task_name": str,
    "config": dict,
    "rule_hyper_parameters": dict,
    "iteration": 0,
    "seconds": 0.0,
}
"""Entries that are needed before the run is built, as `check_content` takes them."""


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint, completely or not at all."""
    # Torch itself would hide the reason of an error of writing, such as a full disk.
    buffer = io.BytesIO()
    header = {"format": CHECKPOINT_FORMAT, "format_version": CHECKPOINT_VERSION}
    torch.save(header | content, buffer)
    write_bytes(path, buffer.getbuffer())


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint onto the CPU; no code in it is run."""
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
    """Return whether a checkpoint is of a run with random streams of each world."""
    states = content.get("random_states")
    return isinstance(states, dict) and states.keys() == {"schedule"}


def check_task(content: Mapping[str, Any], task_name: str, path: Path) -> None:
    """Check that a checkpoint is of a task."""
    if content.get("task_name") != task_name:
        raise NPAError(
            f"the checkpoint {str(path)!r} is of task {shown(content.get('task_name'))}, "
            f"not of {task_name!r}: resume it with that task, or choose another folder"
        )


def check_same_run(
    content: dict[str, Any], path: Path, task_name: str, config: TrainConfig[Any]
) -> None:
    """Check that a checkpoint belongs to the run that is to be resumed."""
    check_content(content, READ_FIRST, path)
    check_task(content, task_name, path)
    try:
        theirs = _flat(json.loads(json.dumps(content["config"])))
    except (TypeError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise unusable_checkpoint(path, f"config cannot be read ({shown(error)})") from error
    ours = _flat(config_to_dict(config))
    differences = [
        f"{name}: {shown(theirs.get(name, 'absent'))} there, {shown(ours.get(name, 'absent'))} here"
        for name in sorted(theirs.keys() | ours.keys())
        if name not in MAY_DIFFER and theirs.get(name) != ours.get(name)
    ]
    if differences:
        rule = path.parent / "rule.safetensors"
        start = f", from this rule with initial_rule={str(rule)!r}" if rule.is_file() else ""
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


def check_content(content: dict[str, Any], expected: Mapping[str, Any], path: Path) -> None:
    """Check that a checkpoint has the keys, types and shapes of `expected`.

    Numbers must be finite, those outside of tensors also not negative. `expected` may have types
    in place of values.
    """
    wrong = [
        what for name, like in expected.items() for what in _wrong(name, content.get(name), like)
    ]
    if wrong:
        shown = "; ".join(wrong[:3]) + ("; ..." if len(wrong) > 3 else "")
        raise unusable_checkpoint(path, shown)


def unusable_checkpoint(path: Path, reason: str) -> NPAError:
    """Return the error about a checkpoint that cannot be resumed."""
    return NPAError(
        f"the checkpoint {str(path)!r} must hold all that a run needs, but {reason}: "
        "start a new run with overwrite, or put a copy of it in its place"
    )


def _wrong(name: str, value: Any, like: Any) -> Iterator[str]:
    """Yield what is wrong with a checkpoint's value `name`, compared with the expected `like`."""
    if isinstance(like, type):
        if not isinstance(value, like):
            yield f"{name} must be a {like.__name__}"
    elif isinstance(like, Mapping):
        if not isinstance(value, Mapping) or value.keys() != like.keys():
            names = ", ".join(map(str, like)) or "nothing"
            yield f"{name} must be a dict of {names}"
            return
        for key in like:
            yield from _wrong(f"{name}.{key}", value[key], like[key])
    elif isinstance(like, Tensor):
        if _form_of(value) != _form_of(like):
            yield f"{name} must be a {_form_of(like)}, got a {_form_of(value)}"
        elif not bool(torch.isfinite(value).all()):
            yield f"{name} must be finite"
    elif isinstance(like, int | float):
        right = is_whole(value) if isinstance(like, int) else is_real(value)
        if not right or value < 0:
            rule = "whole" if isinstance(like, int) else "finite"
            yield f"{name} must be a {rule} number of at least 0, got {str(value)[:40]}"


def _form_of(value: Any) -> str:
    if not isinstance(value, Tensor):
        return type(value).__name__
    return f"{str(value.dtype)[6:]} tensor of shape {tuple(value.shape)}"


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    run = {name: value for name, value in config.items() if name != "task"}
    return run | {f"task.{name}": value for name, value in config["task"].items()}
