"""`npa-envs train TASK`: every field of the configuration is an option."""

from __future__ import annotations

import argparse
import math
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import torch
import torch.distributed as dist
import tyro

from npa_envs.cli import INTERRUPTED
from npa_envs.cli.launch import launch, told_once
from npa_envs.cli.output import (
    OutFolder,
    duration,
    parse_options,
    settled_resume,
    torch_threads,
)
from npa_envs.cli.report import Training, write_report
from npa_envs.errors import NPAError
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.training import (
    TASKS,
    JointTrainConfig,
    RunFolder,
    TrainConfig,
    TrainResult,
    check_device,
    load_config,
    override,
    preset,
    task_entry,
    train,
)
from npa_envs.training.ranks import Ranks, joined_ranks

COMMON = ("target", "iterations", "device", "out")
"""Fields of configurations that stand among the most common options, where a task has them."""

THREADED_BATCH = 4096
"""Particles of a batch from which on two threads train faster than one (docs/performance.md)."""

PAIRED_SECONDS = 60.0
"""Shortest run of one process that two share unasked [s]: the start of the second one costs 4."""

PAIRED_TIME = 0.65
"""Time of two processes as a share of one's, where batches are small (docs/performance.md)."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What most runs are told; the paper's schedule, pool and world follow below."""

    preset: str = ""
    """Configuration to start from: `paper`, `fast` (minutes on a CPU), `tiny` (seconds), or for
    pictures and textures `best` (minutes on a GPU); `npa-envs list` has their sizes and times. By
    default `best` on CUDA where the task has it, else `fast`."""

    target: str = ""
    """What is to be learned: a built-in name (`npa-envs list`), a file, or for morphogenesis2d an
    emoji."""

    iterations: int = 0
    """Optimiser steps in one repeat."""

    device: str = "cpu"
    """Where to train: cpu, cuda, cuda:1."""

    out: OutFolder = Path()
    """Folder that log, pictures, checkpoint and rule are written to; created where missing."""

    config: Path | None = None
    """YAML, TOML or JSON file with field names and values, also `preset`; goes over the preset."""

    processes: int | None = None
    """Processes that share the run, on CUDA each with a GPU of its own; by default 1, but 2 where
    a CPU has cores for them and the batch is small. `torchrun --nproc-per-node=4 -m npa_envs train
    ...` does the same."""

    gpus: int | None = None
    """GPUs that share the run: `--gpus 4` says `--device cuda --processes 4`."""

    resume: bool = False
    """Go on from the checkpoint in the folder `out`, with the configuration that lies there.
    `--resume auto`: if there is one; else begin."""

    overwrite: bool = False
    """Start anew although the folder `out` holds a run; the run's files are removed."""

    max_seconds: float | None = None
    """Stop after this time [s]; the run can be resumed."""

    progress: bool = True
    """Show a progress bar."""

    report: bool = True
    """End with a report in the folder `out`: figures, a film and a card of the rule."""


def main(arguments: Sequence[str]) -> int:
    """Train what the words after `npa-envs train` ask for.

    Returns:
        0 when the run is finished or out of time, 130 after Ctrl-C.

    Raises:
        NPAError: The task or a value is wrong, or as for `npa_envs.training.train`.
    """
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
    with joined_ranks() as ranks:
        asked = None
        if ranks.first:
            words = settled(task_name, arguments[1:])
            asked = words, *parse(task_name, starting_configuration(task_name, words), words)
        # The first process alone reads files, so that all of them train the same.
        asked = ranks.told(asked)
        assert asked is not None, "said by the first process"
        words, options, config = asked
        count = process_count(task_name, options, config)
        if count > 1 and not ranks.together:
            told = ["train", task_name, *words]
            if options.processes is None and options.gpus is None:
                told += ["--processes", str(count)]
            return launch(count, told, config.out, config.device)
        with told_once(ranks):
            return run(task_name, options, config, (task_name, *words), ranks)


def settled(task_name: str, words: Sequence[str]) -> list[str]:
    """Return the options with `--resume auto` decided, and with CUDA as the device of `--gpus`.

    Raises:
        NPAError: As for `starting_configuration`.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--gpus")
    parser.add_argument("--device")
    first, _ = parser.parse_known_args(words)
    chosen = list(words)
    if first.gpus is not None and first.device is None:
        chosen += ["--device", "cuda"]

    def out_of(words: Sequence[str]) -> Path:
        return parse(task_name, starting_configuration(task_name, words), words)[1].out

    return settled_resume(chosen, out_of)


def starting_configuration(task_name: str, arguments: Sequence[str]) -> TrainConfig[Any]:
    """Return the configuration that the options are laid over: preset, file, or the run resumed.

    Raises:
        NPAError: No such preset, the file is wrong, or there is nothing to resume.
    """
    # These options decide what the others' defaults are, so they are looked at first.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--out", "--output", type=Path)
    try:
        first, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise NPAError(f"{error.argument_name}: {error.message}") from error
    device = first.device if first.config is None else "cpu"
    base = preset(first.preset or default_preset(task_name, device), task_name)
    if first.resume and not {"-h", "--help"} & set(arguments):
        folder = RunFolder(first.out or base.out)
        if not folder.checkpoint.is_file():
            raise NPAError(
                f"there is no checkpoint to resume from at {str(folder.checkpoint)!r}: give the "
                "folder of an earlier run with --out, or leave --resume out to start a new run"
            )
        base = load_config(folder.config, base, whole=True)
    if first.config is not None:
        presets = task_entry(task_name).presets
        if first.preset or first.resume:
            # What is said on the command line, or was of the run resumed, goes over the file.
            presets = dict.fromkeys(presets, base)
        base = load_config(first.config, base, presets=presets)
    return base


def default_preset(task_name: str, device: str) -> str:
    """Return the preset of runs that name none: `best` on CUDA where there is one, else `fast`."""
    cuda = device.startswith("cuda")
    return "best" if cuda and "best" in task_entry(task_name).presets else "fast"


def parse(
    task_name: str, base: TrainConfig[Any], arguments: Sequence[str]
) -> tuple[TrainOptions, TrainConfig[Any]]:
    """Lay the command line's options over a configuration."""

    def read(defaults: Any) -> tuple[TrainOptions, Any]:
        # These stand first, as options of their own, and not once more below.
        told = {
            name: getattr(holder, name)
            for name in COMMON
            for holder in (defaults, defaults.task)
            if hasattr(holder, name)
            and not (name == "target" and isinstance(holder, SpeciesOptions))
        }
        common = _without(TrainOptions(**told), set(COMMON) - told.keys())
        training = _without(replace(defaults, task=_without(defaults.task, told)), told)
        kinds = [("common", type(common)), ("training", type(training))]
        command = make_dataclass("Command", kinds, frozen=True)
        parsed: Any = parse_options(
            command,
            f"train {task_name}",
            arguments,
            description=f"Train on {task_name}. Defaults shown are those of the preset.",
            default=command(common, training),
        )
        task = _of_type(type(defaults.task), parsed.training.task)
        config = _of_type(type(defaults), parsed.training, task=task)
        return _of_type(TrainOptions, parsed.common), override(
            config, **{name: getattr(parsed.common, name) for name in told}
        )

    return parse_joint(base, read) if isinstance(base, JointTrainConfig) else read(base)


def _without(source: Any, names: Iterable[str]) -> Any:
    """Return a dataclass of which some fields, where it has them, are no options."""
    kind: Any = type(source)
    fixed: Any = tyro.conf.Fixed
    hints = get_type_hints(kind)
    changed = {name: fixed[hints[name]] for name in names if name in hints}
    if "task" in hints:
        changed["task"] = type(source.task)
    options = [(name, own, field(default=getattr(source, name))) for name, own in changed.items()]
    base = kind[changed["task"]] if getattr(kind, "__parameters__", ()) else kind
    narrow = make_dataclass(kind.__name__, options, bases=(base,), frozen=True, kw_only=True)
    return _of_type(narrow, source)


def run(
    task_name: str,
    options: TrainOptions,
    config: TrainConfig[Any],
    words: Sequence[str],
    ranks: Ranks,
) -> int:
    """Train, say where everything lies and how to go on, and return the exit code.

    Args:
        task_name: The task.
        options: How it runs.
        config: What it runs.
        words: The words after `npa-envs train`.
        ranks: The processes that share it; the first one speaks for all.
    """
    if options.max_seconds is not None and not 0 < options.max_seconds < math.inf:
        raise NPAError(f"max_seconds must be positive and finite, got {options.max_seconds}")
    folder = RunFolder(config.out)
    resume_command = f"npa-envs train {task_name} --out {shlex.quote(str(config.out))} --resume"
    if ranks.count > 1 or options.processes is not None:
        resume_command += f" --processes {ranks.count}"

    def begun() -> None:
        if not ranks.first:
            return
        print("\n".join(announcement(task_name, options, config, ranks.count)))
        print(
            f"writing to {config.out}/ (Ctrl-C stops in order; {resume_command} goes on)",
            flush=True,
        )

    try:
        with torch_threads(thread_count(config)):
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
        print(f"interrupted; the last checkpoint is {folder.checkpoint}\ngo on: {resume_command}")
        raise
    if not ranks.first:
        return INTERRUPTED if result.interrupted else 0
    rules = [folder.rule]
    meet = ""
    if isinstance(config, JointTrainConfig):
        rules = [folder.rule_of(number) for number in range(len(config.task.species))]
        meet = f"npa-envs interact {shlex.join(map(str, rules))}"
        meet += f" --distances {config.task.distance:g}"
        meet += f" --particle-count {sum(config.task.counts[:2])}"
    _say_how_it_ended(result, rules, resume_command)
    if options.report and result.iteration > 0 and not result.interrupted:
        training = Training(
            task_name, ("train", *words), result.iteration, result.record.get("seconds", 0.0)
        )
        for rule in rules:
            device = check_device(config.device)
            try:
                told = write_report(
                    rule, folder.report, training, device, progress=options.progress
                )
                print(f"  report      {told[0]}: {told[1]}")
            except NPAError as error:
                # The rule is there all the same; a bad one may not live as long as is measured.
                print(f"  no report   {error}")
    if meet:
        print(f"  together    {meet}")
    print(f"  look at it  npa-envs view {shlex.quote(str(folder.path))}")
    return INTERRUPTED if result.interrupted else 0


def thread_count(config: TrainConfig[Any]) -> int:
    """Return how many CPU threads torch and the kernels train with: one where batches are small.

    Several would wait for each other longer than they work (`THREADED_BATCH`).
    """
    batch = config.world_count * sum(own.particle_count for own in _species(config))
    return 1 if batch < THREADED_BATCH else torch.get_num_threads()


def process_count(task_name: str, options: TrainOptions, config: TrainConfig[Any]) -> int:
    """Return how many processes train: by default two where a CPU's other cores would be idle.

    They are where batches are too small for several threads. A short run would be over before the
    second process has paid for its start.

    Raises:
        NPAError: There are to be fewer than one, or GPUs that are not to be used.
    """
    if options.gpus is not None and options.processes is not None:
        raise NPAError(
            f"gpus says how many processes there are, got gpus {options.gpus} and processes "
            f"{options.processes}: give one of them"
        )
    if options.gpus is not None and config.device == "cpu":
        raise NPAError("gpus goes with device 'cuda', got 'cpu': take --processes instead")
    for name, count in (("gpus", options.gpus), ("processes", options.processes)):
        if count is not None:
            if count < 1:
                raise NPAError(f"{name} must be at least 1, got {count}")
            return count
    seconds = task_entry(task_name).expected_seconds(config)
    idle = thread_count(config) < torch.get_num_threads() and dist.is_available()
    if not idle or config.varied or seconds is None or seconds < PAIRED_SECONDS:
        return 1
    try:
        Ranks(0, 2).check(config)
    except NPAError:
        return 1
    return 2


def _species(config: TrainConfig[Any]) -> Sequence[Any]:
    """Return the tasks of all species; of one, where a task has no others."""
    return getattr(config.task, "species", (config.task,))


def _goals(task: Any) -> Sequence[str]:
    """Return what a task learns, in a word or two each."""
    targets = getattr(task, "targets", ())
    return targets or (getattr(task, "target", None) or f"the data {task.data}",)


def announcement(
    task_name: str, options: TrainOptions, config: TrainConfig[Any], process_count: int = 1
) -> tuple[str, str]:
    """Return what a run is about to do, in two lines: what it learns, and how large and long it is.

    Args:
        task_name: The task.
        options: How it runs.
        config: What it runs.
        process_count: Processes that share it.
    """
    species = _species(config)
    goals = [goal for own in species for goal in _goals(own)]
    particles = " and ".join(str(own.particle_count) for own in species)
    named = options.preset or default_preset(task_name, config.device)
    source = f"preset {named}" if options.config is None else str(options.config)
    expected = task_entry(task_name).expected_seconds(config)
    if process_count == 2 and thread_count(config) == 1 and expected is not None:
        expected *= PAIRED_TIME
    elif process_count > 1:
        expected = None
    if expected is None:
        time = f"how long that takes on {config.device} the progress bar tells"
    else:
        time = f"about {duration(expected)} on a CPU that has little else to do"
    if options.max_seconds is not None:
        time += f", at most {duration(options.max_seconds)}"
    where = config.device
    if process_count > 1:
        where = f"{process_count} processes ({config.device})"
    return (
        f"{task_name}: learns {' and '.join(goals)} ({'goes on' if options.resume else source})",
        f"{config.total_iterations} iterations on {where}, each of {config.world_count} "
        f"worlds of {particles} particles: {time}",
    )


def _say_how_it_ended(result: TrainResult, rules: Sequence[Path], resume_command: str) -> None:
    folder = RunFolder(result.folder)
    loss = result.record.get("loss")
    figures = "" if loss is None else f", loss {loss:.4g}"
    if result.finished:
        print(f"finished: {result.iteration} iterations{figures}")
    else:
        print(f"stopped at iteration {result.iteration}{figures}")
        print(f"  checkpoint  {folder.checkpoint}")
        print(f"  go on       {resume_command}")
    for rule in rules:
        print(f"  rule        {rule}")
    print(f"  log         {folder.log}")
    print(f"  pictures    {folder.pictures}/")


# Options of tasks of several species: flat, although configurations nest.


@dataclass(frozen=True, kw_only=True)
class SpeciesOptions(Morphogenesis2DConfig):
    """What all species share is said once; a --config file says it species by species."""

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
    """A training run of several rules in one world; what is said of a species holds for all."""

    initial_rule: tyro.conf.Suppress[str] = ""


def parse_joint(
    base: JointTrainConfig[CoMorphogenesis2DConfig],
    read: Callable[[JointOptions], tuple[TrainOptions, JointOptions]],
) -> tuple[TrainOptions, JointTrainConfig[CoMorphogenesis2DConfig]]:
    """Return what the command line says of a run of several species.

    Raises:
        NPAError: There are fewer than two targets.
    """
    task = base.task
    # Once for each species, so that what is not said stays as it is in each of them.
    launch, told = read(_flat(base, task, 0))
    targets = told.task.targets
    if len(targets) < 2:
        raise NPAError(f"targets must be two or more, got {len(targets)}: --targets ring heart")
    species = []
    for number, target in enumerate(targets):
        _, own = read(_flat(base, task, min(number, len(task.species) - 1)))
        species.append(
            _of_type(Morphogenesis2DConfig, replace(own.task, target=target, targets=()))
        )
    together = replace(task, species=tuple(species), distance=told.task.distance)
    return launch, _of_type(JointTrainConfig, told, task=together)


def _flat(
    base: JointTrainConfig[CoMorphogenesis2DConfig], task: CoMorphogenesis2DConfig, number: int
) -> JointOptions:
    """Return a configuration as options, with the fields of one species for all."""
    targets = tuple(config.target for config in task.species)
    options = _of_type(
        SpeciesOptions, task.species[number], targets=targets, distance=task.distance
    )
    flat: JointOptions = _of_type(JointOptions, base, task=options)
    return flat


def _of_type(kind: Any, source: Any, **others: Any) -> Any:
    """Return a dataclass with the fields that another one has, and others."""
    own = {field.name for field in fields(kind)}
    same = {f.name: getattr(source, f.name) for f in fields(source) if f.name in own}
    return kind(**same | others)
