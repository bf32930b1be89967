"""The table of tasks that can be trained, their presets, and overrides of configurations."""

from __future__ import annotations

import dataclasses
import json
import tomllib
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

from npa_envs.atomic_files import checked_path, parse_json, read_bytes
from npa_envs.errors import NPAError, check_known, shown, suggest
from npa_envs.tasks.base import Task
from npa_envs.tasks.co_morphogenesis2d import CO_MORPHOGENESIS2D_PRESETS, CoMorphogenesis2D
from npa_envs.tasks.many_pictures import ManyPictures
from npa_envs.tasks.morphogenesis2d import MORPHOGENESIS2D_PRESETS, Morphogenesis2D
from npa_envs.tasks.morphogenesis3d import MORPHOGENESIS3D_PRESETS, Morphogenesis3D
from npa_envs.tasks.point_classification import POINT_CLASSIFICATION_PRESETS, PointClassification
from npa_envs.tasks.targets.meshes import builtin_meshes
from npa_envs.tasks.targets.picture_points import builtin_targets
from npa_envs.tasks.targets.textures import builtin_textures
from npa_envs.tasks.texture import TEXTURE_PRESETS, Texture
from npa_envs.tasks.train_config import TrainConfig

TaskConfigT = TypeVar("TaskConfigT")


@dataclass(frozen=True)
class TaskEntry:
    """A task that can be trained."""

    summary: str
    """One line for lists."""
    presets: Mapping[str, TrainConfig[Any]]
    """Configurations by name: `paper`, `fast`, `tiny`; `best`, `detail` where a recipe was searched."""
    make: Callable[[Any, torch.device], Task]
    """Returns the task of a configuration, on a device."""
    targets: Callable[[], tuple[str, ...]]
    """Returns the names of its built-in targets; none where the task has no field `target`."""
    examples: tuple[str, ...]
    """Options of `npa-envs train` that the help of the task shows."""
    fast_seconds: float
    """Duration of the preset `fast` on one thread of a CPU [s]."""
    paired_time: float = 0.8
    """Duration with two processes as a fraction of that with one, for small batches."""
    space_dim: int = 2
    """Space dimension D of its worlds."""
    static: bool = False
    """Whether particles never move."""

    def expected_seconds(self, config: TrainConfig[Any]) -> float | None:
        """Return the estimated duration of a run on a CPU [s], from its number of particle-steps.

        None on other devices, where particle-steps predict little.
        """
        if config.device != "cpu":
            return None
        ours, fast = (
            run.total_iterations
            * run.world_count
            * sum(run.steps)
            * sum(task.particle_count for task in getattr(run.task, "species", (run.task,)))
            for run in (config, self.presets["fast"])
        )
        seconds: float = self.fast_seconds * ours / fast
        return seconds


TASKS: Mapping[str, TaskEntry] = {
    "morphogenesis2d": TaskEntry(
        summary="grow a picture from a disk of particles with zero states",
        presets=MORPHOGENESIS2D_PRESETS,
        make=lambda config, device: (ManyPictures if config.targets else Morphogenesis2D)(
            config, device=device
        ),
        targets=builtin_targets,
        examples=(
            "--target heart --out runs/heart",
            "--preset paper --target lizard.png --device cuda",
            "--preset paper --target lizard.png --gpus 4",
        ),
        fast_seconds=220.0,
    ),
    "co_morphogenesis2d": TaskEntry(
        summary="grow pictures in one world, each by its own rule",
        presets=CO_MORPHOGENESIS2D_PRESETS,
        # Its rules are filmed and evaluated one by one, as rules of morphogenesis2d.
        make=lambda config, device: CoMorphogenesis2D(config, device=device),
        targets=tuple,
        examples=("--targets ring heart", "--preset paper --targets gecko heart --device cuda"),
        fast_seconds=340.0,
    ),
    "morphogenesis3d": TaskEntry(
        summary="grow a 3D object from a ball of particles with zero states",
        presets=MORPHOGENESIS3D_PRESETS,
        make=lambda config, device: Morphogenesis3D(config, device=device),
        targets=builtin_meshes,
        examples=(
            "--target duck --out runs/duck",
            "--preset paper --target statue.obj --device cuda",
        ),
        fast_seconds=290.0,
        space_dim=3,
    ),
    "texture": TaskEntry(
        summary="arrange particles all over a periodic box to a texture",
        presets=TEXTURE_PRESETS,
        make=lambda config, device: Texture(config, device=device),
        targets=builtin_textures,
        examples=("--target dots --out runs/dots", "--target wall.png --loss patch_ot"),
        fast_seconds=285.0,
        # Each world's loss is most of the work.
        paired_time=0.55,
    ),
    "point_classification": TaskEntry(
        summary="static particles agree on which digit they form",
        presets=POINT_CLASSIFICATION_PRESETS,
        make=lambda config, device: PointClassification(config, device=device),
        targets=tuple,
        examples=("--out runs/digits", "--preset paper --data mnist --device cuda"),
        fast_seconds=200.0,
        static=True,
    ),
}
"""Every task that can be trained, by its name on the command line and in checkpoints."""


def task_entry(task_name: str) -> TaskEntry:
    """Return the entry of a task in `TASKS`; raises NPAError if there is no such task."""
    check_known("unknown task", task_name, TASKS)
    return TASKS[task_name]


def preset(name: str, task_name: str = "morphogenesis2d", /, **fields: Any) -> TrainConfig[Any]:
    """Return a preset with fields replaced by name.

    Args:
        name: `paper`, `fast`, `tiny`, or `best` and `detail` where the task has them.
        task_name: The task it is for.
        fields: New values by field name, of the run or of the task.

    Raises:
        NPAError: The task, the preset or a field is unknown, or a value is not allowed.
    """
    presets = task_entry(task_name).presets
    check_known("unknown preset", name, presets, f" of {task_name}")
    return override(presets[name], **fields)


MAX_FILE = 2**20
"""Maximum size of a configuration file [bytes]."""

MERGED = 10_000
"""Maximum number of fields of a YAML mapping, with those that merge keys add."""


def override(config: TrainConfig[TaskConfigT], /, **fields: Any) -> TrainConfig[TaskConfigT]:
    """Return `config` with fields of the run or of the task replaced, by name.

    Values may be as in files: a list for a tuple, a string for a path, "5e-4" for a number (YAML
    reads that as a string). `task` may be a mapping of task fields. `species` may be a list of
    mappings, which override the fields of the existing species; additional ones start from the
    last.

    Args:
        config: The configuration to start from; it is not changed.
        fields: New values by field name, for example `iterations=500, target="heart"`.

    Raises:
        NPAError: A name is unknown, or a value has the wrong type or lies outside its range.
    """
    run_types, task_types = _field_types(config), _field_types(config.task)
    known = [*run_types, *task_types]
    for name in fields:
        check_known("unknown field", name, known)
    run_fields = {name: value for name, value in fields.items() if name in run_types}
    task_fields = {name: value for name, value in fields.items() if name not in run_types}
    task: Any = run_fields.pop("task", config.task)
    if isinstance(task, Mapping):
        task, task_fields = config.task, {**task, **task_fields}
    elif type(task) is not type(config.task):
        raise NPAError(
            f"task must be a {type(config.task).__name__} or a mapping of its fields, "
            f"got {shown(task)}"
        )
    config = dataclasses.replace(config, task=_replaced("task", task, task_fields))
    result: TrainConfig[TaskConfigT] = _replaced("config", config, run_fields)
    return result


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
        base: The configuration of all fields that the file does not set, for example a preset.
        presets: Presets by name, which the file's field `preset` may choose as base; None: none.

    Raises:
        NPAError: The file cannot be read, is no such file, names an unknown field, or gives a
            value of the wrong type or outside its range.
    """
    path = checked_path(path)
    try:
        text = read_bytes(path, limit=MAX_FILE, what="it").decode("utf-8")
    except (NPAError, UnicodeDecodeError) as error:
        raise NPAError(f"cannot read the configuration file {shown(str(path))}: {error}") from error
    parse = PARSERS.get(path.suffix.lower())
    if parse is None:
        raise NPAError(
            f"a configuration file must end in {', '.join(PARSERS)}, got {shown(str(path))}: "
            "write a line such as 'iterations: 500' to run.yaml"
        )
    try:
        fields = parse(text)
    except Exception as error:
        # Parsers raise exceptions of many kinds.
        raise NPAError(f"{shown(str(path))} cannot be parsed: {shown(error)}") from error
    if not isinstance(fields, Mapping) or not all(isinstance(key, str) for key in fields):
        raise NPAError(
            f"the configuration file {shown(str(path))} must hold field names and values at its "
            f"top level, got {type(fields).__name__}: for example 'iterations: 500'"
        )
    fields = dict(fields)
    try:
        if presets is not None and (name := fields.pop("preset", None)) is not None:
            check_known("unknown preset", name, presets)
            base = presets[name]
        return override(base, **fields)
    except NPAError as error:
        raise NPAError(f"in the configuration file {shown(str(path))}: {error}") from error


def config_to_dict(config: TrainConfig[Any]) -> dict[str, Any]:
    """Return a configuration as numbers, strings, lists and an inner dict `task`, as JSON has them.

    `override(base, **config_to_dict(config))` restores it.
    """
    result: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    return result


def _parse_yaml(text: str) -> Any:
    # Imported here: most runs do not need it.
    import yaml

    class Loader(yaml.SafeLoader):
        """YAML's safe loader with a limit on merged mappings."""

        def flatten_mapping(self, node: yaml.MappingNode) -> None:
            super().flatten_mapping(node)
            if len(node.value) > MERGED:
                raise NPAError(f"a mapping must have at most {MERGED} fields with those merged in")

    # An empty file sets nothing.
    return yaml.load(text, Loader) or {}


PARSERS: Mapping[str, Callable[[str], Any]] = {
    ".yaml": _parse_yaml,
    ".yml": _parse_yaml,
    ".toml": tomllib.loads,
    ".json": parse_json,
}
"""Parsers of configuration files by suffix."""


def _field_types(config: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(type(config))
    return {field.name: hints[field.name] for field in dataclasses.fields(config)}


def _replaced(name: str, present: Any, fields: Mapping[str, Any]) -> Any:
    """Return the dataclass `present`, called `name` in errors, with fields replaced."""
    field_types = _field_types(present)
    for field in fields:
        if field not in field_types:
            raise NPAError(
                f"unknown field '{name}.{shown(str(field))[1:-1]}': {suggest(field, field_types)}"
            )
    changes = {k: _convert(k, v, field_types[k], getattr(present, k)) for k, v in fields.items()}
    return dataclasses.replace(present, **changes)


def _convert(name: str, value: Any, cls: Any, present: Any) -> Any:
    """Return a file's value as a field's type `cls`; `present` is the field's current value."""
    origin = typing.get_origin(cls)
    if origin is typing.Literal:
        return value
    if origin in (typing.Union, types.UnionType):
        inner = [option for option in typing.get_args(cls) if option is not type(None)]
        return None if value is None else _convert(name, value, inner[0], present)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise NPAError(f"{name} must be a list, got {shown(value)}: for example {name}: [1, 2]")
        item = typing.get_args(cls)[0]
        before = present if isinstance(present, tuple) and present else (None,)
        return tuple(
            _convert(f"{name}[{k}]", entry, item, before[min(k, len(before) - 1)])
            for k, entry in enumerate(value)
        )
    if dataclasses.is_dataclass(cls) and isinstance(value, Mapping):
        return _replaced(name, present, value)
    if cls is Path and isinstance(value, str | Path):
        return Path(value)
    if cls is float and not isinstance(value, bool):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError, RuntimeError):
            pass
    elif isinstance(value, cls) and (cls is bool or not isinstance(value, bool)):
        return value
    raise NPAError(f"{name} must be of type {cls.__name__}, got {shown(value)}")
