"""Checkpoints: written completely or not at all, and checked before a run is resumed."""

from __future__ import annotations

import io
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
"""Configuration fields that a resumed run may change."""

NEEDED: dict[str, Any] = {
    "task_name": str,
    "config": dict,
    "iteration": int,
    "seconds": int | float,
    "rule_hyper_parameters": dict,
    "rule": dict,
    "optimiser": dict,
    "pool": dict,
    "meter": dict,
    "random_states": dict,
}
"""Entries that a run is resumed from, and their types."""

NOT_NEGATIVE = {
    *("iteration", "seconds", "replaced", "count", "step_sum", "goal", "age"),
    *("step", "exp_avg_sq"),  # AdamW's
}
"""Names of numbers and tensors in a checkpoint that must not be negative."""


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
    content: dict[str, Any], task_name: str, config: TrainConfig[Any], path: Path
) -> None:
    """Check that a checkpoint belongs to the run that is to be resumed."""
    # The entries that are needed before the run is built.
    needed = [(name, content.get(name), cls) for name, cls in NEEDED.items()]
    if isinstance(content.get("config"), dict):
        needed.append(("config.task", content["config"].get("task"), dict))
    wrong = [name for name, value, cls in needed if not isinstance(value, cls)]
    if not wrong and not _is_plain(content["config"]):
        wrong = ["config"]
    if wrong:
        raise unusable_checkpoint(path, f"{', '.join(wrong)} is missing or of a wrong type")
    check_content(content, {"iteration": 0, "seconds": 0.0}, path)
    check_task(content, task_name, path)
    theirs = _flat(content["config"])
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
    """Check that a checkpoint has the keys, types and shapes of `expected`."""
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
    """Yield a message for each difference of a value of a checkpoint from the expected `like`."""
    if isinstance(like, Mapping):
        if not isinstance(value, Mapping) or value.keys() != like.keys():
            names = ", ".join(map(str, like)) or "nothing"
            yield f"{name} must be a dict of {names}"
            return
        for key in like:
            yield from _wrong(f"{name}.{key}", value[key], like[key])
    elif isinstance(like, Tensor):
        if not isinstance(value, Tensor) or _form_of(value) != _form_of(like):
            got = f"of {_form_of(value)}" if isinstance(value, Tensor) else type(value).__name__
            yield f"{name} must be a tensor of {_form_of(like)}, got {got}"
        elif not bool(torch.isfinite(value).all()):
            yield f"{name} must be finite"
        elif name.rpartition(".")[2] in NOT_NEGATIVE and bool((value < 0).any()):
            yield f"{name} must not be negative"
    elif isinstance(like, int | float):
        right = is_whole(value) if isinstance(like, int) else is_real(value)
        if not right or value < 0:
            rule = "whole" if isinstance(like, int) else "finite"
            yield f"{name} must be a {rule} number of at least 0, got {str(value)[:40]}"


def _form_of(tensor: Tensor) -> str:
    usual = tensor.layout == torch.strided and not tensor.is_meta
    return f"{'' if usual else 'odd '}{str(tensor.dtype)[6:]} {tuple(tensor.shape)}"


def _is_plain(value: Any) -> bool:
    """Return whether a value consists of JSON's types, as configurations in checkpoints do."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(inner) for key, inner in value.items())
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | int | float)


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    own = {name: value for name, value in config.items() if name != "task"}
    return own | {f"task.{name}": value for name, value in config["task"].items()}
