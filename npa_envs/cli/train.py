"""`npa-envs train TASK`: number of processes, output, and the end of a run."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from typing import Any

import torch
import torch.distributed as dist

from npa_envs.cli import INTERRUPTED, common
from npa_envs.cli.train_options import TrainOptions, default_preset, parse_run
from npa_envs.errors import NPAError
from npa_envs.training import (
    TASKS,
    JointRules,
    RunFolder,
    TrainConfig,
    check_device,
    task_entry,
    train,
)
from npa_envs.training.checkpoint import has_per_world_streams, load_checkpoint
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


def main(arguments: Sequence[str]) -> int:
    """Train; return 0 when the run is finished or out of time, 130 after Ctrl-C."""
    if arguments and arguments[0] in {"-h", "--help"}:
        print(HELP)
        return 0
    if not arguments or arguments[0].startswith("-"):
        raise NPAError(f"train needs a task first: {', '.join(TASKS)}")
    task_name, *options_given = arguments
    task_entry(task_name)
    with joined_processes() as processes:
        request = None
        if processes.first:
            resolved = common.resolve_run(
                options_given, lambda words: parse_run(task_name, words)[1].out
            )
            request = resolved, *parse_run(task_name, resolved)
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
            print("\n".join(announcement(task_name, options, config, processes.count)))
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
        from npa_envs.cli.final_report import write_report

        seconds = result.record.get("seconds", 0.0)
        command = shlex.join(["npa-envs", "train", *arguments])
        training = f"{result.iteration} iterations in {seconds:.0f} s.\n\n```sh\n{command}\n```"
        device = check_device(config.device)
        for rule in rules:
            try:
                card, scores = write_report(
                    rule, folder.report, task_name, training, device, progress=options.progress
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
    """Return the number of CPU threads: 1 for batches too small to gain from a second one."""
    batch = config.world_count * sum(task.particle_count for task in _species(config))
    return 1 if batch < 4096 else torch.get_num_threads()


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
    if options.max_seconds < math.inf:
        time += f", at most {common.duration(options.max_seconds)}"
    where = config.device if process_count == 1 else f"{process_count} processes ({config.device})"
    return (
        f"{task_name}: learns {' and '.join(goals)} ({'continues' if options.resume else source})",
        f"{config.total_iterations} iterations, each of {config.world_count} worlds of "
        f"{particles} particles, on {where}: {time}",
    )
