"""`npa-envs sweep`: one training run for each combination of options, over several devices."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import tyro

from npa_envs.atomic_files import read_json, write_text
from npa_envs.cli import common
from npa_envs.errors import NPAError, suggest
from npa_envs.measure.benchmark_records import NONE, markdown_table, read_record, write_record
from npa_envs.measure.process_queue import Child, Slots, part_of, run_children

RECORD, OUTPUT, TABLE = "run.json", "output.txt", "sweep.md"
"""Files: record and output of a run, and the table of all runs."""

RESERVED = ("out", "device", "resume", "overwrite", "max-seconds", "processes", "gpus")
"""Options of `npa-envs train` that a sweep sets itself, or that would break it."""

PROGRAM = (sys.executable, "-m", "npa_envs", "train")


@dataclass(frozen=True, kw_only=True)
class SweepOptions(common.PartOptions):
    """Train with every combination of some options, each run in its own process.

    The arguments after `--` are those of `npa-envs train`, the same for all runs. A stopped sweep
    continues: finished runs stay as they are, started ones resume from their checkpoints, failed
    ones are tried again. Ctrl-C or SIGTERM lets runs write checkpoints; a second one ends them at
    once. The exit code is 1 if a run failed.

    Examples:
      npa-envs sweep --over target=heart,ring seed=0,1,2 --devices cuda:0 cuda:1 -- morphogenesis2d
    """

    over: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=A,B,C")]
    """Options of `npa-envs train` with the values to try: target=heart,ring seed=0,1,2."""
    out: Path = Path("runs/sweep")
    """Folder with a folder for each run, named by its values, and sweep.md, the table of all."""
    devices: tuple[str, ...] = ("cpu",)
    """Devices to distribute the runs over, for example cuda:0 cuda:1."""
    jobs: int | None = None
    """Runs at the same time; default: one for each device."""
    progress: bool = True
    """Show a progress bar."""


@dataclass
class SweepRun(Child):
    """A training process for one combination of values; starts or resumes the run in a folder."""

    values: Mapping[str, str]
    """Values by option."""
    arguments: list[str]
    """Arguments after `npa-envs train`."""
    folder: Path
    process: subprocess.Popen[bytes] = field(init=False)
    start_time: float = 0.0

    def begin_work(self, device: str) -> None:
        """Start the training process on a device."""
        self.start_time = time.perf_counter()
        self.folder.mkdir(parents=True, exist_ok=True)
        where = ("--out", str(self.folder), "--device", device)
        with (self.folder / OUTPUT).open("wb") as output:
            self.process = subprocess.Popen(
                [*PROGRAM, *self.arguments, *where, "--resume", "auto", "--no-progress"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
                # A terminal sends Ctrl-C to its whole group; `stop` would be a second signal,
                # after which a run ends without a checkpoint.
                start_new_session=True,
            )

    @property
    def has_ended(self) -> bool:
        """Whether the process has ended."""
        return self.process.poll() is not None

    def stop(self, *, at_once: bool) -> None:
        """Ask the process to end, after a checkpoint unless `at_once`."""
        (self.process.kill if at_once else self.process.terminate)()

    def end(self) -> None:
        """Wait for the process."""
        self.process.wait()

    def write(self) -> None:
        """Write the run's arguments, exit code and wall time [s] to its record."""
        seconds = time.perf_counter() - self.start_time
        result = {"code": int(self.process.returncode), "seconds": seconds}
        write_record(self.folder / RECORD, {"facts": {"words": self.arguments}, **result})

    def record(self) -> tuple[int, float] | None:
        """Return the recorded exit code and wall time [s], or None if the run has no record."""
        return read_record(
            self.folder / RECORD,
            {"words": self.arguments},
            lambda content: (int(content["code"]), float(content["seconds"])),
            command="sweep",
        )

    @property
    def done(self) -> bool:
        """Whether the run's record says that it ended without an error."""
        record = self.record()
        return record is not None and record[0] == 0


def main(arguments: Sequence[str]) -> int:
    """Train the missing runs, print and write the table; return 1 if a run failed."""
    split = arguments.index("--") if "--" in arguments else len(arguments)
    options = common.parse_options(SweepOptions, "sweep", arguments[:split])
    common.check_numbers(options, jobs=1)
    folder = common.writable_folder(options.out)
    runs = combinations(options.over, arguments[split + 1 :], folder)
    part_runs = part_of(runs, options.part, lambda run: run.folder.name)
    waiting = [run for run in part_runs if not run.done]
    slots = Slots(options.devices, options.jobs or len(options.devices))
    hint = "runs are left: call again with the same arguments"
    with common.progress_bar(len(waiting), show=options.progress, unit="run") as advance:

        def start(_: Sequence[SweepRun]) -> SweepRun | None:
            return waiting.pop(0) if waiting else None

        def finished(run: SweepRun) -> None:
            run.write()
            write_text(folder / TABLE, table(runs))
            advance(1)

        try:
            run_children(start, finished, slots, max_seconds=options.max_seconds)
        except KeyboardInterrupt:
            print(f"interrupted; {sum(not run.done for run in part_runs)} {hint}")
            raise
    text = table(runs)
    write_text(folder / TABLE, text)
    print(text, end="")
    unfinished = [run for run in part_runs if not run.done]
    failed = [run for run in unfinished if (run.folder / RECORD).exists()]
    for run in failed:
        output = (run.folder / OUTPUT).read_text("utf-8", errors="replace").strip()
        print(f"{run.folder.name} failed: {' '.join(output[-300:].split())}")
    if len(unfinished) > len(failed):
        print(f"{len(unfinished) - len(failed)} {hint}")
    return 1 if failed else 0


def combinations(
    over: Sequence[str], task_words: Sequence[str], folder: Path = Path()
) -> list[SweepRun]:
    """Return a run for each combination of the values of `over`, each NAME=A,B,C.

    A run has the arguments `task_words` and its values, and a folder of its own below `folder`.
    """
    from npa_envs.training import TASKS

    if not task_words or task_words[0] not in TASKS:
        hint = suggest(task_words[0], TASKS) if task_words else ", ".join(TASKS)
        raise NPAError(f"the arguments after -- must begin with a task of npa-envs train: {hint}")
    used = [_option_name(word.partition("=")[0]) for word in task_words if word.startswith("--")]
    values: dict[str, list[str]] = {}
    for word in over:
        name, _, listed = word.partition("=")
        name, each = _option_name(name), listed.split(",")
        if not (name and all(each)):
            raise NPAError(f"over must be NAME=A,B,C, got {word!r}: seed=0,1,2")
        if name in used:
            raise NPAError(f"--{name} must be given once, in --over or after --, got it twice")
        if len(set(each)) < len(each):
            raise NPAError(f"over must name each value once, got {word!r}: leave the others out")
        values[name] = each
        used.append(name)
    for name in {*RESERVED} & {*used}:
        raise NPAError(f"--{name} must not be given to the runs: a sweep does so by itself")
    runs = []
    for combination in itertools.product(*values.values()):
        run_values = dict(zip(values, combination, strict=True))
        options = [word for name, value in run_values.items() for word in (f"--{name}", value)]
        name = ",".join(f"{name}={quote(value, safe='')}" for name, value in run_values.items())
        runs.append(SweepRun(run_values, [*task_words, *options], folder / name))
    return runs


def _option_name(word: str) -> str:
    return word.removeprefix("--").replace("_", "-")


def table(runs: Sequence[SweepRun]) -> str:
    """Return a Markdown table of runs: values, how each ended, wall time [s], reports' scores."""
    from npa_envs.measure.quality import score_line

    rows = []
    for run in runs:
        state, seconds, scores = "not run", NONE, NONE
        record = run.record()
        if record is not None:
            state = "done" if record[0] == 0 else f"failed with code {record[0]}"
            seconds = f"{record[1]:.0f}"
            reports = sorted((run.folder / "report").glob("rule*.json"))
            scores = "; ".join(score_line(read_json(report)) for report in reports) or NONE
        rows.append([*run.values.values(), state, seconds, scores])
    return markdown_table([*runs[0].values, "run", "seconds", "measured"], rows) + "\n"
