"""`npa-envs train TASK`: its options, how many processes a run has, what it says, how it ends."""

from __future__ import annotations

import argparse
import importlib.util
import math
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import torch
import torch.distributed as dist
import tyro

from npa_envs.cli import INTERRUPTED, common
from npa_envs.cli.launch import asked_count, launch, print_once, with_device_of_gpus
from npa_envs.cli.report import Training, write_report
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
    override,
    preset,
    task_entry,
    train,
)
from npa_envs.training.checkpoint import check_task, drawn_by_world, load_checkpoint
from npa_envs.training.ranks import Ranks, joined_ranks

VIEWER = ("starlette", "uvicorn")
"""Packages that `npa-envs view` needs."""

THREADED_BATCH = 4096
"""Particles of a batch from which on two threads train faster than one (docs/performance.md)."""

COMMON = ("target", "iterations", "device", "out")
"""Fields of configurations that stand among the most common options, where a task has them."""


SHOWN = {
    *("initial_rule", "initial_rules", "frozen", "repeats", "world_count", "pool_size", "steps"),
    *("learning_rate", "seed", "targets", "distance", "particle_count", "hidden_dim", "eps"),
    *("resolution", "loss", "data"),
}
"""Fields of configurations that `--help` shows; `--help-all` shows all of them."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """The most common options; the paper's schedule, pool and world follow below."""

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
    out: Path = Path()
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


def resolve_task(task_name: str, words: Sequence[str]) -> list[str]:
    """Return the options with `--resume auto` decided, and with CUDA as the device of `--gpus`."""

    def out_of(words: Sequence[str]) -> Path:
        return parse(task_name, starting_configuration(task_name, words), words)[1].out

    return common.resolve_resume(with_device_of_gpus(words), out_of)


def _check_preset(
    name: str, run: TrainConfig[Any], task_name: str, folder: RunFolder, arguments: Sequence[str]
) -> None:
    """Check that a run that goes on is of the preset that was named."""
    names = task_entry(task_name).presets
    flat = {preset_name: _fields_of(preset(preset_name, task_name)) for preset_name in names}
    wanted, held = flat[name], _fields_of(run)
    said = {word.partition("=")[0].lstrip("-").replace("-", "_") for word in arguments}
    said |= {word.removeprefix("no_") for word in said} | {"out", "device"}
    others = [
        field
        for field, value in wanted.items()
        if field not in said
        and held.get(field) != value
        and any(other.get(field) != value for other in flat.values())
    ]
    if others:
        shown_fields = ", ".join(f"{field}: {shown(held.get(field))}" for field in others[:3])
        more = f" and {len(others) - 3} more" if len(others) > 3 else ""
        raise NPAError(
            f"preset must be the one that the run in {shown(str(folder.path))} was begun with, "
            f"but {name!r} differs from it ({shown_fields}{more} there): leave --preset out, and "
            "it goes on as it was"
        )


def _fields_of(config: TrainConfig[Any]) -> dict[str, Any]:
    """Return a configuration's own fields; those of its task may follow from its target."""
    own = config_to_dict(config)
    del own["task"]
    return own


def starting_configuration(task_name: str, arguments: Sequence[str]) -> TrainConfig[Any]:
    """Return the configuration that the options are laid over: preset, file, or the run resumed."""
    # These options decide what the others' defaults are, so they are looked at first.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--out", type=Path)
    try:
        first, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise NPAError(f"{error.argument_name}: {error.message}") from error
    device = first.device if first.config is None else "cpu"
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
            # Fields of another task are unknown: its name is the better error.
            check_task(load_checkpoint(folder.checkpoint), task_name, folder.checkpoint)
            raise
        if first.preset and first.config is None:
            _check_preset(first.preset, base, task_name, folder, arguments)
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
    """Lay the command line's options over a configuration.

    Ends the process after `--help`, which shows the most used options, and `--help-all`.
    """
    # What a help leaves out could not be given either.
    whole = not {"-h", "--help"} & set(arguments)
    arguments = ["--help" if word == "--help-all" else word for word in arguments]

    def read(defaults: Any) -> tuple[TrainOptions, Any]:
        # These stand first, as options of their own, and not once more below.
        shared = {
            name: getattr(holder, name)
            for name in COMMON
            for holder in (defaults, defaults.task)
            if hasattr(holder, name)
            and not (name == "target" and isinstance(holder, SpeciesOptions))
        }
        launch = _without(TrainOptions(**shared), set(COMMON) - shared.keys())
        task = _without(defaults.task, shared, whole=whole)
        training = _without(replace(defaults, task=task), shared, whole=whole)
        kinds = [("common", type(launch)), ("training", type(training))]
        command = make_dataclass("Command", kinds, frozen=True)
        parsed: Any = common.parse_options(
            command,
            f"train {task_name}",
            arguments,
            description=f"Train on {task_name}. Defaults shown are those of the preset."
            + ("" if whole else f" All options: npa-envs train {task_name} --help-all"),
            default=command(launch, training),
        )
        task = _of_type(type(defaults.task), parsed.training.task)
        config = _of_type(type(defaults), parsed.training, task=task)
        return _of_type(TrainOptions, parsed.common), override(
            config, **{name: getattr(parsed.common, name) for name in shared}
        )

    return parse_joint(base, read) if isinstance(base, JointTrainConfig) else read(base)


def _without(source: Any, names: Iterable[str], *, whole: bool = True) -> Any:
    """Return a dataclass of which some fields, where it has them, are no options.

    Unless it is to be whole, fields that are not `SHOWN` are none either.
    """
    kind: Any = type(source)
    fixed: Any = tyro.conf.Fixed
    hidden: Any = tyro.conf.Suppress
    hints = get_type_hints(kind, include_extras=True)
    changed = {} if whole else {name: hidden[hints[name]] for name in hints.keys() - SHOWN}
    changed |= {name: fixed[hints[name]] for name in names if name in hints}
    if "task" in hints:
        changed["task"] = type(source.task)
    options = [(name, own, field(default=getattr(source, name))) for name, own in changed.items()]
    base = kind[changed["task"]] if getattr(kind, "__parameters__", ()) else kind
    narrow = make_dataclass(kind.__name__, options, bases=(base,), frozen=True, kw_only=True)
    return _of_type(narrow, source)


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
    """Return the command line's configuration of a run of several species."""
    task = base.task
    # Once for each species, so that fields without an option keep each species' value.
    launch, shared = read(_flat(base, task, 0))
    targets = shared.task.targets
    if len(targets) < 2:
        raise NPAError(f"targets must be two or more, got {len(targets)}: --targets ring heart")
    species = []
    for number, target in enumerate(targets):
        _, own = read(_flat(base, task, min(number, len(task.species) - 1)))
        species.append(
            _of_type(Morphogenesis2DConfig, replace(own.task, target=target, targets=()))
        )
    together = replace(task, species=tuple(species), distance=shared.task.distance)
    return launch, _of_type(JointTrainConfig, shared, task=together)


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
    with joined_ranks() as ranks:
        asked = None
        if ranks.first:
            words = resolve_task(task_name, arguments[1:])
            asked = words, *parse(task_name, starting_configuration(task_name, words), words)
        # The first process alone reads files, so that all of them train the same.
        asked = ranks.broadcast(asked)
        assert asked is not None, "said by the first process"
        words, options, config = asked
        count = process_count(task_name, options, config)
        if count > 1 and not ranks.together:
            command = ["train", task_name, *words]
            if options.processes is None and options.gpus is None:
                command += ["--processes", str(count)]
            return launch(count, command, config.out, config.device)
        with print_once(ranks):
            return run(task_name, options, config, (task_name, *words), ranks)


def run(
    task_name: str,
    options: TrainOptions,
    config: TrainConfig[Any],
    words: Sequence[str],
    ranks: Ranks,
) -> int:
    """Train as one of the processes that share the run, and return the exit code.

    `words` are those after `npa-envs train`, for the report.
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
            end = f"(Ctrl-C stops in order; {resume_command} goes on)"
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
        print(f"interrupted; the last checkpoint is {folder.checkpoint}\ngo on: {resume_command}")
        raise
    if not ranks.first:
        return INTERRUPTED if result.interrupted else 0
    rules = [folder.rule]
    meet = ""
    if task_entry(task_name).joint:
        rules = [folder.rule_of(number) for number in range(len(config.task.species))]
        meet = f"npa-envs interact {shlex.join(map(str, rules))}"
        meet += f" --distances {config.task.distance:g}"
        meet += f" --particle-count {sum(config.task.counts[:2])}"
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
        command = ("train", *words)
        if options.resume:  # The file of the run has what these words leave out.
            command = ("train", task_name, "--config", str(folder.config))
            command += ("--processes", str(ranks.count)) if ranks.count > 1 else ()
        seconds = result.record.get("seconds", 0.0)
        training = Training(task_name, command, result.iteration, seconds)
        device = check_device(config.device)
        for rule in rules:
            try:
                card, scores = write_report(
                    rule, folder.report, training, device, progress=options.progress
                )
                print(f"  report      {card}: {scores}")
            except NPAError as error:
                # The rule is there all the same; a bad one may not live as long as is measured.
                print(f"  no report   {error}")
    if meet:
        print(f"  together    {meet}")
    shown_path = shlex.quote(str(folder.path))
    if any(importlib.util.find_spec(name) is None for name in VIEWER):
        print(f"  look at it  npa-envs rollout {shown_path} (live: pip install 'npa-envs[view]')")
    else:
        print(f"  look at it  npa-envs view {shown_path}")
    return INTERRUPTED if result.interrupted else 0


def thread_count(config: TrainConfig[Any]) -> int:
    """Return how many CPU threads torch and the kernels train with: one where batches are small.

    Several would wait for each other longer than they work (`THREADED_BATCH`).
    """
    batch = config.world_count * sum(own.particle_count for own in _species(config))
    return 1 if batch < THREADED_BATCH else torch.get_num_threads()


def process_count(task_name: str, options: TrainOptions, config: TrainConfig[Any]) -> int:
    """Return how many processes train: by default two where a CPU's other cores would be idle.

    They are where batches are too small for several threads. A run of less than a minute is over
    before the second process has paid for its start, and one that was begun alone goes on with the
    same draws.
    """
    asked = asked_count(options.gpus, options.processes, config.device)
    if asked is not None:
        return asked
    seconds = task_entry(task_name).expected_seconds(config)
    idle = thread_count(config) < torch.get_num_threads() and dist.is_available()
    if not idle or seconds is None or seconds < 60.0:
        return 1
    if options.resume and not drawn_by_world(load_checkpoint(RunFolder(config.out).checkpoint)):
        return 1
    try:
        Ranks(0, 2).check(config)
    except NPAError:
        return 1
    return 2


def _species(config: TrainConfig[Any]) -> Sequence[Any]:
    """Return the tasks of all species; of one, where a task has no others."""
    return getattr(config.task, "species", (config.task,))


def announcement(
    task_name: str, options: TrainOptions, config: TrainConfig[Any], process_count: int = 1
) -> tuple[str, str]:
    """Return a run's targets in a line, and its size and expected time in another."""
    species = _species(config)
    goals: list[str] = []
    for own in species:
        targets = getattr(own, "targets", ())
        goals += targets or (getattr(own, "target", None) or f"the data {own.data}",)
    particles = " and ".join(str(own.particle_count) for own in species)
    named = options.preset or default_preset(task_name, config.device)
    source = f"preset {named}" if options.config is None else str(options.config)
    expected = task_entry(task_name).expected_seconds(config)
    if process_count == 2 and thread_count(config) == 1 and expected is not None:
        expected *= task_entry(task_name).paired_time
    elif process_count > 1:
        expected = None
    if expected is None:
        time = f"how long that takes on {config.device} the progress bar tells"
    else:
        time = f"about {common.duration(expected)} on a CPU that has little else to do"
    if options.max_seconds is not None:
        time += f", at most {common.duration(options.max_seconds)}"
    where = config.device
    if process_count > 1:
        where = f"{process_count} processes ({config.device})"
    return (
        f"{task_name}: learns {' and '.join(goals)} ({'goes on' if options.resume else source})",
        f"{config.total_iterations} iterations, each of {config.world_count} worlds of "
        f"{particles} particles, on {where}: {time}",
    )
