"""Kill one process of a distributed run at random times, and check what is left.

    python benchmarks/kills.py --out runs/kills.jsonl
    python benchmarks/kills.py --device cuda --preset paper --interval 50 --kills 1

A line is a JSON object: the last iteration in the log when the process was killed, that of the
checkpoint, seconds from the kill to the launcher's end, its exit code, and processes left over.
Each run continues from the checkpoint of the one before, with `--resume auto`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from npa_envs.training import JsonlLog, RunFolder
from npa_envs.training.checkpoint import load_checkpoint

PATIENCE = 120.0
"""Seconds that a run may take to begin, and to end."""


def main() -> None:
    """Kill runs, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--preset", default="tiny")
    parser.add_argument("--interval", type=int, default=5, help="iterations between checkpoints")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file for the lines, besides the terminal")
    told = parser.parse_args()
    chance, before, lines = random.Random(told.seed), 0, []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(told.kills):
            line = killed(RunFolder(Path(folder)), told, chance, before)
            before = line["checkpoint"]
            lines.append(json.dumps(line))
            print(lines[-1], flush=True)
            if told.out is not None:
                told.out.write_text("\n".join(lines) + "\n", "utf-8")


def killed(
    folder: RunFolder, told: argparse.Namespace, chance: random.Random, before: int
) -> dict[str, float]:
    """Start or resume the run, kill one of its processes, and return what is left of it."""
    words = ["train", "morphogenesis2d", "--preset", told.preset, "--out", str(folder.path)]
    words += ["--processes", str(told.processes), "--device", told.device, "--resume", "auto"]
    words += ["--iterations", "1000000", "--checkpoint-interval", str(told.interval)]
    words += ["--log-interval", "1", "--no-tensorboard", "--no-progress"]
    run = subprocess.Popen(
        [sys.executable, "-m", "npa_envs", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
    )
    begun = time.monotonic()
    while last_iteration(folder) <= before + told.interval:
        if run.poll() is not None or time.monotonic() - begun > PATIENCE:
            run.kill()
            raise SystemExit(f"the run did not begin:\n{run.communicate()[0]}")
        time.sleep(0.05)
    time.sleep(chance.random())
    workers = children(run.pid)
    os.kill(chance.choice(workers), signal.SIGKILL)
    moment = time.monotonic()
    run.communicate(timeout=PATIENCE)
    seconds = time.monotonic() - moment
    return {
        "last_iteration": last_iteration(folder),
        "checkpoint": load_checkpoint(folder.checkpoint)["iteration"],
        "seconds": round(seconds, 2),
        "code": run.returncode,
        "processes_left": sum(map(alive, workers)),
    }


def last_iteration(folder: RunFolder) -> int:
    """Return the last iteration in the log."""
    records = JsonlLog(folder.log).records()
    return int(records[-1]["iteration"]) if records else 0


def children(pid: int) -> list[int]:
    """Return the ids of a process's child processes (Linux)."""
    told = Path(f"/proc/{pid}/task/{pid}/children").read_text("utf-8")
    return [int(child) for child in told.split()]


def alive(pid: int) -> bool:
    """Return whether the process `pid` runs (Linux)."""
    try:
        told = Path(f"/proc/{pid}/stat").read_text("utf-8")
    except FileNotFoundError:
        return False
    return told.rpartition(")")[2].split()[0] != "Z"


if __name__ == "__main__":
    main()
