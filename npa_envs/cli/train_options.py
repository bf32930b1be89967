"""Options of `npa-envs train TASK`, and the configuration that they give."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.tasks.train_config import COMMON, Common
from npa_envs.training import (
    JointTrainConfig,
    RunFolder,
    TrainConfig,
    config_to_dict,
    load_config,
    preset,
    task_entry,
)
from npa_envs.training.checkpoint import check_task, load_checkpoint


@dataclass(frozen=True, kw_only=True)
class TrainOptions(common.SharedRunOptions):
    """How a run starts and ends."""

    preset: str = ""
    """Configuration to start from: `paper`, `fast` (minutes on a CPU), `tiny` (seconds), or for
    pictures and textures `best` (minutes on a GPU); `npa-envs list` prints sizes and times. By
    default `best` on CUDA if the task has it, else `fast`."""
    config: Path | None = None
    """YAML, TOML or JSON file of fields and values, also `preset`; overrides the preset."""
    max_seconds: float = math.inf
    """Stop after this time [s]; the run can be resumed."""
    progress: bool = True
    """Show a progress bar."""
    report: bool = True
    """End with a report in the folder `out`: metrics, a film and a model card of the rule."""


def parse_run(task_name: str, arguments: Sequence[str]) -> tuple[TrainOptions, TrainConfig[Any]]:
    """Parse arguments to the options of the run and its training configuration.

    Ends the process after `--help`, which shows the most used options, and `--help-all`.
    """
    return _parse_over(starting_configuration(task_name, arguments), task_name, arguments)


def _parse_over(base: Any, task_name: str, arguments: Sequence[str]) -> tuple[TrainOptions, Any]:
    """Return the options of the run, and `base` with the values of the options that are given."""
    parse = _parse_joint if isinstance(base, JointTrainConfig) else _parse_fields
    return parse(base, task_name, arguments)


def default_preset(task_name: str, device: str) -> str:
    """Return the default preset: `best` on CUDA if the task has it, else `fast`."""
    cuda = device.startswith("cuda")
    return "best" if cuda and "best" in task_entry(task_name).presets else "fast"


def starting_configuration(task_name: str, arguments: Sequence[str]) -> TrainConfig[Any]:
    """Return the configuration of the preset, file or resumed run, before options change it."""
    first = common.first_options(arguments)
    device = first.device if first.device and first.config is None else "cpu"
    base = preset(first.preset or default_preset(task_name, device), task_name)
    if first.resume and not {"-h", "--help", "--help-all"} & set(arguments):
        folder = RunFolder(first.out or base.out)
        if not folder.checkpoint.is_file():
            raise NPAError(
                f"there is no checkpoint to resume from at {str(folder.checkpoint)!r}: give the "
                "folder of an earlier run with --out, or leave --resume out to start a new run"
            )
        try:
            base = load_config(folder.config, base)
        except NPAError:
            # The run may be of another task, whose fields are unknown: report that instead.
            check_task(load_checkpoint(folder.checkpoint), task_name, folder.checkpoint)
            raise
        if first.preset and first.config is None:
            _check_preset(first.preset, base, task_name, folder, arguments)
    if first.config is not None:
        presets = task_entry(task_name).presets
        if first.preset or first.resume:
            # The preset of the command line, or the resumed run, overrides that of the file.
            presets = dict.fromkeys(presets, base)
        base = load_config(first.config, base, presets=presets)
    return base


def _check_preset(
    name: str, run: TrainConfig[Any], task_name: str, folder: RunFolder, arguments: Sequence[str]
) -> None:
    """Raise NPAError if the run to resume is not of the preset `name`, except for given options."""
    presets = task_entry(task_name).presets
    # A given option has the same value over the run as over the preset.
    over_run, over_preset = (
        config_to_dict(_parse_over(base, task_name, arguments)[1]) for base in (run, presets[name])
    )
    values, *of_presets = map(config_to_dict, (run, *presets.values()))
    others = [
        f"{key}: {shown(values.get(key))}"
        for key, value in config_to_dict(presets[name]).items()
        if key not in ("out", "device", "task")
        and over_run.get(key) != over_preset[key]
        and any(preset_values.get(key) != value for preset_values in of_presets)
    ]
    if others:
        raise NPAError(
            f"preset must be the one that the run in {shown(str(folder.path))} was begun with, "
            f"but {name!r} differs from it ({', '.join(others)} there): leave --preset out"
        )


ConfigT = TypeVar("ConfigT", bound=TrainConfig[Any])


@dataclass(frozen=True)
class Command(Generic[ConfigT]):
    """All options of `npa-envs train TASK`, in the groups of its help."""

    run: TrainOptions
    training: ConfigT


def _parse_fields(
    defaults: ConfigT, task_name: str, arguments: Sequence[str]
) -> tuple[TrainOptions, ConfigT]:
    """Parse options that have the names of the fields of `defaults`, a task of one species."""
    description = f"Train on {task_name}. Defaults shown are those of the preset."
    if {"-h", "--help"} & set(arguments):
        description += f" All options: npa-envs train {task_name} --help-all"
        defaults = _with_common_fields(defaults)
    examples = task_entry(task_name).examples
    lines = "".join(f"\n  npa-envs train {task_name} {words}" for words in examples)
    command_type: Any = Command
    config_type: Any = type(defaults)
    if config_type.__parameters__:  # The class holds any task: say which.
        config_type = config_type[type(defaults.task)]
    command = common.parse_options(
        command_type[config_type],
        f"train {task_name}",
        ["--help" if word == "--help-all" else word for word in arguments],
        description=f"{description}\n\nExamples:{lines}",
        default=Command(TrainOptions(), defaults),
    )
    return command.run, command.training


def _with_common_fields(config: Any) -> Any:
    """Return an equal configuration, of a subclass whose help shows only the `Common` fields."""
    cls: Any = type(config)
    suppress: Any = tyro.conf.Suppress
    types: dict[str, Any] = {}
    values = {one.name: getattr(config, one.name) for one in fields(config)}
    for name, hint in get_type_hints(cls, include_extras=True).items():
        if name == "task":
            values["task"] = _with_common_fields(config.task)
            types["task"] = type(values["task"])
        elif COMMON not in getattr(hint, "__metadata__", ()):
            types[name] = suppress[hint]
    changed = [(name, kind, field(default=values[name])) for name, kind in types.items()]
    base = cls[types["task"]] if getattr(cls, "__parameters__", ()) else cls
    narrow = make_dataclass(cls.__name__, changed, bases=(base,), frozen=True, kw_only=True)
    return narrow(**values)


# Options of tasks of several species: one level, although their configurations nest.


@dataclass(frozen=True, kw_only=True)
class SpeciesOptions(Morphogenesis2DConfig):
    """Options with one value for all species; a --config file can set them for each species."""

    target: tyro.conf.Suppress[str] = "gecko"
    code_dim: tyro.conf.Suppress[int] = 8
    encoder: tyro.conf.Suppress[bool] = False
    switch_share: tyro.conf.Suppress[float] = 0.1

    particle_count: Common[int] = 4096
    """Particles of each species."""
    targets: Common[tuple[str, ...]] = ()
    """What each species grows: built-in names, emoji, or paths of pictures, two or more."""
    distance: Common[float] = 0.0
    """Distance between the centres of neighbouring seeds, which lie in a row [length units]."""


@dataclass(frozen=True, kw_only=True)
class JointOptions(JointTrainConfig[SpeciesOptions]):
    """Options of a training run of several rules in one world, the same for all species."""

    initial_rule: tyro.conf.Suppress[str] = ""


def _parse_joint(
    base: JointTrainConfig[CoMorphogenesis2DConfig], task_name: str, arguments: Sequence[str]
) -> tuple[TrainOptions, JointTrainConfig[CoMorphogenesis2DConfig]]:
    """Parse options that change the fields of all species of `base`."""
    task = base.task
    targets = tuple(species.target for species in task.species)
    species_options: list[SpeciesOptions] = []
    # Parsed over the values of each species, which an option that is not given does not change.
    for species in task.species:
        fields_of_one = _of_type(SpeciesOptions, species, targets=targets, distance=task.distance)
        defaults: JointOptions = _of_type(JointOptions, base, task=fields_of_one)
        options, parsed = _parse_fields(defaults, task_name, arguments)
        species_options.append(parsed.task)
    targets, distance = parsed.task.targets, parsed.task.distance
    if len(targets) < 2:
        raise NPAError(f"targets must be two or more, got {len(targets)}: --targets ring heart")
    # Targets without a species take the options of the last one.
    species_options += species_options[-1:] * (len(targets) - len(species_options))
    configs = tuple(
        _of_type(Morphogenesis2DConfig, own, target=target, targets=())
        for own, target in zip(species_options, targets, strict=False)
    )
    together = replace(task, species=configs, distance=distance)
    return options, _of_type(JointTrainConfig, parsed, task=together)


def _of_type(cls: Any, source: Any, **changes: Any) -> Any:
    """Return a dataclass `cls` with the values of equally named fields of `source`, and changes."""
    names = {one.name for one in fields(cls)} & {one.name for one in fields(source)}
    return cls(**{name: getattr(source, name) for name in names} | changes)
