"""What one process of a comparison does: learn, be tested on held-out episodes, draw."""

from __future__ import annotations

import contextlib
import json
import math
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from npa_envs.agents.comparison.pictures import PICTURE, final_picture
from npa_envs.agents.comparison.plan import Job
from npa_envs.agents.comparison.record import REQUEST, Point, RunRecord, Status
from npa_envs.agents.evaluation import Episodes, evaluate_policy
from npa_envs.agents.learning import method_options, train
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Budget, Entry
from npa_envs.errors import DivergedError
from npa_envs.render import write_png

FIRST_TEST_SEED = 2_000_000
"""Seeds of the held-out episodes begin here; learning curves are measured on others."""


@dataclass(frozen=True)
class Request:
    """What a process is asked for."""

    job: Job
    """Which run."""
    facts: dict[str, Any]
    """What its figures follow from: problem, budget, options, episodes, and more."""
    threads: int = 1
    """CPU threads."""
    command: str = ""
    """The command line of the comparison."""

    @property
    def problem(self) -> Problem:
        """What is to be learned."""
        return Problem.from_json(json.dumps(self.facts["problem"]))

    @property
    def budget(self) -> Budget:
        """What may be spent on it."""
        amount = self.facts["budget"]
        if self.job.axis == "seconds":
            return Budget(seconds=float(amount))
        return Budget(particle_steps=int(amount))

    def record(self, status: Status, begin: float, **fields: Any) -> RunRecord:
        """Return a record of what came of it.

        Args:
            status: How it ended.
            begin: When it began, of `time.perf_counter` [s].
            fields: The other fields.
        """
        return RunRecord(
            job=self.job,
            facts=self.facts,
            status=status,
            seconds=time.perf_counter() - begin,
            command=self.command,
            date=time.strftime("%Y-%m-%d"),
            **fields,
        )


def prepare(folder: Path) -> None:
    """Load what `request.json` in a folder will need, without a use of its device.

    Args:
        folder: The run's folder.
    """
    # Whatever breaks here breaks in `run` as well, which puts it into the record.
    with contextlib.suppress(Exception):
        method_options(_request(folder).job.method)


def run(folder: Path, device: str) -> None:
    """Do what `request.json` in a folder asks for; leave the record, the rules and a picture there.

    Whatever is raised is recorded, so that other runs can go on.

    Args:
        folder: The run's folder.
        device: Where to run.
    """
    request = _request(folder)
    torch.set_num_threads(request.threads)
    begin = time.perf_counter()
    curve: list[Point] = []
    try:
        episodes = _learn(request, folder, device, lambda entry: curve.append(_point(entry)))
    except Exception as error:
        # Whatever breaks here is what the table has to say of the method.
        traceback.print_exc()
        status: Status = "diverged" if isinstance(error, DivergedError) else "failed"
        told = f"{type(error).__name__}: {' '.join(str(error).split())}"
        record = request.record(status, begin, error=told, curve=tuple(curve))
    else:
        finite = math.isfinite(episodes.mean_return)
        record = request.record(
            "done" if finite else "diverged",
            begin,
            error="" if finite else "returns of held-out episodes are not finite",
            curve=tuple(curve),
            returns=tuple(episodes.returns.tolist()),
            final_losses=tuple(episodes.final_losses.tolist()),
            endings=dict(Counter(episodes.endings)),
        )
    record.write(folder)


def _request(folder: Path) -> Request:
    held = json.loads((folder / REQUEST).read_text("utf-8"))
    return Request(**held | {"job": Job(**held["job"])})


def _learn(
    request: Request, folder: Path, device: str, on_entry: Callable[[Entry], None]
) -> Episodes:
    """Learn, write what was learned, and return the held-out episodes."""
    problem, job, facts = request.problem, request.job, request.facts
    trained = train(
        job.method,
        problem,
        request.budget,
        job.seed,
        device=device,
        on_entry=on_entry,
        **facts["options"],
    )
    if trained.rules is not None:
        trained.rules.save(folder)
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + facts["episodes"])
    # Worlds of their own: what a method changed in its environment does not reach them.
    envs = problem.make_envs(min(len(seeds), problem.num_envs), device=device)
    episodes = evaluate_policy(envs, trained.policy, seeds)
    picture = final_picture(problem, trained.policy, FIRST_TEST_SEED, device=device)
    write_png(folder / PICTURE, picture)
    return episodes


def _point(entry: Entry) -> Point:
    return Point(
        entry.seconds,
        entry.particle_steps,
        entry.mean_return,
        entry.standard_error,
        entry.final_loss,
    )
