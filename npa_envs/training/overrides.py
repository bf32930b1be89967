"""Overrides of configurations: by plain field names, or by a file."""

from __future__ import annotations

import dataclasses
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest
from npa_envs.files import checked_path, parse_json, read_bytes
from npa_envs.tasks.train_config import TrainConfig

TaskConfigT = TypeVar("TaskConfigT")

LARGEST_FILE = 2**20
"""Bytes of a configuration file, at most."""

MERGED = 10_000
"""Fields that YAML's merge keys give a mapping, at most."""


def override(config: TrainConfig[TaskConfigT], /, **fields: Any) -> TrainConfig[TaskConfigT]:
    """Return `config` with fields changed, the run's and the task's alike, by plain name.

    Values may be as plain as a file's: a list for a tuple, a string for a path, "5e-4" for a
    number (YAML reads that as a string). `task` may be a mapping of task fields. Mappings of the
    fields of species are laid over the species that are there; further ones over the last of them.

    Args:
        config: The configuration to start from; it stays as it is.
        fields: New values by field name, for example `iterations=500, target="heart"`.

    Raises:
        NPAError: A name is unknown, or a value has the wrong type or lies outside its range.
    """
    own, task_types = _field_types(config), _field_types(config.task)
    task: Any = config.task
    changes: dict[str, Any] = {}
    task_changes: dict[str, Any] = {}
    for name, value in fields.items():
        if name == "task" and isinstance(value, Mapping):
            task_changes |= value
        elif name == "task":
            if type(value) is not type(task):
                raise NPAError(
                    f"task must be a {type(task).__name__} or a mapping of its fields, "
                    f"got {shown(value)}"
                )
            task = value
        elif name in own:
            changes[name] = _convert(name, value, own[name], getattr(config, name))
        elif name in task_types:
            task_changes[name] = value
        else:
            raise NPAError(f"unknown field {shown(name)}: {suggest(name, [*own, *task_types])}")
    return dataclasses.replace(config, task=_laid_over("task", task, task_changes), **changes)


def load_config(
    path: str | Path,
    base: TrainConfig[TaskConfigT],
    *,
    presets: Mapping[str, TrainConfig[TaskConfigT]] | None = None,
) -> TrainConfig[TaskConfigT]:
    """Return `base` with the fields that a YAML, TOML or JSON file sets.

    The file holds field names and values at its top level; fields of the task may also lie in a
    section `task`. The `config.json` that a run leaves in its folder is such a file.

    Args:
        path: A file that ends in .yaml, .yml, .toml or .json.
        base: The configuration that gives every field the file does not, for example a preset.
        presets: Those that a `preset` of the file may name to stand for `base`; None: none.

    Raises:
        NPAError: The file cannot be read, is no such file, names an unknown field, or gives a
            value of the wrong type or outside its range.
        MissingDependencyError: The file is YAML and PyYAML is not installed.
    """
    path = checked_path(path)
    try:
        text = read_bytes(path, limit=LARGEST_FILE).decode("utf-8")
    except (NPAError, UnicodeDecodeError) as error:
        raise NPAError(f"cannot read the configuration file {shown(str(path))}: {error}") from error
    fields = _parse(path, text)
    if not isinstance(fields, Mapping) or not all(isinstance(key, str) for key in fields):
        raise NPAError(
            f"the configuration file {shown(str(path))} must hold field names and values at its "
            f"top level, got {type(fields).__name__}: for example 'iterations: 500'"
        )
    own = dict(fields)
    try:
        if presets is not None and (name := own.pop("preset", None)) is not None:
            if not isinstance(name, str) or name not in presets:
                raise NPAError(f"unknown preset {name!r}: {suggest(name, presets)}")
            base = presets[name]
        return override(base, **own)
    except NPAError as error:
        raise NPAError(f"in the configuration file {shown(str(path))}: {error}") from error


def config_to_dict(config: TrainConfig[Any]) -> dict[str, Any]:
    """Return a configuration as plain numbers, strings, lists and one inner dict `task`.

    Args:
        config: The configuration; `override(base, **config_to_dict(config))` gives it back.
    """
    result = _plain(dataclasses.asdict(config))
    assert isinstance(result, dict)
    return result


def _plain(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return str(value) if isinstance(value, Path) else value


def _parse(path: Path, text: str) -> Any:
    suffix = path.suffix.lower()
    try:
        if suffix == ".toml":
            return tomllib.loads(text)
        if suffix == ".json":
            return parse_json(text)
        if suffix in (".yaml", ".yml"):
            # An empty file sets nothing.
            return _parse_yaml(text) or {}
    except MissingDependencyError:
        raise
    except Exception as error:
        # What the parsers raise for garbage depends on where in them it lands.
        raise NPAError(
            f"{shown(str(path))} is not valid {suffix[1:].upper()}: {shown(error)}"
        ) from error
    raise NPAError(
        f"a configuration file must end in .yaml, .yml, .toml or .json, got {shown(str(path))}"
    )


def _parse_yaml(text: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise MissingDependencyError(
            "reading YAML needs PyYAML: pip install pyyaml, or write the file as TOML"
        ) from error

    class Loader(yaml.SafeLoader):
        """YAML's safe loader, which merges no more than a few mappings into each other."""

        def flatten_mapping(self, node: yaml.MappingNode) -> None:
            super().flatten_mapping(node)
            if len(node.value) > MERGED:
                raise NPAError(f"a mapping must have at most {MERGED} fields with those merged in")

    return yaml.load(text, Loader)


def _field_types(config: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(type(config))
    return {field.name: hints[field.name] for field in dataclasses.fields(config)}


def _laid_over(name: str, present: Any, fields: Mapping[str, Any]) -> Any:
    """Return a dataclass, which errors call `name`, with fields changed to plain values."""
    kinds = _field_types(present)
    for field in fields:
        if field not in kinds:
            raise NPAError(
                f"unknown field '{name}.{shown(str(field))[1:-1]}': {suggest(field, kinds)}"
            )
    changes = {k: _convert(k, v, kinds[k], getattr(present, k)) for k, v in fields.items()}
    return dataclasses.replace(present, **changes)


def _convert(name: str, value: Any, kind: Any, present: Any) -> Any:
    """Return a plain value as the field's type; ranges are the dataclass's own business."""
    origin = typing.get_origin(kind)
    if origin is typing.Literal:
        return value
    if origin in (typing.Union, types.UnionType):
        inner = [option for option in typing.get_args(kind) if option is not type(None)]
        return None if value is None else _convert(name, value, inner[0], present)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise NPAError(f"{name} must be a list, got {shown(value)}: for example {name}: [1, 2]")
        item = typing.get_args(kind)[0]
        there = present if isinstance(present, tuple) and present else (None,)
        return tuple(
            _convert(f"{name}[{k}]", entry, item, there[min(k, len(there) - 1)])
            for k, entry in enumerate(value)
        )
    if dataclasses.is_dataclass(kind) and isinstance(value, Mapping):
        return _laid_over(name, present, value)
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    if kind is float and not isinstance(value, bool):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError, RuntimeError):
            pass
    elif isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
        return value
    raise NPAError(f"{name} must be of type {kind.__name__}, got {shown(value)}")
