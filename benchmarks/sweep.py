"""One training run for each combination of options, each in its own process, over several devices.

    python benchmarks/sweep.py --over target=heart,ring seed=0,1,2 --devices cuda:0 cuda:1 \\
        --out runs/sweep -- morphogenesis2d --preset fast

The arguments after `--` are those of `npa-envs train`, the same for all runs. A stopped sweep
continues: finished runs stay as they are, started ones resume from their checkpoints, failed ones
are tried again. Ctrl-C or SIGTERM lets runs write checkpoints; a second one ends them at once. The
exit code is 1 if a run failed.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from tqdm import tqdm

from npa_envs.atomic_files import read_json, write_text
from npa_envs.errors import NPAError, suggest
from npa_envs.measure.benchmark_records import NONE, markdown_table, read_record, write_record
from npa_envs.measure.process_queue import Child, Slots, part_of, run_children
from npa_envs.measure.quality import score_line
from npa_envs.training import TASKS

RECORD, OUTPUT, TABLE = "run.json", "output.txt", "sweep.md"
"""Files: record and output of a run, and the table of all runs."""

RESERVED = ("out", "device", "resume", "overwrite", "max-seconds", "processes", "gpus")
"""Options of `npa-envs train` that a sweep sets itself, or that would break it."""

PROGRAM = (sys.executable, "-m", "npa_envs", "train")

LEFT = "runs are left: call again with the same arguments"


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


def combinations(
    over: Sequence[str], task_words: Sequence[str], folder: Path = Path()
) -> list[SweepRun]:
    """Return a run for each combination of the values of `over`, each NAME=A,B,C.

    A run has the arguments `task_words` and its values, and a folder of its own below `folder`.
    """
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


def parsed(words: Sequence[str]) -> argparse.Namespace:
    """Return the options of the command line, and as `task_words` what follows `--`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--over", nargs="+", required=True, metavar="NAME=A,B", help="options and their values")
    add("--out", type=Path, default=Path("runs/sweep"), help="folder with one for each run")
    add("--devices", nargs="+", default=["cpu"], help="devices to distribute the runs over")
    add("--jobs", type=int, help="runs at the same time; default: one for each device")
    add("--part", metavar="K/N", help="run only the K-th of N parts; machines share --out")
    add("--max-seconds", type=float, default=math.inf, help="start nothing more after this time")
    split = words.index("--") if "--" in words else len(words)
    options = parser.parse_args(words[:split])
    options.task_words = words[split + 1 :]
    return options


def main(words: Sequence[str]) -> int:
    """Train the missing runs, print and write the table; return 1 if a run failed."""
    options = parsed(words)
    if options.jobs is not None and options.jobs < 1:
        raise NPAError(f"jobs must be at least 1, got {options.jobs}")
    runs = combinations(options.over, options.task_words, options.out)
    part_runs = part_of(runs, options.part, lambda run: run.folder.name)
    waiting = [run for run in part_runs if not run.done]
    options.out.mkdir(parents=True, exist_ok=True)
    with tqdm(total=len(waiting), unit="run") as bar:

        def start(_: Sequence[SweepRun]) -> SweepRun | None:
            return waiting.pop(0) if waiting else None

        def finished(run: SweepRun) -> None:
            run.write()
            write_text(options.out / TABLE, table(runs))
            bar.update()

        slots = Slots(options.devices, options.jobs or len(options.devices))
        try:
            run_children(start, finished, slots, max_seconds=options.max_seconds)
        except KeyboardInterrupt:
            print(f"interrupted; {sum(not run.done for run in part_runs)} {LEFT}")
            return 130
    text = table(runs)
    write_text(options.out / TABLE, text)
    print(text, end="")
    unfinished = [run for run in part_runs if not run.done]
    failed = [run for run in unfinished if (run.folder / RECORD).exists()]
    for run in failed:
        output = (run.folder / OUTPUT).read_text("utf-8", errors="replace").strip()
        print(f"{run.folder.name} failed: {' '.join(output[-300:].split())}")
    if len(unfinished) > len(failed):
        print(f"{len(unfinished) - len(failed)} {LEFT}")
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except NPAError as error:
        sys.exit(f"sweep: error: {error}")
