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
from typing import Annotated, Any

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError, suggest
from npa_envs.files import read_json, write_text
from npa_envs.measure.record import NONE, markdown_table, read_record, write_record
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


@dataclass
class SweepRun(Child):
    """One combination: a process that trains, or goes on training, in a folder."""

    values: Mapping[str, str]
    """Values by option."""
    words: list[str]
    """Words after `npa-envs train`."""
    folder: Path
    threads: int = 1
    process: subprocess.Popen[bytes] | None = None
    begin: float = 0.0

    @property
    def name(self) -> str:
        """The name of its folder."""
        return self.folder.name

    def go(self, device: str) -> None:
        """Start it on a device."""
        self.begin = time.perf_counter()
        self.folder.mkdir(parents=True, exist_ok=True)
        given = ("--out", str(self.folder), "--device", device, "--resume", "auto")
        with (self.folder / OUTPUT).open("wb") as output:
            self.process = subprocess.Popen(
                [*PROGRAM, *self.words, *given, "--no-progress"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=os.environ | {"OMP_NUM_THREADS": str(self.threads)},
                # A terminal sends Ctrl-C to its whole group; `stop` would be a second signal,
                # after which a run ends without a checkpoint.
                start_new_session=True,
            )

    @property
    def over(self) -> bool:
        """Whether the process has ended."""
        return self.process is not None and self.process.poll() is not None

    def stop(self, *, at_once: bool) -> None:
        """Ask it to write its checkpoint and end, or only to end."""
        if self.process is not None:
            (self.process.kill if at_once else self.process.terminate)()

    def end(self) -> None:
        """Wait until it has ended after `stop`."""
        if self.process is not None:
            self.process.wait()

    def write(self) -> None:
        """Write its words, exit code and wall time [s]."""
        assert self.process is not None, "it is over"
        seconds = time.perf_counter() - self.begin
        held = {"code": int(self.process.returncode), "seconds": seconds}
        write_record(self.folder / RECORD, {"facts": {"words": self.words}, **held})

    def record(self) -> tuple[int, float] | None:
        """Return the exit code and time that were written; None: none. Refuses other words."""

        def read(held: dict[str, Any]) -> tuple[int, float]:
            return int(held["code"]), float(held["seconds"])

        return read_record(self.folder / RECORD, {"words": self.words}, read, command="sweep")

    @property
    def done(self) -> bool:
        """Whether it has ended well, as its record says."""
        held = self.record()
        return held is not None and held[0] == 0


def main(arguments: Sequence[str]) -> int:
    """Run what is missing, print and write; return 1 where a run failed."""
    words = list(arguments)
    place = words.index("--") if "--" in words else len(words)
    options = common.parse_options(SweepOptions, "sweep", words[:place])
    common.check_numbers(options, jobs=1, threads=1)
    folder = common.writable_folder(options.out)
    runs = combinations(options.over, words[place + 1 :], folder, options.threads)
    mine = part_of(runs, options.part, lambda run: run.name)
    waiting = [run for run in mine if not run.done]
    places = Places(options.devices, options.jobs or len(options.devices), options.threads)
    with common.StepBar(len(waiting), show=options.progress, unit="run") as bar:

        def finished(run: SweepRun) -> None:
            run.write()
            write_text(folder / TABLE, table(runs))
            bar.advance(1)

        try:
            run_children(
                lambda _: waiting.pop(0) if waiting else None,
                finished,
                places,
                ahead=False,
                max_seconds=options.max_seconds,
            )
        except KeyboardInterrupt:
            left_count = sum(not run.done for run in mine)
            print(f"interrupted; {left_count} runs are left: call again with the same words")
            raise
    text = table(runs)
    write_text(folder / TABLE, text)
    print(text, end="")
    left = [run for run in mine if not run.done]
    failed = [run for run in left if (run.folder / RECORD).exists()]
    for run in failed:
        said = (run.folder / OUTPUT).read_text("utf-8", errors="replace").strip()[-SHOWN:]
        print(f"{run.name} failed: {' '.join(said.split())}")
    if len(left) > len(failed):
        print(f"{len(left) - len(failed)} runs are left: call again with the same words")
    return RUN_FAILED if failed else 0


def combinations(
    over: Sequence[str], common: Sequence[str], folder: Path = Path(), threads: int = 1
) -> list[SweepRun]:
    """Return a run for each combination of values NAME=A,B,C, with a task and common options."""
    from npa_envs.training import TASKS

    if not common or common[0] not in TASKS:
        cure = suggest(common[0], TASKS) if common else ", ".join(TASKS)
        raise NPAError(f"the words after -- must begin with a task of npa-envs train: {cure}")
    given = {_option(word.partition("=")[0]) for word in common if word.startswith("--")}
    values: dict[str, list[str]] = {}
    for word in over:
        name, mark, listed = word.partition("=")
        name, each = _option(name), listed.split(",")
        if not (mark and name and all(each)):
            raise NPAError(f"over must be NAME=A,B,C, got {word!r}: seed=0,1,2")
        if name in values or name in given:
            raise NPAError(f"--{name} must be given once, in --over or after --, got it twice")
        values[name] = each
        twice = [value for value, count in Counter(each).items() if count > 1]
        if twice:
            raise NPAError(f"over must name each value once, got {word!r}: leave out {twice[0]!r}")
    for name in OWN:
        if name in values or name in given:
            raise NPAError(f"--{name} must not be given to the runs: a sweep does so by itself")
    chosen = [dict(zip(values, one, strict=True)) for one in itertools.product(*values.values())]
    runs = []
    for one, name in zip(chosen, _folder_names(chosen), strict=True):
        own = [word for option, value in one.items() for word in (f"--{option}", value)]
        runs.append(SweepRun(one, [*common, *own], folder / name, threads))
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


def table(runs: Sequence[SweepRun]) -> str:
    """Return the runs with the scores of their reports, in Markdown."""
    from npa_envs.measure.quality import score_line

    lines = []
    for run in runs:
        state, seconds, scores = "not run", NONE, NONE
        held = run.record()
        if held is not None:
            state = "done" if held[0] == 0 else f"failed with code {held[0]}"
            seconds = f"{held[1]:.0f}"
            reports = sorted((run.folder / "report").glob("rule*.json"))
            scores = "; ".join(score_line(read_json(report)) for report in reports) or NONE
        lines.append([*run.values.values(), state, seconds, scores])
    names = list(runs[0].values) if runs else []
    return markdown_table([*names, "run", "seconds", "measured"], lines) + "\n"
