"""Runs of a comparison: each learns, is tested on held-out episodes, writes a record and a picture.

A run has a folder: at first with its job and settings, `request.json`, at the end with its
`RunRecord`, `run.json`. Processes do the runs, on several cores or GPUs: `python -m
npa_envs.agents.comparison.single_run FOLDER`. A process loads the libraries that the run in FOLDER
needs. Then it reads orders from its standard input, lines of JSON: [folder of the run to do,
device, folder of the run whose rules it clones, or ""]. It ends when its input ends.
"""

from __future__ import annotations

import contextlib
import gc
import json
import math
import os
import secrets
import shutil
import subprocess
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

from npa_envs.agents.comparison.plan import ComparisonPlan, Job
from npa_envs.agents.evaluation import Episodes, bound_to, evaluate_policy
from npa_envs.agents.learning import method_options, train
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Budget, CurvePoint
from npa_envs.errors import DivergedError, NPAError
from npa_envs.measure.benchmark_records import number, read_record, write_record
from npa_envs.measure.process_queue import Child, Slots, run_children
from npa_envs.render import write_png

Status = Literal["done", "diverged", "failed"]

RECORD, REQUEST, OUTPUT, PICTURE = "run.json", "request.json", "output.txt", "picture.png"
"""Files of a run: record, request to its process, output, the end of a held-out episode."""

PICTURE_SIDE = 192
"""Pixels on each side of a picture."""

FIRST_TEST_SEED = 2_000_000
"""First seed of held-out episodes, above all seeds of learning curves."""


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """The result of one run, which its folder's `run.json` stores."""

    job: Job
    facts: Mapping[str, Any]
    """Settings that the result depends on (`ComparisonPlan.facts`)."""
    status: Status
    """"done"; "diverged": numbers became infinite or NaN; "failed": an error of another kind."""
    error: str = ""
    curve: Sequence[CurvePoint] = ()
    returns: Sequence[float] = ()
    """Returns of the held-out episodes."""
    final_losses: Sequence[float] = ()
    """Losses at the ends of the held-out episodes."""
    endings: Mapping[str, int] | None = None
    """Number of held-out episodes by the reason of their end."""
    seconds: float = 0.0
    """Duration with set-up and evaluation [s]."""
    command: str = ""
    date: str = ""

    @property
    def mean_return(self) -> float:
        """Mean return of the held-out episodes; NaN without any."""
        return mean_of(self.returns)

    @property
    def mean_loss(self) -> float:
        """Mean loss at the ends of the held-out episodes; NaN without any."""
        return mean_of(self.final_losses)

    def write(self, folder: Path) -> None:
        """Write `run.json` into the run's folder; numbers that are not finite become null."""
        write_record(folder / RECORD, asdict(self))

    def write_ended(self, folder: Path, begin: float) -> RunRecord:
        """Write and return the record of a run that ends now and began at `begin` [s]."""
        seconds, date = time.perf_counter() - begin, time.strftime("%Y-%m-%d")
        ended = replace(self, seconds=seconds, date=date)
        ended.write(folder)
        return ended

    @classmethod
    def read(cls, folder: Path, facts: Mapping[str, Any]) -> RunRecord | None:
        """Return the record in a run's folder, if any; raises NPAError if its `facts` differ."""

        def make(content: dict[str, Any]) -> RunRecord:
            fields: dict[str, Any] = {"job": Job(**content["job"])}
            for name in ("returns", "final_losses"):
                fields[name] = tuple(map(number, content[name]))
            points = [{name: number(v) for name, v in row.items()} for row in content["curve"]]
            fields["curve"] = tuple(CurvePoint(**point) for point in points)  # type: ignore[arg-type]
            return cls(**content | fields)

        return read_record(folder / RECORD, facts, make, command="compare")


def mean_of(values: Sequence[float]) -> float:
    """Return the mean of numbers; NaN if there are none."""
    return sum(values) / len(values) if values else math.nan


def requested_run(folder: Path) -> RunRecord:
    """Return a record without results of the run in a folder's `request.json`, as "failed"."""
    content = json.loads((folder / REQUEST).read_text("utf-8"))
    return RunRecord(**content | {"job": Job(**content["job"])}, status="failed")


def run(folder: Path, device: str, teacher: str = "") -> None:
    """Do the run of a folder's `request.json`; write record, rules and picture into the folder.

    Errors are recorded, and other runs continue. `teacher`: folder of rules to clone; "": none.
    """
    record, begin = requested_run(folder), time.perf_counter()
    curve: list[CurvePoint] = []
    try:
        episodes = _learn(record, folder, device, teacher, curve.append)
    except Exception as error:
        # The table reports errors.
        traceback.print_exc()
        record = replace(
            record,
            status="diverged" if isinstance(error, DivergedError) else "failed",
            error=f"{type(error).__name__}: {' '.join(str(error).split())}",
        )
    else:
        finite = math.isfinite(episodes.mean_return)
        record = replace(
            record,
            status="done" if finite else "diverged",
            error="" if finite else "returns of held-out episodes are not finite",
            returns=tuple(episodes.returns.tolist()),
            final_losses=tuple(episodes.final_losses.tolist()),
            endings=dict(Counter(episodes.endings)),
        )
    replace(record, curve=tuple(curve)).write_ended(folder, begin)


def _learn(
    record: RunRecord,
    folder: Path,
    device: str,
    teacher: str,
    on_point: Callable[[CurvePoint], None],
) -> Episodes:
    """Learn, write rules or policy and a picture, and return the results of held-out episodes."""
    job, facts = record.job, record.facts
    problem, amount = Problem(**facts["problem"]), facts["budget"]
    in_seconds = job.axis == "seconds"
    budget = Budget(seconds=amount) if in_seconds else Budget(particle_steps=int(amount))
    options = dict(facts["options"], device=device, on_point=on_point)
    if teacher:
        options["teacher"] = teacher
    trained = train(facts["method"], problem, budget, job.seed, **options)
    trained.save(folder)
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + facts["episodes"])
    # New environments, as the method may have changed its own.
    envs = problem.make_envs(min(len(seeds), problem.num_envs), device=device)
    episodes = evaluate_policy(envs, trained.policy, seeds)
    picture = final_picture(problem, trained.policy, FIRST_TEST_SEED, device=device)
    write_png(folder / PICTURE, picture)
    return episodes


def final_picture(
    problem: Problem, policy: Callable[[Any], Any], seed: int, *, device: str
) -> NDArray[np.uint8]:
    """Return a picture of the world at the end of the episode from a seed, uint8, [192, 192, 3].

    The policy maps observations, [1, N, P], to actions, [1, N, A].
    """
    keywords = {**problem.keywords, "render_mode": "rgb_array", "render_size": PICTURE_SIDE}
    # One more step, as an environment at the end of an episode shows the next start.
    longer = replace(problem, keywords=keywords, episode_steps=problem.episode_steps + 1)
    envs: Any = longer.make_envs(1, device=device)
    policy = bound_to(envs, policy)
    observation, _ = envs.reset(seed=[seed])
    (picture,) = envs.render()
    for _ in range(problem.episode_steps):
        observation, _, terminated, truncated, _ = envs.step(policy(observation))
        if bool(terminated | truncated):
            break
        (picture,) = envs.render()
    envs.close()
    return np.asarray(picture)


def main(folder: Path) -> None:
    """Import what the run in `folder` needs; then do runs named on standard input, one a line."""
    orders: SimpleQueue[tuple[str, str, str]] = SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            orders.put(json.loads(line))
        # The parent process has ended.
        os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    # Loads the method's libraries. Errors are raised again, and recorded, by `run`.
    with contextlib.suppress(Exception):
        method_options(requested_run(folder).facts["method"])
    while True:
        requested, device, teacher = orders.get()
        with Path(requested, OUTPUT).open("ab") as output:
            for number in (1, 2):
                os.dup2(output.fileno(), number)
        run(Path(requested), device, teacher)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        # Free the memory of a run for the next one.
        gc.collect()
        torch.cuda.empty_cache()


# The parent process. The start of a process (libraries, a GPU's context, kernels) takes longer than
# many runs, so that processes do several runs where possible.

PROGRAM = (sys.executable, "-m", "npa_envs.agents.comparison.single_run")

MEASURED = ("done", "diverged")
"""Statuses of runs that a resumed comparison does not repeat."""

LAST_OUTPUT = 2000
"""Maximum number of characters that are shown of a dead process's output."""


@dataclass
class RunProcess(Child):
    """A run in progress: its process, its temporary folder; `teacher`: folder of rules to clone."""

    job: Job
    teacher: str
    folder: Path
    process: subprocess.Popen[bytes]
    begin: float = 0.0

    @property
    def has_ended(self) -> bool:
        """Whether the run has ended."""
        return (self.folder / RECORD).exists() or self.process.poll() is not None

    def begin_work(self, device: str) -> None:
        """Order the waiting process to do the run on a device."""
        self.begin = time.perf_counter()
        assert self.process.stdin is not None, "opened at its start"
        # The death of a process is found and recorded later.
        with contextlib.suppress(BrokenPipeError):
            line = json.dumps([str(self.folder), device, self.teacher])
            self.process.stdin.write(f"{line}\n".encode())
            self.process.stdin.flush()

    def end(self) -> None:
        """Terminate the process, and remove the temporary folder."""
        self.process.terminate()
        self.process.communicate()
        shutil.rmtree(self.folder, ignore_errors=True)


def shares_process(plan: ComparisonPlan, job: Job) -> bool:
    """Return whether the process of a run may do other runs before and after it.

    Runs of a time budget, and of functions that may leave objects in memory, each have a process.
    """
    from_outside = ":" in plan.own.get(job.method, job.method)
    # Other systems cannot rename a folder in which a process has an open file.
    return os.name == "posix" and job.axis == "particle-steps" and not from_outside


def held_records(plan: ComparisonPlan, folder: Path) -> dict[Job, RunRecord]:
    """Return the records of a plan's runs in a folder, by job, except of runs that failed."""
    records = {job: RunRecord.read(folder / job.folder, plan.facts(job)) for job in plan.jobs()}
    return {job: one for job, one in records.items() if one is not None and one.status in MEASURED}


def _check_teachers(plan: ComparisonPlan, jobs: Sequence[Job], folder: Path) -> None:
    """Check that runs whose rules are cloned are among the jobs or in the comparison's folder."""
    for job in jobs:
        teacher = plan.teacher(job)
        if teacher is None or teacher in jobs:
            continue
        record = RunRecord.read(folder / teacher.folder, plan.facts(teacher))
        if record is None or record.status not in MEASURED:
            raise NPAError(
                f"{job.method!r} clones the rules of {teacher.method!r} from the same seed, but "
                f"{teacher} is neither in {str(folder)!r} nor to be run: add --methods "
                f"{teacher.method}, or name a rule by --options {job.method}.teacher=NAME"
            )


def run_jobs(
    plan: ComparisonPlan,
    jobs: Sequence[Job],
    folder: Path,
    slots: Slots,
    *,
    command: str = "",
    max_seconds: float = math.inf,
    written: Callable[[RunRecord], None] = lambda record: None,
) -> None:
    """Run jobs of a plan in processes; a failed run is recorded, and the others continue.

    A process does several runs with budgets of particle-steps, as long as none fails. Other runs
    have a process each; on GPUs it loads its libraries while an earlier run learns. A run's folder
    appears when the run is over. An interrupt ends all processes and removes unfinished folders.
    No run starts after `max_seconds`. `command` is the comparison's, `folder` its folder; `written`
    is called with each record.
    """
    _check_teachers(plan, jobs, folder)
    # Remove unfinished runs of a killed comparison.
    for job in jobs:
        target = folder / job.folder
        for unfinished in target.parent.glob(f".{target.name}.*"):
            shutil.rmtree(unfinished, ignore_errors=True)
    waiting = list(jobs)
    idle: list[subprocess.Popen[bytes]] = []

    def start(unfinished: Sequence[RunProcess]) -> RunProcess | None:
        pending = {*waiting, *(one.job for one in unfinished)}
        for job in waiting:
            teacher = plan.teacher(job)
            if teacher not in pending:
                waiting.remove(job)
                target = folder / job.folder
                temporary = target.parent / f".{target.name}.{secrets.token_hex(4)}"
                temporary.mkdir(parents=True)
                request = {"job": asdict(job), "facts": plan.facts(job), "command": command}
                write_record(temporary / REQUEST, request)
                (temporary / OUTPUT).touch()
                reused = idle and shares_process(plan, job)
                process = idle.pop() if reused else _new_process(temporary, slots.threads)
                rules = "" if teacher is None else str(folder / teacher.folder)
                return RunProcess(job, rules, temporary, process)
        return None

    def finished(one: RunProcess) -> None:
        reusable = shares_process(plan, one.job)
        if not reusable:
            one.process.communicate()
        record = _finish(one, folder)
        if reusable and record.status in MEASURED and one.process.poll() is None:
            idle.append(one.process)
        else:
            one.process.communicate()
        written(record)

    try:
        run_children(
            start,
            finished,
            slots,
            starts_early=slots.starts_early and not all(shares_process(plan, job) for job in jobs),
            max_seconds=max_seconds,
        )
    finally:
        for process in idle:
            process.communicate()


def _new_process(folder: Path, threads: int) -> subprocess.Popen[bytes]:
    """Start and return a process that loads the libraries of a run and waits for orders."""
    with (folder / OUTPUT).open("wb") as output:
        return subprocess.Popen(
            [*PROGRAM, str(folder)],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env=os.environ | {"OMP_NUM_THREADS": str(threads)},
        )


def _finish(one: RunProcess, folder: Path) -> RunRecord:
    """Move the files of an ended run from its temporary folder to its own; return its record."""
    requested = requested_run(one.folder)
    record = RunRecord.read(one.folder, requested.facts)
    if record is None:
        code = one.process.returncode
        text = (one.folder / OUTPUT).read_text("utf-8", errors="replace").strip()[-LAST_OUTPUT:]
        error = f"its process ended with code {code}: {' '.join(text.split())}"
        record = replace(requested, error=error).write_ended(one.folder, one.begin)
    (one.folder / REQUEST).unlink(missing_ok=True)
    target = folder / one.job.folder
    if target.exists():
        # A failed run, or one without a record.
        shutil.rmtree(target)
    os.replace(one.folder, target)
    return record


if __name__ == "__main__":
    main(Path(sys.argv[1]))
