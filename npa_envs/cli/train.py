"""`npa-envs train TASK`: options, number of processes, output, and the end of a run."""

from __future__ import annotations

import importlib.util
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import torch
import torch.distributed as dist
import tyro

from npa_envs.cli import INTERRUPTED, common
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.training import (
    TASKS,
    JointTrainConfig,
    RunFolder,
    TrainConfig,
    check_device,
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

VIEWER = ("starlette", "uvicorn")
"""Packages that `npa-envs view` needs."""

THREADED_BATCH = 4096
"""From this number of particles of a batch on, two threads are faster than one."""

SHOWN = {
    *("target", "iterations", "device", "out"),
    *("initial_rule", "initial_rules", "frozen", "repeats", "world_count", "pool_size", "steps"),
    *("learning_rate", "seed", "targets", "distance", "particle_count", "hidden_dim", "eps"),
    *("resolution", "loss", "data"),
}
"""Fields of configurations that `--help` shows; `--help-all` shows all of them."""


EXAMPLES: dict[str, tuple[str, ...]] = {
    "morphogenesis2d": (
        "--target heart --out runs/heart",
        "--preset paper --target lizard.png --device cuda",
        "--preset paper --target lizard.png --gpus 4",
    ),
    "co_morphogenesis2d": (
        "--targets ring heart",
        "--preset paper --targets gecko heart --device cuda",
    ),
    "morphogenesis3d": (
        "--target duck --out runs/duck",
        "--preset paper --target statue.obj --device cuda",
    ),
    "texture": (
        "--target dots --out runs/dots",
        "--target wall.png --loss filter_swd",
    ),
    "point_classification": (
        "--out runs/digits",
        "--preset paper --data mnist --device cuda",
    ),
}
"""Options that the help of each task shows as examples."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions(common.SharedRunOptions):
    """How a run starts and ends."""

    preset: str = ""
    """Configuration to start from: `paper`, `fast` (minutes on a CPU), `tiny` (seconds), or for
    pictures and textures `best` (minutes on a GPU); `npa-envs list` prints sizes and times. By
    default `best` on CUDA if the task has it, else `fast`."""
    config: Path | None = None
    """YAML, TOML or JSON file of fields and values, also `preset`; overrides the preset."""
    max_seconds: float | None = None
    """Stop after this time [s]; the run can be resumed."""
    progress: bool = True
    """Show a progress bar."""
    report: bool = True
    """End with a report in the folder `out`: figures, a film and a card of the rule."""


def resolve_task(task_name: str, arguments: Sequence[str]) -> list[str]:
    """Return arguments after replacing `--resume auto`, and adding the device of `--gpus`."""
    return common.resolve_run(arguments, lambda words: parse_run(task_name, words)[1].out)


def parse_run(task_name: str, arguments: Sequence[str]) -> tuple[TrainOptions, TrainConfig[Any]]:
    """Parse arguments to the options of the run and its training configuration.

    Ends the process after `--help`, which shows the most used options, and `--help-all`.
    """
    base = starting_configuration(task_name, arguments)
    if isinstance(base, JointTrainConfig):
        return parse_joint(task_name, base, arguments)
    return _parse_over(base, task_name, arguments)


def _check_preset(
    name: str, run: TrainConfig[Any], task_name: str, folder: RunFolder, arguments: Sequence[str]
) -> None:
    """Check that a resumed run has the fields of the preset `name`, except those in `arguments`."""
    presets = {name: config_to_dict(one) for name, one in task_entry(task_name).presets.items()}
    values = config_to_dict(run)
    changed = {word.partition("=")[0].lstrip("-").replace("-", "_") for word in arguments}
    changed |= {word.removeprefix("no_") for word in changed} | {"out", "device", "task"}
    others = [
        f"{field}: {shown(values.get(field))}"
        for field, value in presets[name].items()
        if field not in changed
        and values.get(field) != value
        and any(fields.get(field) != value for fields in presets.values())
    ]
    if others:
        raise NPAError(
            f"preset must be the one that the run in {shown(str(folder.path))} was begun with, "
            f"but {name!r} differs from it ({', '.join(others)} there): leave --preset out"
        )


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


def default_preset(task_name: str, device: str) -> str:
    """Return the default preset: `best` on CUDA if the task has it, else `fast`."""
    cuda = device.startswith("cuda")
    return "best" if cuda and "best" in task_entry(task_name).presets else "fast"


ConfigT = TypeVar("ConfigT", bound=TrainConfig[Any])


@dataclass(frozen=True)
class Command(Generic[ConfigT]):
    """All options of `npa-envs train TASK`, in the groups of its help."""

    run: TrainOptions
    training: ConfigT


def _parse_over(
    defaults: ConfigT, task_name: str, arguments: Sequence[str]
) -> tuple[TrainOptions, ConfigT]:
    """Parse arguments to the options of the run, and to `defaults` with the options' changes."""
    description = f"Train on {task_name}. Defaults shown are those of the preset."
    if {"-h", "--help"} & set(arguments):
        description += f" All options: npa-envs train {task_name} --help-all"
        defaults = _with_common_fields(defaults)
    examples = "".join(f"\n  npa-envs train {task_name} {words}" for words in EXAMPLES[task_name])
    cls: Any = type(defaults)
    command_type: Any = Command
    command = common.parse_options(
        command_type[cls[type(defaults.task)] if cls.__parameters__ else cls],
        f"train {task_name}",
        ["--help" if word == "--help-all" else word for word in arguments],
        description=f"{description}\n\nExamples:{examples}",
        default=Command(TrainOptions(), defaults),
    )
    return command.run, command.training


def _with_common_fields(config: Any) -> Any:
    """Return a configuration with equal values whose help shows only the fields in `SHOWN`."""
    cls: Any = type(config)
    hints = get_type_hints(cls, include_extras=True)
    suppress: Any = tyro.conf.Suppress
    types = {name: suppress[hint] for name, hint in hints.items() if name not in SHOWN}
    values = {name: getattr(config, name) for name in types}
    if "task" in types:
        values["task"] = _with_common_fields(config.task)
        types["task"] = type(values["task"])
        cls = cls[types["task"]] if cls.__parameters__ else cls
    hidden = [(name, types[name], field(default=value)) for name, value in values.items()]
    narrow = make_dataclass(type(config).__name__, hidden, bases=(cls,), frozen=True, kw_only=True)
    return _of_type(narrow, config, **values)


# Options of tasks of several species: one level, although their configurations nest.


@dataclass(frozen=True, kw_only=True)
class SpeciesOptions(Morphogenesis2DConfig):
    """Options of all species together; a --config file can set them for each species."""

    target: tyro.conf.Suppress[str] = "gecko"
    code_dim: tyro.conf.Suppress[int] = 8
    encoder: tyro.conf.Suppress[bool] = False
    switch_share: tyro.conf.Suppress[float] = 0.1

    particle_count: int = 4096
    """Particles of each species."""
    targets: tuple[str, ...] = ()
    """What each species grows: built-in names, emoji, or paths of pictures, two or more."""
    distance: float = 0.0
    """Distance between the centres of neighbouring seeds, which lie in a row [length units]."""


@dataclass(frozen=True, kw_only=True)
class JointOptions(JointTrainConfig[SpeciesOptions]):
    """Options of a training run of several rules in one world, the same for all species."""

    initial_rule: tyro.conf.Suppress[str] = ""


def parse_joint(
    task_name: str, base: JointTrainConfig[CoMorphogenesis2DConfig], arguments: Sequence[str]
) -> tuple[TrainOptions, JointTrainConfig[CoMorphogenesis2DConfig]]:
    """Parse arguments of a run of several species, whose configuration `base` they change."""
    task = base.task
    shared_fields = {
        "targets": tuple(one.target for one in task.species),
        "distance": task.distance,
    }
    # Parsed once for each species, so that fields without an option keep each species' value.
    parsed = []
    for species in task.species:
        species_options = _of_type(SpeciesOptions, species, **shared_fields)
        defaults: JointOptions = _of_type(JointOptions, base, task=species_options)
        parsed.append(_parse_over(defaults, task_name, arguments))
    launch, first = parsed[0]
    targets = first.task.targets
    if len(targets) < 2:
        raise NPAError(f"targets must be two or more, got {len(targets)}: --targets ring heart")
    configs = tuple(
        # Targets without a species take the options of the last one.
        _of_type(
            Morphogenesis2DConfig,
            parsed[min(k, len(parsed) - 1)][1].task,
            target=target,
            targets=(),
        )
        for k, target in enumerate(targets)
    )
    together = replace(task, species=configs, distance=first.task.distance)
    return launch, _of_type(JointTrainConfig, first, task=together)


def _of_type(cls: Any, source: Any, **changes: Any) -> Any:
    """Return a dataclass `cls` with the values of equally named fields of `source`, and changes."""
    names = {field.name for field in fields(cls)} & {field.name for field in fields(source)}
    return cls(**{name: getattr(source, name) for name in names} | changes)


# The run


def main(arguments: Sequence[str]) -> int:
    """Train; return 0 when the run is finished or out of time, 130 after Ctrl-C."""
    if not arguments or arguments[0].startswith("-"):
        names = "\n".join(f"  {name}  {entry.summary}" for name, entry in TASKS.items())
        text = f"usage: npa-envs train TASK [options]\n\n{names}\n\n"
        text += "Options of a task: npa-envs train TASK --help"
        if arguments and arguments[0] in {"-h", "--help"}:
            print(text)
            return 0
        raise NPAError(f"train needs a task first: {', '.join(TASKS)}")
    task_name = arguments[0]
    task_entry(task_name)
    with joined_processes() as ranks:
        request = None
        if ranks.first:
            resolved = resolve_task(task_name, arguments[1:])
            request = resolved, *parse_run(task_name, resolved)
        # Only the first process reads files, so that all have the same configuration.
        request = ranks.broadcast(request)
        assert request is not None, "broadcast by the first process"
        resolved, options, config = request
        count = process_count(task_name, options, config)
        if count > 1 and not ranks.distributed:
            command = ["train", task_name, *resolved]
            if options.processes is None and options.gpus is None:
                command += ["--processes", str(count)]
            return launch(count, command, config.out, config.device)
        with print_once(ranks):
            return run(task_name, options, config, (task_name, *resolved), ranks)


def run(
    task_name: str,
    options: TrainOptions,
    config: TrainConfig[Any],
    arguments: Sequence[str],
    ranks: ProcessGroup,
) -> int:
    """Train as one of the processes that share the run, and return the exit code.

    The report prints `arguments`, those after `npa-envs train`.
    """
    if options.max_seconds is not None and not 0 < options.max_seconds < math.inf:
        raise NPAError(f"max_seconds must be positive and finite, got {options.max_seconds}")
    folder = RunFolder(config.out)
    resume_command = f"npa-envs train {task_name} --out {shlex.quote(str(config.out))} --resume"
    if ranks.count > 1 or options.processes is not None:
        resume_command += f" --processes {ranks.count}"

    def begun() -> None:
        if ranks.first:
            print("\n".join(announcement(task_name, options, config, ranks.count)))
            end = f"(Ctrl-C writes a checkpoint and stops; {resume_command} continues)"
            print(f"writing to {config.out}/ {end}", flush=True)

    try:
        with common.torch_threads(thread_count(config)):
            result = train(
                config,
                task_name,
                resume=options.resume,
                overwrite=options.overwrite,
                progress=options.progress,
                max_seconds=options.max_seconds,
                begun=begun,
            )
    except KeyboardInterrupt:
        print(f"interrupted; the last checkpoint is {folder.checkpoint}\nresume: {resume_command}")
        raise
    if not ranks.first:
        return INTERRUPTED if result.interrupted else 0
    rules = [folder.rule]
    influence_command = ""
    if task_entry(task_name).joint:
        rules = [folder.rule_of(number) for number in range(len(config.task.species))]
        influence_command = f"npa-envs influence {shlex.join(map(str, rules))}"
        influence_command += f" --distances {config.task.distance:g}"
        influence_command += f" --particle-count {sum(config.task.counts[:2])}"
    loss = result.record.get("loss")
    figures = "" if loss is None else f", training loss {loss:.4g}"
    if result.finished:
        print(f"finished: {result.iteration} iterations{figures}")
    else:
        print(f"stopped at iteration {result.iteration}{figures}")
        print(f"  checkpoint  {folder.checkpoint}\n  go on       {resume_command}")
    for rule in rules:
        print(f"  rule        {rule}")
    print(f"  log         {folder.log}\n  pictures    {folder.pictures}/")
    if options.report and result.iteration > 0 and not result.interrupted:
        from npa_envs.cli.train_report import Training, write_report

        command = ("train", *arguments)
        if options.resume:  # The run's file has the options that these arguments leave out.
            command = ("train", task_name, "--config", str(folder.config))
            command += ("--processes", str(ranks.count)) if ranks.count > 1 else ()
        seconds = result.record.get("seconds", 0.0)
        training = Training(task_name, command, result.iteration, seconds)
        for rule in rules:
            try:
                card, scores = write_report(
                    rule,
                    folder.report,
                    training,
                    check_device(config.device),
                    progress=options.progress,
                )
                print(f"  report      {card}: {scores}")
            except NPAError as error:
                # The rule is written in any case; a bad one may diverge while it is measured.
                print(f"  no report   {error}")
    if influence_command:
        print(f"  together    {influence_command}")
    shown_path = shlex.quote(str(folder.path))
    if any(importlib.util.find_spec(name) is None for name in VIEWER):
        print(f"  look at it  npa-envs rollout {shown_path} (live: pip install 'npa-envs[view]')")
    else:
        print(f"  look at it  npa-envs view {shown_path}")
    return INTERRUPTED if result.interrupted else 0


def thread_count(config: TrainConfig[Any]) -> int:
    """Return the number of CPU threads for training: 1 for batches below `THREADED_BATCH`."""
    batch = config.world_count * sum(task.particle_count for task in _species(config))
    return 1 if batch < THREADED_BATCH else torch.get_num_threads()


def process_count(task_name: str, options: TrainOptions, config: TrainConfig[Any]) -> int:
    """Return the number of processes: by default 2 if small batches leave cores of the CPU idle.

    1 for runs of less than a minute, in which the start of the second process takes too long, and
    for resumed runs of one process, which draw other random numbers than two.
    """
    count = requested_processes(options.gpus, options.processes, config.device)
    if count is not None:
        return count
    seconds = task_entry(task_name).expected_seconds(config)
    idle = thread_count(config) < torch.get_num_threads() and dist.is_available()
    if not idle or seconds is None or seconds < 60.0:
        return 1
    if options.resume and not has_per_world_streams(
        load_checkpoint(RunFolder(config.out).checkpoint)
    ):
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
    task_name: str, options: TrainOptions, config: TrainConfig[Any], process_count: int = 1
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
    if options.max_seconds is not None:
        time += f", at most {common.duration(options.max_seconds)}"
    where = config.device if process_count == 1 else f"{process_count} processes ({config.device})"
    return (
        f"{task_name}: learns {' and '.join(goals)} ({'goes on' if options.resume else source})",
        f"{config.total_iterations} iterations, each of {config.world_count} worlds of "
        f"{particles} particles, on {where}: {time}",
    )
