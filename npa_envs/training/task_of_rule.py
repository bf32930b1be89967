"""The task that a rule was trained on, read from the rule's file."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch

from npa_envs.atomic_files import parse_json
from npa_envs.errors import NPAError, shown
from npa_envs.rule.files import rule_file, rule_metadata
from npa_envs.rule.picture_codes import Codes
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.many_pictures import named_targets
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.tasks.targets.digit_clouds import data_path
from npa_envs.tasks.targets.notes import left_out
from npa_envs.training.task_table import override, preset, task_entry


@dataclass(frozen=True)
class TrainedTask:
    """The task that a rule was trained on, and whether a built-in target replaces its own."""

    task: Task
    why_not_measurable: str | None
    """Why comparisons with the target are meaningless; None where they are meaningful."""
    task_name: str


def task_of_rule(
    source: str,
    rule: NPARule,
    device: torch.device,
    *,
    particle_count: int | None = None,
    for_page: bool = False,
    **fields: Any,
) -> TrainedTask:
    """Return the task that a rule was trained on, read from its file.

    A rule whose file names no task, as those of the paper's authors, is run in the paper's world of
    2D morphogenesis with the rule's own sizes; a file of `npa-envs search` names the world that it
    was found in. A rule with codes for many pictures has the task of the picture `target`, else of
    the first one. Where the target is unknown or its picture is missing, a built-in target replaces
    it, and scikit-learn's digits a missing data set, so that worlds can still be run and drawn.

    Args:
        source: The name or file that the rule was loaded from.
        rule: The rule.
        device: Device of the task's target.
        particle_count: Particles N; None: as trained.
        for_page: Whether an exported page runs it; missing data are then named without a cure.
        fields: Fields of the task's configuration to change; None: unchanged.

    Raises:
        NPAError: The rule does not fit the task, or a field is wrong.
    """
    path, metadata = _file_of(source)
    task_name = metadata.get("task", "morphogenesis2d")
    entry = task_entry(task_name)
    if rule.space_dim != entry.space_dim or rule.static != entry.static:
        raise NPAError(
            f"the command line runs {'static' if entry.static else 'moving'} rules in the "
            f"{entry.space_dim}D worlds of {task_name}, got space_dim={rule.space_dim}, "
            f"static={rule.static}: run this one in Python with npa_envs.rollout"
        )
    known = "config" in metadata
    if known:
        config = trained_config(path, metadata)
    else:
        sizes = {"state_dim": rule.state_dim - rule.code_dim, "hidden_dim": rule.hidden_dim}
        physics = {"eps": rule.eps0} | ({} if rule.static else {"alpha": rule.alpha})
        config = preset("paper", task_name, **sizes, **physics)
        config = override(config, **_world_of(path, metadata))
    config = override(config, **{k: v for k, v in fields.items() if v is not None})
    if particle_count is not None:
        config = override(config, task=config.task.with_particle_count(particle_count))
    chosen = any(fields.get(name) is not None for name in ("target", "data", "data_folder"))
    if rule.codes is not None:
        # The chosen picture or the first one, from its source.
        name = rule.codes.names[0] if fields.get("target") is None else config.task.target
        named = _named(config.task.targets).get(name, name)
        config = override(config, targets=(), target=named)
    why_not_measurable = None if known or chosen else "its file does not say what it grows"
    try:
        _check_data(config.task)
        task = entry.make(config.task, device).held_out().for_rule(rule)
    except NPAError as error:
        clouds = getattr(config.task, "class_count", 0) >= 10  # as scikit-learn's digits
        name, known_names = ("data", ("digits",)) if clouds else ("target", entry.targets())
        if chosen or not known_names:
            raise
        if clouds:
            page = "its page shows scikit-learn's digits", "its data set is not on this computer"
            what, why = page if for_page else ("scikit-learn's digits instead", str(error))
            left_out(source, why, what=what)
        why_not_measurable = f"its {name} cannot be loaded: {error}"
        config = override(config, **{name: known_names[0]})
        task = entry.make(config.task, device).held_out()
        if rule.codes is not None:
            target = replace(cast(Morphogenesis2D, task).target, name=rule.codes.names[0])
            task = Morphogenesis2D(config.task, target=target, device=device)
        task = task.for_rule(rule)
    return TrainedTask(task, why_not_measurable, task_name)


def _check_data(config: Any) -> None:
    """Raise NPAError if the data set of a task's configuration is not there."""
    if getattr(config, "data", "digits") != "digits":
        data_path(config.data, config.data_folder)


def has_data(source: str) -> bool:
    """Return whether the data set that a rule was trained on is there; True for other tasks."""
    path, metadata = _file_of(source)
    with contextlib.suppress(NPAError):
        _check_data(trained_config(path, metadata).task if "config" in metadata else None)
        return True
    return False


def trained_task_name(source: str) -> str:
    """Return the name of the task that a rule, named as for `load_rule`, was trained on."""
    return _file_of(source)[1].get("task", "morphogenesis2d")


def _file_of(source: str) -> tuple[Path, Mapping[str, str]]:
    path = rule_file(source)
    return path, rule_metadata(path) if path.suffix == ".safetensors" else {}


def task_for_film(
    task: Task,
    source: str,
    rule: NPARule,
    device: torch.device,
    *,
    least: int,
    resolution: int | None = None,
    points: bool = False,
    **world: Any,
) -> Task:
    """Return a rule's task with pictures that are large enough for a film.

    The default resolution is that of training, at least `least` [pixels]. `points` draws particles
    as small separate points. `world` has further options of `task_of_rule`.
    """
    fields = dict(world)
    target = getattr(task, "target_picture", None)
    side = task.config.resolution if target is None else len(target)
    if resolution is not None or side < least:
        fields["resolution"] = least if resolution is None else resolution
    if points:
        sigma = getattr(task.config, "sigma", None)
        if sigma is None:
            raise NPAError("style must be 'splats' for clouds that never move, got 'points'")
        fields["sigma"] = 0.35 * sigma
    return task if fields == world else task_of_rule(source, rule, device, **fields).task


def tasks_of_codes(
    source: str, rule: NPARule, device: torch.device, **fields: Any
) -> list[Morphogenesis2D]:
    """Return the task of each picture that a rule has a code for, in order."""
    names = () if rule.codes is None else rule.codes.names
    return [
        cast(Morphogenesis2D, task_of_rule(source, rule, device, **fields | {"target": name}).task)
        for name in names
    ]


def _world_of(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Return the task's fields that `npa-envs search` stored in a rule file; {} without any."""
    fields = None
    with contextlib.suppress(NPAError):
        fields = parse_json(metadata.get("world", "{}"))
    if not isinstance(fields, dict):
        raise NPAError(
            f"the metadata's world of {str(path)!r} must be a JSON object, got "
            f"{shown(metadata['world'])}: save the rule again with npa_envs.save_rule"
        )
    if "particle_count" in fields:
        fields["target_point_count"] = fields["particle_count"]
    return fields


def targets_of_codes(source: str, codes: Codes) -> dict[str, str]:
    """Return, by the name of each code, what `load_target` loads its picture from.

    source: The name or file that the rule of these codes was loaded from.
    """
    path, metadata = _file_of(source)
    targets = trained_config(path, metadata).task.targets if "config" in metadata else ()
    named = _named(targets)
    return {name: named.get(name, name) for name in codes.names}


def _named(targets: Sequence[str]) -> dict[str, str]:
    # A folder may be gone.
    try:
        return named_targets(targets)
    except NPAError:
        return {}


def trained_config(path: Path, metadata: Mapping[str, str]) -> Any:
    """Return the configuration that a rule was trained with, from its file's metadata."""
    try:
        fields = parse_json(metadata["config"])
        if not isinstance(fields, dict):
            raise NPAError(f"config must be an object, got {type(fields).__name__}")
        base = preset("paper", metadata.get("task", "morphogenesis2d"))
        return override(base, **fields)
    except (ValueError, TypeError) as error:
        raise NPAError(
            f"the metadata of {str(path)!r} must have the rule's configuration, but it is damaged "
            f"or of another version ({error}): save the rule again with npa_envs.save_rule"
        ) from error
