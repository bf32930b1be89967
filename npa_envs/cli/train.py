"""`npa-envs train TASK`: how many processes a run has, what it says, how it ends."""

from __future__ import annotations

import importlib.util
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from npa_envs.cli import INTERRUPTED
from npa_envs.cli.launch import asked_count, launch, print_once
from npa_envs.cli.output import duration, torch_threads
from npa_envs.cli.report import Training, write_report
from npa_envs.cli.train_options import (
    TrainOptions,
    default_preset,
    parse,
    resolve_task,
    starting_configuration,
)
from npa_envs.errors import NPAError
from npa_envs.training import (
    TASKS,
    RunFolder,
    TrainConfig,
    TrainResult,
    check_device,
    task_entry,
    train,
)
from npa_envs.training.checkpoint import drawn_by_world, load_checkpoint
from npa_envs.training.ranks import Ranks, joined_ranks

VIEWER = ("starlette", "uvicorn")
"""Packages that `npa-envs view` needs."""

THREADED_BATCH = 4096
"""Particles of a batch from which on two threads train faster than one (docs/performance.md)."""

PAIRED_SECONDS = 60.0
"""Shortest run of one process that two share unasked [s]: the start of the second one costs 4."""


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
    if task_entry(task_name).joint:
        rules = [folder.rule_of(number) for number in range(len(config.task.species))]
        meet = f"npa-envs interact {shlex.join(map(str, rules))}"
        meet += f" --distances {config.task.distance:g}"
        meet += f" --particle-count {sum(config.task.counts[:2])}"
    _say_how_it_ended(result, rules, resume_command)
    if options.report and result.iteration > 0 and not result.interrupted:
        command = ("train", *words)
        if options.resume:  # The file of the run has what these words leave out.
            command = ("train", task_name, "--config", str(folder.config))
            command += ("--processes", str(ranks.count)) if ranks.count > 1 else ()
        seconds = result.record.get("seconds", 0.0)
        training = Training(task_name, command, result.iteration, seconds)
        for rule in rules:
            device = check_device(config.device)
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

    They are where batches are too small for several threads. A short run would be over before the
    second process has paid for its start, and one that was begun alone goes on with the same draws.
    """
    asked = asked_count(options.gpus, options.processes, config.device)
    if asked is not None:
        return asked
    seconds = task_entry(task_name).expected_seconds(config)
    idle = thread_count(config) < torch.get_num_threads() and dist.is_available()
    if not idle or seconds is None or seconds < PAIRED_SECONDS:
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


def _goals(task: Any) -> Sequence[str]:
    """Return the targets of a task, or its data."""
    targets = getattr(task, "targets", ())
    return targets or (getattr(task, "target", None) or f"the data {task.data}",)


def announcement(
    task_name: str, options: TrainOptions, config: TrainConfig[Any], process_count: int = 1
) -> tuple[str, str]:
    """Return a run's targets in a line, and its size and expected time in another."""
    species = _species(config)
    goals = [goal for own in species for goal in _goals(own)]
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
        time = f"about {duration(expected)} on a CPU that has little else to do"
    if options.max_seconds is not None:
        time += f", at most {duration(options.max_seconds)}"
    where = config.device
    if process_count > 1:
        where = f"{process_count} processes ({config.device})"
    return (
        f"{task_name}: learns {' and '.join(goals)} ({'goes on' if options.resume else source})",
        f"{config.total_iterations} iterations, each of {config.world_count} worlds of "
        f"{particles} particles, on {where}: {time}",
    )


def _say_how_it_ended(result: TrainResult, rules: Sequence[Path], resume_command: str) -> None:
    folder = RunFolder(result.folder)
    loss = result.record.get("loss")
    figures = "" if loss is None else f", training loss {loss:.4g}"
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
