"""`npa-envs train TASK`: its options, the processes of a run, and what it prints at its end."""

from __future__ import annotations

import argparse
import math
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import torch
import torch.distributed as dist
import tyro

from npa_envs.cli import INTERRUPTED, common
from npa_envs.cli.final_report import write_report
from npa_envs.errors import NPAError, shown
from npa_envs.measure.process_queue import end_with_parent
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.tasks.train_config import COMMON, UNLISTED, Common
from npa_envs.training import (
    TASKS,
    JointRules,
    JointTrainConfig,
    RunFolder,
    TrainConfig,
    config_to_dict,
    load_config,
    preset,
    task_entry,
    train,
)
from npa_envs.training.checkpoint import check_task, has_per_world_streams, load_checkpoint
from npa_envs.training.process_group import ProcessGroup
from npa_envs.training.process_launcher import (
    joined_processes,
    launch,
    print_once,
    requested_processes,
)
from npa_envs.training.trainer import TrainResult

TASK_LINES = "\n".join(f"  {name:<20}  {entry.summary}" for name, entry in TASKS.items())
HELP = f"""usage: npa-envs train TASK [options]

Train a rule by the gradient of a task's loss; npa-envs learn takes an environment's reward.

{TASK_LINES}

Options of a task: npa-envs train TASK --help"""


@dataclass(frozen=True, kw_only=True)
class TrainOptions(common.SharedRunOptions):
    """How a run starts and ends."""

    preset: str = ""
    """Configuration to start from: `paper`, `fast` (minutes on a CPU), `tiny` (seconds), for
    pictures and textures `best` (minutes on a GPU), or for pictures with thin lines `detail`;
    `npa-envs list` prints sizes and times. By default `best` on CUDA if the task has it, else
    `fast`."""
    config: Path | None = None
    """YAML, TOML or JSON file of fields and values, also `preset`; overrides the preset."""
    max_seconds: float = math.inf
    """Stop after this time [s]; the run can be resumed."""
    progress: bool = True
    """Show a progress bar."""
    report: bool = True
    """End with a report in the folder `out`: metrics, a film and a model card of the rule."""


def parse_run(task_name: str, first: argparse.Namespace) -> tuple[TrainOptions, TrainConfig[Any]]:
    """Parse all words of `first_options` to the run's options and its training configuration.

    Ends the process after `--help`, which shows the most used options, and `--help-all`.
    """
    base = starting_configuration(task_name, first)
    options, config = _parse_over(base, task_name, first.words)
    if first.resume and first.preset and first.config is None:
        _check_preset(first, base, config, task_name)
    return options, config


def _parse_over(base: Any, task_name: str, arguments: Sequence[str]) -> tuple[TrainOptions, Any]:
    """Return the options of the run, and `base` with the values of the options that are given."""
    parse = _parse_joint if isinstance(base, JointTrainConfig) else _parse_fields
    return parse(base, task_name, arguments)


def default_preset(task_name: str, device: str) -> str:
    """Return the default preset: `best` on CUDA if the task has it, else `fast`."""
    cuda = device.startswith("cuda")
    return "best" if cuda and "best" in task_entry(task_name).presets else "fast"


def starting_configuration(task_name: str, first: argparse.Namespace) -> TrainConfig[Any]:
    """Return the preset, file or resumed run that `first` names, before other options change it."""
    device = first.device if first.device and first.config is None else "cpu"
    base = preset(first.preset or default_preset(task_name, device), task_name)
    if first.resume and not {"-h", "--help", "--help-all"} & set(first.words):
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
    if first.config is not None:
        presets = task_entry(task_name).presets
        if first.preset or first.resume:
            # The preset of the command line, or the resumed run, overrides that of the file.
            presets = dict.fromkeys(presets, base)
        base = load_config(first.config, base, presets=presets)
    return base


def _check_preset(
    first: argparse.Namespace, run: TrainConfig[Any], parsed: TrainConfig[Any], task_name: str
) -> None:
    """Raise NPAError if `run` is not of the preset; options given, as in `parsed`, may differ."""
    name, presets = first.preset, task_entry(task_name).presets
    # A given option has the same value over the run as over the preset.
    of_preset = _parse_over(presets[name], task_name, first.words)[1]
    over_run, over_preset = config_to_dict(parsed), config_to_dict(of_preset)
    values, *of_presets = map(config_to_dict, (run, *presets.values()))
    others = [
        f"{key}: {shown(values.get(key))}"
        for key, value in config_to_dict(presets[name]).items()
        if key not in ("out", "device", "task")
        and over_run.get(key) != over_preset[key]
        and any(preset_values.get(key) != value for preset_values in of_presets)
    ]
    if others:
        folder = shown(str(first.out or presets[name].out))
        raise NPAError(
            f"preset must be the one that the run in {folder} was begun with, but "
            f"{name!r} differs from it ({', '.join(others)} there): leave --preset out"
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
    """Return the options of the run, and `defaults` with the values of options for its fields."""
    description = f"Train on {task_name}. Defaults shown are those of the preset."
    if {"-h", "--help"} & set(arguments):
        description += f" More options: npa-envs train {task_name} --help-all"
        defaults = _with_fields(defaults, lambda marks: COMMON in marks)
    elif "--help-all" in arguments:
        defaults = _with_fields(defaults, lambda marks: UNLISTED not in marks)
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


def _with_fields(config: Any, is_shown: Callable[[Sequence[object]], bool]) -> Any:
    """Return an equal configuration, of a subclass whose help has fields by their marks alone."""
    cls: Any = type(config)
    suppress: Any = tyro.conf.Suppress
    types: dict[str, Any] = {}
    values = {one.name: getattr(config, one.name) for one in fields(config)}
    for name, hint in get_type_hints(cls, include_extras=True).items():
        if name == "task":
            values["task"] = _with_fields(config.task, is_shown)
            types["task"] = type(values["task"])
        elif not is_shown(getattr(hint, "__metadata__", ())):
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
    """As `_parse_fields`; an option for a field of a species changes it for all species."""
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


# The run.


def main(arguments: Sequence[str]) -> int:
    """Train; return 0 if the run is finished or out of time, 130 after Ctrl-C."""
    end_with_parent()
    if arguments and arguments[0] in {"-h", "--help"}:
        print(HELP)
        return 0
    if not arguments or arguments[0].startswith("-"):
        raise NPAError(
            f"train needs a task first: {', '.join(TASKS)}; npa-envs train TASK --target heart"
        )
    task_name, *options_given = arguments
    of_target = [name for name, entry in TASKS.items() if task_name in entry.targets()]
    if task_name not in TASKS and (of_target or os.path.isfile(task_name)):
        hint = f"npa-envs train {(of_target or ['morphogenesis2d'])[0]} --target {task_name}"
        raise NPAError(f"train needs a task first, got the target {shown(task_name)}: {hint}")
    task_entry(task_name)
    with joined_processes() as processes:
        request = None
        if processes.first:
            first = common.resolve_run(
                options_given, lambda first: parse_run(task_name, first)[1].out
            )
            request = first.words, *parse_run(task_name, first)
        # Only the first process reads files, so that all have the same configuration.
        request = processes.broadcast(request)
        assert request is not None, "broadcast by the first process"
        resolved, options, config = request
        count = process_count(task_name, options, config)
        if count > 1 and not processes.distributed:
            command = ["train", task_name, *resolved]
            if options.processes is None and options.gpus is None:
                command += ["--processes", str(count)]
            return launch(count, command, config.out, config.device)
        with print_once(processes):
            return run(task_name, options, config, (task_name, *resolved), processes)


def run(
    task_name: str,
    options: TrainOptions,
    config: TrainConfig[Any],
    arguments: Sequence[str],
    processes: ProcessGroup,
) -> int:
    """Train as one of the processes that share the run, and return the exit code.

    The report prints `arguments`, those after `npa-envs train`.
    """
    common.check_numbers(options)
    folder = RunFolder(config.out)
    resume_command = f"npa-envs train {task_name} --out {shlex.quote(str(config.out))} --resume"
    if processes.count > 1 or options.processes is not None:
        resume_command += f" --processes {processes.count}"

    def begun() -> None:
        if processes.first:
            lines = announcement(task_name, options, config, arguments, processes.count)
            print("\n".join(lines))
            end = f"(Ctrl-C writes a checkpoint and stops; {resume_command} continues)"
            print(f"writing to {config.out}/ {end}", flush=True)

    try:
        with common.torch_threads(thread_count(config)):
            result = train(
                config, task_name, resume=options.resume, overwrite=options.overwrite,
                progress=options.progress, max_seconds=options.max_seconds, begun=begun,
            )  # fmt: skip
    except KeyboardInterrupt:
        print(f"interrupted; the last checkpoint is {folder.checkpoint}\nresume: {resume_command}")
        raise
    if processes.first:
        if options.resume:  # The run's file has the options that these arguments leave out.
            arguments = (task_name, "--config", str(folder.config))
            arguments += ("--processes", str(processes.count)) if processes.count > 1 else ()
        finish(task_name, options, config, result, arguments, resume_command)
    return INTERRUPTED if result.interrupted else 0


def finish(
    task_name: str,
    options: TrainOptions,
    config: TrainConfig[Any],
    result: TrainResult,
    arguments: Sequence[str],
    resume_command: str,
) -> None:
    """Print where the results of a run are and what to do with them; write the report."""
    folder = RunFolder(config.out)
    joint = isinstance(result.rule, JointRules)
    rules = [folder.rule_of(k) for k in range(len(_species(config)))] if joint else [folder.rule]
    loss = result.record.get("loss")
    last_loss = "" if loss is None else f", training loss {loss:.4g}"
    if result.finished:
        print(f"finished: {result.iteration} iterations{last_loss}")
    else:
        print(f"stopped at iteration {result.iteration}{last_loss}")
        print(f"  checkpoint  {folder.checkpoint}\n  continue    {resume_command}")
    for rule in rules:
        print(f"  rule        {rule}")
    print(f"  log         {folder.log}\n  pictures    {folder.pictures}/")
    if options.report and result.iteration > 0 and not result.interrupted:
        seconds = result.record.get("seconds", 0.0)
        command = shlex.join(["npa-envs", "train", *arguments])
        training = f"{result.iteration} iterations in {seconds:.0f} s.\n\n```sh\n{command}\n```"
        for rule in rules:
            try:
                card, scores = write_report(
                    rule, task_name, config, training, progress=options.progress
                )
                print(f"  report      {card}: {scores}")
            except NPAError as error:
                # The rule is written in any case; a bad one may diverge while it is measured.
                print(f"  no report   {error}")
    if joint:
        where = f"--distances {config.task.distance:g}"
        where += f" --particle-count {sum(config.task.counts[:2])}"
        print(f"  together    npa-envs rule-interaction {shlex.join(map(str, rules))} {where}")
    print(f"  look at it  npa-envs view {shlex.quote(str(folder.path))}")


def thread_count(config: TrainConfig[Any]) -> int:
    """Return the number of CPU threads: 1 for batches too small to gain from more, else torch's."""
    batch = config.world_count * sum(task.particle_count for task in _species(config))
    return 1 if batch < 4096 else torch.get_num_threads()


def process_count(task_name: str, options: TrainOptions, config: TrainConfig[Any]) -> int:
    """Return the number of processes: by default 2 if small batches leave cores of the CPU idle.

    It is 1 for runs of less than a minute, in which the start of a second process takes too long,
    and for resumed runs of one process, whose random numbers are not those of two.
    """
    count = requested_processes(options.gpus, options.processes, config.device)
    if count is not None:
        return count
    seconds = task_entry(task_name).expected_seconds(config)
    idle = thread_count(config) < torch.get_num_threads() and dist.is_available()
    if not idle or seconds is None or seconds < 60.0:
        return 1
    checkpoint = RunFolder(config.out).checkpoint
    if options.resume and not has_per_world_streams(load_checkpoint(checkpoint)):
        return 1
    try:
        ProcessGroup(0, 2).check(config)
    except NPAError:
        return 1
    return 2


def _species(config: TrainConfig[Any]) -> Sequence[Any]:
    """Return the task configuration of each species; most tasks have one species."""
    return getattr(config.task, "species", (config.task,))


def announcement(
    task_name: str,
    options: TrainOptions,
    config: TrainConfig[Any],
    arguments: Sequence[str] = (),
    process_count: int = 1,
) -> tuple[str, str]:
    """Return two printed lines: a run's targets, and its size and expected time."""
    species = _species(config)
    goals = [goal for task in species for goal in getattr(task, "targets", ()) or (task.goal_text,)]
    particles = " and ".join(str(task.particle_count) for task in species)
    named = options.preset or default_preset(task_name, config.device)
    source = f"preset {named}" if options.config is None else str(options.config)
    expected = task_entry(task_name).expected_seconds(config)
    if process_count == 2 and thread_count(config) == 1 and expected is not None:
        expected *= task_entry(task_name).paired_time
    elif process_count > 1:
        expected = None
    if expected is None:
        time = f"the progress bar shows the time on {config.device}"
    else:
        time = f"about {common.duration(expected)} on an idle CPU"
    if options.max_seconds < math.inf:
        time += f", at most {common.duration(options.max_seconds)}"
    if options.report:
        time += "; then the report"
    where = config.device if process_count == 1 else f"{process_count} processes ({config.device})"
    source = "continues" if options.resume else source
    given = options.config or options.resume or not hasattr(species[0], "target")
    given = given or any(word.startswith("--target") for word in arguments)
    default = "" if given else f"no --target{'s' * (len(species) > 1)} given: "
    return (
        f"{task_name}: {default}learns {' and '.join(goals)} ({source})",
        f"{config.total_iterations} iterations, each of {config.world_count} worlds of "
        f"{particles} particles, on {where}: {time}",
    )
