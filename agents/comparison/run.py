"""One run of a comparison: learn, be tested on held-out episodes, leave a record and a picture.

Each run is a process, `python -m npa_envs.agents.comparison.run FOLDER`: it gets ready, waits for a
line on its input that names a device, and does there what `request.json` in the folder asks for; it
ends when its input does.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from npa_envs.agents.comparison.plan import Job
from npa_envs.agents.evaluation import Episodes, evaluate_policy
from npa_envs.agents.learning import method_options, train
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Budget, Entry
from npa_envs.errors import DivergedError
from npa_envs.measure.record import number, read_record, write_record
from npa_envs.render import write_png

Status = Literal["done", "diverged", "failed"]

RECORD, REQUEST, OUTPUT, PICTURE = "run.json", "request.json", "output.txt", "picture.png"
"""Files in the folder of a run: its record, what its process was asked for, what that said, the
last picture of a held-out episode."""

SIZE = 192
"""Pixels on each side of a picture."""

FIRST_TEST_SEED = 2_000_000
"""Seeds of the held-out episodes begin here; learning curves are measured on others."""


@dataclass(frozen=True)
class Point:
    """A place on a learning curve: training's wall time [s] and particles times steps so far, and
    the mean return of held-out episodes, its standard error, and their mean loss at the end.
    """

    seconds: float
    particle_steps: float
    mean_return: float
    standard_error: float
    final_loss: float


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What came of one run."""

    job: Job
    facts: Mapping[str, Any]
    """What its figures follow from."""
    status: Status
    """"done"; "diverged": numbers became infinite or NaN; "failed": an error of another kind."""
    error: str = ""
    """What was raised, where it is not done."""
    curve: Sequence[Point] = ()
    """What held-out episodes gave while it learned."""
    returns: Sequence[float] = ()
    """Returns of the held-out episodes at the end."""
    final_losses: Sequence[float] = ()
    """Losses at the ends of the same episodes."""
    endings: Mapping[str, int] | None = None
    """How many of the same episodes ended for each reason."""
    seconds: float = 0.0
    """How long it took with set-up and evaluation [s]."""
    command: str = ""
    date: str = ""
    """The day, as YYYY-MM-DD."""

    @property
    def mean_return(self) -> float:
        """Mean return of the held-out episodes; NaN where there are none."""
        return _mean(self.returns)

    @property
    def mean_loss(self) -> float:
        """Mean loss at the ends of the held-out episodes; NaN where there are none."""
        return _mean(self.final_losses)

    def write(self, folder: Path) -> None:
        """Write everything into the run's folder; what is not finite becomes null.

        Raises:
            NPAError: It cannot be written.
        """
        write_record(folder / RECORD, asdict(self))

    @classmethod
    def read(cls, folder: Path, facts: Mapping[str, Any]) -> RunRecord | None:
        """Return the record that a run left in its folder, None where there is none.

        Raises:
            NPAError: As for `read_record`.
        """

        def made(held: dict[str, Any]) -> RunRecord:
            points = [{name: number(v) for name, v in row.items()} for row in held["curve"]]
            own = {
                "job": Job(**held["job"]),
                "curve": tuple(Point(**point) for point in points),
                "returns": tuple(map(number, held["returns"])),
                "final_losses": tuple(map(number, held["final_losses"])),
            }
            return cls(**held | own)

        return read_record(folder / RECORD, facts, made, command="compare")


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


@dataclass(frozen=True)
class Request:
    """What a process is asked for."""

    job: Job
    facts: dict[str, Any]
    """What its figures follow from: problem, budget, options, episodes, and more."""
    threads: int = 1
    command: str = ""

    @classmethod
    def read(cls, folder: Path) -> Request:
        """Return what a folder asks for."""
        held = json.loads((folder / REQUEST).read_text("utf-8"))
        return cls(**held | {"job": Job(**held["job"])})

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
        """Return a record of what came of it since `begin`, of `time.perf_counter` [s]."""
        return RunRecord(
            job=self.job,
            facts=self.facts,
            status=status,
            seconds=time.perf_counter() - begin,
            command=self.command,
            date=time.strftime("%Y-%m-%d"),
            **fields,
        )


def run(folder: Path, device: str) -> None:
    """Do what `request.json` in a folder asks for; leave the record, the rules and a picture there.

    Whatever is raised is recorded, so that other runs can go on.
    """
    request = Request.read(folder)
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


def final_picture(
    problem: Problem, policy: Callable[[Any], Any], seed: int, *, device: str
) -> NDArray[np.uint8]:
    """Return a picture of the world at the end of an episode, uint8, shape [SIZE, SIZE, 3].

    The policy maps observations, [1, N, P], to actions, [1, N, A].
    """
    seen = {"render_mode": "rgb_array", "render_size": SIZE}
    # One step more, as a world that is over shows the next episode's start.
    longer = replace(
        problem,
        keywords={**problem.keywords, **seen},
        episode_steps=problem.episode_steps + 1,
    )
    envs = longer.make_envs(1, device=device)
    observation, _ = envs.reset(seed=[seed])
    picture = _rendered(envs)
    for _ in range(problem.episode_steps):
        observation, _, terminated, truncated, _ = envs.step(policy(observation))
        if bool(terminated | truncated):
            break
        picture = _rendered(envs)
    envs.close()
    return picture


def _rendered(envs: Any) -> NDArray[np.uint8]:
    """Return a picture of the only world."""
    (picture,) = getattr(envs, "species_env", envs).render()
    frame: NDArray[np.uint8] = picture
    return frame


def main(folder: Path) -> None:
    """Do what a folder asks for once a device is named, unless the comparison ends before."""
    lines: SimpleQueue[str] = SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            lines.put(line.strip())
        # The pipe has no other end.
        os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    # Loads what the method needs. Whatever breaks here breaks in `run` as well, which records it.
    with contextlib.suppress(Exception):
        method_options(Request.read(folder).job.method)
    run(folder, lines.get())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
