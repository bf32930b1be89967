"""`npa-envs learn`: reinforcement learning of one environment, on one device or several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError, shown

if TYPE_CHECKING:
    from npa_envs.agents.learning import CurvePoint
    from npa_envs.training.process_group import ProcessGroup


@dataclass(frozen=True, kw_only=True)
class LearnOptions(common.SharedRunOptions, common.RunOptions):
    """Learn an environment by reinforcement learning, and write the run to a folder.

    It learns from rewards, in any environment; `npa-envs train` trains rules on a task by the
    gradient of its loss through the rollout, which needs far fewer steps.

    Each point of the learning curve prints a line and writes a checkpoint. A run that was stopped
    by SIGTERM, Ctrl-C or a kill continues with `--resume`, on any number of processes.

    Examples:
      npa-envs learn ppo npa/Morphogenesis2D-v0 --keywords target=heart --particle-steps 1e9
      npa-envs learn shac npa/Mixing-v0 --learning-seconds 600 --gpus 2 --out runs/mixing
    """

    method: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="METHOD")]
    """ppo or shac."""
    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Id of an environment, of Gymnasium or of several species (`npa-envs list`)."""
    keywords: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Keywords of the environment, values as JSON or plain text: target=heart."""
    options: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Options of the method, values as JSON or plain text: steps=32 (docs/learning.md)."""
    episode_steps: int | None = None
    """Steps after which an episode is truncated; default: as registered, or 256."""
    num_envs: int | None = None
    """Worlds of all processes together; default: 16, for shac 8, for ppo on CUDA more if they
    fit."""
    seed: int = 0
    """Seed of everything random, from 0 to 99."""
    particle_steps: float | None = None
    """Budget in particle-steps (steps of the worlds times their particles), for example 1e8."""
    learning_seconds: float | None = None
    """Budget in seconds of learning, without start and evaluations."""
    episodes: int = 16
    """Episodes that evaluate each point of the curve."""
    curve_points: int = 20
    """Points of the learning curve after the first; each writes a checkpoint."""
    out: Path = Path("runs/learn")
    """Folder for checkpoint, rules and curve."""


def main(arguments: Sequence[str]) -> int:
    """Learn an environment; return 0, or 130 if learning was stopped."""
    from npa_envs.training.process_launcher import (
        joined_processes,
        launch,
        print_once,
        requested_processes,
    )

    if arguments and "-v" in arguments[0]:
        env = shown(arguments[0])[1:-1]
        raise NPAError(f"learn needs a method first, got {env!r}: npa-envs learn ppo {env}")
    with joined_processes() as processes:
        request = None
        if processes.first:
            resolved = common.resolve_run(arguments, lambda first: parse(first.words).out).words
            request = resolved, parse(resolved)
        request = processes.broadcast(request)
        assert request is not None, "broadcast by the first process"
        resolved, options = request
        count = requested_processes(options.gpus, options.processes, options.device) or 1
        if count > 1 and not processes.distributed:
            return launch(count, ("learn", *resolved), options.out, options.device)
        with print_once(processes):
            return run(options, processes)


def parse(arguments: Sequence[str]) -> LearnOptions:
    """Return the options of `npa-envs learn`."""
    options = common.parse_options(LearnOptions, "learn", arguments)
    common.check_numbers(options, num_envs=1, episodes=1, curve_points=1)
    return options


def run(options: LearnOptions, processes: ProcessGroup) -> int:
    """Learn as one of the processes that share the run, and return the exit code."""
    from npa_envs.agents.learning import Budget, train
    from npa_envs.agents.learning.problem import FIRST_EVALUATION_SEED
    from npa_envs.cli import INTERRUPTED

    steps = options.particle_steps
    if steps is None and options.learning_seconds is None:
        raise NPAError(
            "learn needs a budget: give --particle-steps 1e8, --learning-seconds 600 or both"
        )
    if steps is not None and not math.isfinite(steps):
        raise NPAError(f"particle_steps must be finite, got {steps}: try 1e8")

    def show(point: CurvePoint) -> None:
        if options.progress:
            print(
                f"{point.seconds:8.1f} s  {point.particle_steps:.3g} particle-steps  "
                f"return {point.mean_return:.4g}  final loss {point.final_loss:.4g}",
                flush=True,
            )

    kwargs = common.named_values("options", options.options)
    if options.num_envs is not None:
        kwargs.setdefault("num_envs", options.num_envs)
    stopped: list[bool] = []
    budget = Budget(
        seconds=options.learning_seconds, particle_steps=None if steps is None else int(steps)
    )
    problem = common.problem_of(options, options.num_envs or 16, options.episode_steps)
    train(
        options.method, problem, budget, options.seed, device=options.device,
        evaluation_seeds=range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + options.episodes),
        curve_points=options.curve_points, on_point=show, on_stop=lambda: stopped.append(True),
        out=options.out, resume=options.resume, overwrite=options.overwrite, **kwargs,
    )  # fmt: skip
    if processes.first:
        end = "stopped; the same arguments with --resume continue" if stopped else "finished"
        print(f"{end}: rules, curve and checkpoint are in {options.out}/")
    return INTERRUPTED if stopped else 0
