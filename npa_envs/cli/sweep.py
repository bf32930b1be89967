"""`npa-envs sweep`: many training runs, one for each combination of options, over devices."""

from __future__ import annotations

import hashlib
import itertools
import math
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

from npa_envs.cli.output import StepBar, check_numbers, parse_options, writable_folder
from npa_envs.errors import NPAError, suggest
from npa_envs.files import read_json, write_text
from npa_envs.measure.record import read_record, write_record
from npa_envs.measure.tables import NONE, markdown_table
from npa_envs.processes import Child, Places, part_of, run_children

RUN_FAILED = 1

RECORD, OUTPUT, TABLE = "run.json", "output.txt", "sweep.md"
"""Files: record and output of a run, and the table of all runs."""

OWN = ("out", "device", "resume", "overwrite", "max-seconds", "processes", "gpus")
"""Options of `npa-envs train` that a sweep gives by itself, or that would break it."""

PROGRAM = (sys.executable, "-m", "npa_envs", "train")

SHOWN, HASH = 300, 12
"""Characters of a failed run's last output, and of a hash in a folder's name."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Train with every combination of some options, each run a process of its own.

    The words after `--` are those of `npa-envs train` for all runs. A sweep that was stopped goes
    on where it was: runs that are over are left as they are, begun ones resume from their
    checkpoints, and failed ones are tried again. Ctrl-C or SIGTERM lets runs write checkpoints; a
    second one ends them at once. Ends with code 1 where a run failed.
    """

    over: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=A,B,C")]
    """Options of `npa-envs train` with the values to take: target=heart,ring seed=0,1,2."""
    out: Path = Path("runs/sweep")
    """Folder for a run's folder each, named by its values, and sweep.md, the table of all."""
    devices: tuple[str, ...] = ("cpu",)
    """Devices that runs are dealt out to, for example cuda:0 cuda:1."""
    jobs: int | None = None
    """Runs at once; default: one for each device."""
    threads: int = 1
    """CPU threads of each run."""
    part: Annotated[str | None, tyro.conf.arg(metavar="K/N")] = None
    """Run the K-th of N parts alone: a machine, or a task of a scheduler's array, takes one each,
    all with the same --out on a shared disk."""
    max_seconds: float = math.inf
    """No run begins after so long [s]; the next call goes on."""
    progress: bool = True
    """Show a progress bar."""


class SweepRun(NamedTuple):
    """One combination: values by option, words after `npa-envs train`, the name of its folder."""

    values: Mapping[str, str]
    words: list[str]
    name: str


class SweepRecord(NamedTuple):
    """The exit code of a run's process, and its wall time [s]."""

    code: int
    seconds: float


def main(arguments: Sequence[str]) -> int:
    """Run what is missing, print and write; return 1 where a run failed."""
    words = list(arguments)
    place = words.index("--") if "--" in words else len(words)
    options = parse_options(SweepOptions, "sweep", words[:place])
    check_numbers(options, jobs=1, threads=1)
    folder = writable_folder(options.out)
    runs = combinations(options.over, words[place + 1 :])
    mine = part_of(runs, options.part, lambda run: run.name)
    waiting = [run for run in mine if not is_over(folder, run)]
    places = Places(options.devices, options.jobs or len(options.devices), options.threads)
    with StepBar(len(waiting), show=options.progress, unit="run") as bar:

        def finished(child: _Training) -> None:
            child.write_record()
            write_text(folder / TABLE, table(folder, runs))
            bar.advance(1)

        try:
            run_children(
                lambda _: _Training(folder, waiting.pop(0), places.threads) if waiting else None,
                finished,
                places,
                ahead=False,
                max_seconds=options.max_seconds,
            )
        except KeyboardInterrupt:
            left_count = sum(not is_over(folder, run) for run in mine)
            print(f"interrupted; {left_count} runs are left: call again with the same words")
            raise
    text = table(folder, runs)
    write_text(folder / TABLE, text)
    print(text, end="")
    left = [run.name for run in mine if not is_over(folder, run)]
    failed = [name for name in left if (folder / name / RECORD).exists()]
    for name in failed:
        said = (folder / name / OUTPUT).read_text("utf-8", errors="replace").strip()[-SHOWN:]
        print(f"{name} failed: {' '.join(said.split())}")
    if len(left) > len(failed):
        print(f"{len(left) - len(failed)} runs are left: call again with the same words")
    return RUN_FAILED if failed else 0


def combinations(over: Sequence[str], common: Sequence[str]) -> list[SweepRun]:
    """Return a run for each combination of values NAME=A,B,C, with a task and common options."""
    from npa_envs.training import TASKS

    if not common or common[0] not in TASKS:
        cure = suggest(common[0], TASKS) if common else ", ".join(TASKS)
        raise NPAError(f"the words after -- must begin with a task of npa-envs train: {cure}")
    given = {_option(word.partition("=")[0]) for word in common if word.startswith("--")}
    values: dict[str, list[str]] = {}
    for word in over:
        name, mark, listed = word.partition("=")
        name = _option(name)
        if not (mark and name and all(listed.split(","))):
            raise NPAError(f"over must be NAME=A,B,C, got {word!r}: seed=0,1,2")
        if name in values or name in given:
            raise NPAError(f"--{name} must be given once, in --over or after --, got it twice")
        values[name] = listed.split(",")
        twice = [value for value, count in Counter(values[name]).items() if count > 1]
        if twice:
            raise NPAError(f"over must name each value once, got {word!r}: leave out {twice[0]!r}")
    for name in OWN:
        if name in values or name in given:
            raise NPAError(f"--{name} must not be given to the runs: a sweep does so by itself")
    chosen = [dict(zip(values, one, strict=True)) for one in itertools.product(*values.values())]
    runs = []
    for one, folder in zip(chosen, _folder_names(chosen), strict=True):
        own = [word for name, value in one.items() for word in (f"--{name}", value)]
        runs.append(SweepRun(one, [*common, *own], folder))
    return runs


def _option(word: str) -> str:
    """Return the name of an option as `npa-envs train` shows it."""
    return word.removeprefix("--").replace("_", "-")


def _folder_names(chosen: Sequence[Mapping[str, str]]) -> list[str]:
    """Return a folder's name for each combination; those that would be alike end with a hash."""
    full = [",".join(f"{name}={value}" for name, value in one.items()) for one in chosen]
    plain = [re.sub(r"[^\w=,.+-]", "_", words) for words in full]
    count = Counter(plain)
    return [
        name if count[name] == 1 else f"{name}-{hashlib.sha256(words.encode()).hexdigest()[:HASH]}"
        for name, words in zip(plain, full, strict=True)
    ]


def is_over(folder: Path, run: SweepRun) -> bool:
    """Return whether a run has ended well."""
    held = _record(folder, run)
    return held is not None and held.code == 0


def _record(folder: Path, run: SweepRun) -> SweepRecord | None:
    """Return the record of a run, None where there is none; one of other words is refused."""

    def read(held: dict[str, Any]) -> SweepRecord:
        return SweepRecord(int(held["code"]), float(held["seconds"]))

    path = folder / run.name / RECORD
    return read_record(path, {"words": run.words}, read, command="sweep")


class _Training(Child):
    """A process that trains, or goes on training, in its folder."""

    def __init__(self, folder: Path, run: SweepRun, threads: int) -> None:
        self._folder, self._run, self._threads = folder / run.name, run, threads
        self._process: subprocess.Popen[bytes] | None = None
        self._begin = 0.0

    def go(self, device: str) -> None:
        """Start it on a device."""
        self._begin = time.perf_counter()
        self._folder.mkdir(parents=True, exist_ok=True)
        given = ("--out", str(self._folder), "--device", device, "--resume", "auto")
        with (self._folder / OUTPUT).open("wb") as output:
            self._process = subprocess.Popen(
                [*PROGRAM, *self._run.words, *given, "--no-progress"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=os.environ | {"OMP_NUM_THREADS": str(self._threads)},
                # A terminal sends Ctrl-C to its whole group; `stop` would be a second signal,
                # after which a run ends without a checkpoint.
                start_new_session=True,
            )

    @property
    def over(self) -> bool:
        """Whether it has ended."""
        return self._process is not None and self._process.poll() is not None

    def stop(self, *, at_once: bool) -> None:
        """Ask it to write its checkpoint and end, or only to end."""
        if self._process is not None:
            (self._process.kill if at_once else self._process.terminate)()

    def end(self) -> None:
        """Wait until it has ended after `stop`."""
        if self._process is not None:
            self._process.wait()

    def write_record(self) -> None:
        """Write its words, exit code and time."""
        assert self._process is not None, "it is over"
        seconds = time.perf_counter() - self._begin
        record = SweepRecord(int(self._process.returncode), seconds)
        content = {"facts": {"words": self._run.words}, **record._asdict()}
        write_record(self._folder / RECORD, content)


def table(folder: Path, runs: Sequence[SweepRun]) -> str:
    """Return the runs with the scores of their reports, in Markdown."""
    from npa_envs.measure.quality import score_line

    lines = []
    for run in runs:
        state, seconds, scores = "not run", NONE, NONE
        held = _record(folder, run)
        if held is not None:
            state = "done" if held.code == 0 else f"failed with code {held.code}"
            seconds = f"{held.seconds:.0f}"
            reports = sorted((folder / run.name / "report").glob("rule*.json"))
            scores = "; ".join(score_line(read_json(report)) for report in reports) or NONE
        lines.append([*run.values.values(), state, seconds, scores])
    names = list(runs[0].values) if runs else []
    return markdown_table([*names, "run", "seconds", "measured"], lines) + "\n"
