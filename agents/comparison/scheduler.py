"""Scheduler of runs over cores or GPUs: one process a run, each of which may fail by itself."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import shutil
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from npa_envs.agents.comparison.plan import Job, Plan
from npa_envs.agents.comparison.run import OUTPUT, REQUEST, Request, RunRecord
from npa_envs.measure.record import time_limit, write_record

PROGRAM = (sys.executable, "-m", "npa_envs.agents.comparison.run")
"""What a run's process is, before the folder of the run: it gets ready, begins when a line of its
input names a device, and ends when its input does."""

LOOK_SECONDS = 0.1
"""Pause between two looks at the processes [s]."""

MEASURED = ("done", "diverged")
"""Runs that a resumed comparison does not repeat."""

TOLD = 2000
"""Characters at most that are told of what a dead process said last."""


@dataclass(frozen=True)
class Places:
    """Where processes run."""

    devices: Sequence[str]
    """Devices, of which each process gets one."""
    jobs: int = 1
    """Processes at once; they are dealt out over the devices."""
    threads: int = 1
    """CPU threads of each."""

    def device(self, number: int) -> str:
        """Return the device of the process of a number below `jobs`."""
        return self.devices[number % len(self.devices)]

    @property
    def ahead(self) -> bool:
        """Whether the next process gets ready during a run: not on CPUs, which it would slow."""
        return not any(name.startswith("cpu") for name in self.devices)


@dataclass
class _Process:
    job: Job
    folder: Path
    process: subprocess.Popen[bytes]
    begin: float = 0.0

    def go(self, device: str) -> None:
        """Let it begin on a device."""
        assert self.process.stdin is not None, "asked for at its start"
        self.begin = time.perf_counter()
        # One that has died is found dead, and recorded, by whoever looks next.
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(f"{device}\n".encode())
            self.process.stdin.flush()

    def end(self) -> None:
        """End it, and leave nothing of it."""
        self.process.terminate()
        self.process.communicate()
        shutil.rmtree(self.folder, ignore_errors=True)


def held_records(plan: Plan, folder: Path) -> dict[Job, RunRecord]:
    """Return what an earlier comparison left in a folder, but for runs that failed.

    Raises:
        NPAError: A record cannot be read, or follows from other settings.
    """
    found = {job: RunRecord.read(folder / job.folder, plan.facts(job)) for job in plan.jobs()}
    return {
        job: record
        for job, record in found.items()
        if record is not None and record.status in MEASURED
    }


def run_jobs(
    plan: Plan,
    jobs: Sequence[Job],
    folder: Path,
    places: Places,
    *,
    command: str = "",
    max_seconds: float = math.inf,
    written: Callable[[RunRecord], None] = lambda record: None,
) -> None:
    """Run jobs, each in a process of its own; one that fails is recorded, and the others go on.

    On GPUs the process of the next run is started early, and waits until its turn comes. A run's
    results appear in its folder all at once, when it is over. If this is interrupted, its processes
    are ended and leave nothing.

    Args:
        plan: What they belong to.
        jobs: Which of the plan's runs.
        folder: The comparison's folder.
        places: Where.
        command: The command line, for the records.
        max_seconds: No run begins after so long [s].
        written: Called with each record once it is in its place.

    Raises:
        NPAError: The folder cannot be written to.
    """
    waiting, ready = deque(jobs), deque[_Process]()
    running: dict[int, _Process] = {}

    def start() -> _Process:
        return _start(plan, waiting.popleft(), folder, places, command)

    # What a killed comparison left of runs half-way.
    for job in jobs:
        target = folder / job.folder
        for left in target.parent.glob(f".{target.name}.*"):
            shutil.rmtree(left, ignore_errors=True)
    time_is_up = time_limit(max_seconds)
    try:
        while waiting or ready or running:
            if time_is_up():
                waiting.clear()
                while ready:
                    ready.pop().end()
            for number in range(places.jobs):
                if number not in running and (ready or waiting):
                    running[number] = ready.popleft() if ready else start()
                    running[number].go(places.device(number))
            while places.ahead and waiting and len(ready) < places.jobs:
                ready.append(start())
            for number, one in list(running.items()):
                if one.process.poll() is not None:
                    del running[number]
                    written(_finish(plan, one, folder, command))
            time.sleep(LOOK_SECONDS if running else 0.0)
    finally:
        for one in [*running.values(), *ready]:
            one.end()


def _start(plan: Plan, job: Job, folder: Path, places: Places, command: str) -> _Process:
    target = folder / job.folder
    part = target.parent / f".{target.name}.{secrets.token_hex(4)}"
    part.mkdir(parents=True)
    request = Request(job, plan.facts(job), places.threads, command)
    write_record(part / REQUEST, asdict(request))
    environment = os.environ | {"OMP_NUM_THREADS": str(places.threads)}
    with (part / OUTPUT).open("wb") as output:
        process = subprocess.Popen(
            [*PROGRAM, str(part)],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env=environment,
        )
    return _Process(job, part, process)


def _finish(plan: Plan, one: _Process, folder: Path, command: str) -> RunRecord:
    """Put the results of a process that is over into their place, and return its record."""
    one.process.communicate()
    request = Request(one.job, plan.facts(one.job), command=command)
    record = RunRecord.read(one.folder, request.facts)
    if record is None:
        code = one.process.returncode
        told = (one.folder / OUTPUT).read_text("utf-8", errors="replace").strip()[-TOLD:]
        error = f"its process ended with code {code}: {' '.join(told.split())}"
        record = request.record("failed", one.begin, error=error)
        record.write(one.folder)
    (one.folder / REQUEST).unlink(missing_ok=True)
    target = folder / one.job.folder
    if target.exists():
        # It holds a run that failed, or no record: else this one would not have been run.
        shutil.rmtree(target)
    os.replace(one.folder, target)
    return record
