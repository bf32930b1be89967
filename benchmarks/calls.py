"""Times of calls in loops of one's own [µs], of this checkout and an older one in turn.

    git worktree add ../older b80614a
    python benchmarks/calls.py --base ../older --output FILE
    python benchmarks/calls.py --whole --output FILE   # cuda_graph="whole" beside "auto"

call_lines.py has the calls. Each checkout has one process that keeps its worlds; every call is read
in both, one after the other, `--pairs` times, and which comes first alternates. Rows have the
medians. They become FILE's entry `cpu`, `cuda` or `whole`; its other entries stay.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from call_lines import worlds
from scripts import script_facts, script_parser

import npa_envs
from npa_envs.atomic_files import read_json
from npa_envs.measure.benchmark_records import write_record

HERE = Path(__file__).resolve().parent
WHOLE_SIZES = (
    *((1, 64), (1, 256), (1, 512), (16, 100), (64, 256), (128, 512)),
    *((256, 512), (1024, 128), (1024, 256), (4096, 64), (1024, 512)),
)
"""B, N of the worlds that `--whole` runs."""
WHOLE_STEPS = (1, 2, 4, 8, 32)
WHOLE_READINGS, WARM_CALLS = 9, 4


class Checkout:
    """A process with the calls of one checkout."""

    def __init__(self, root: Path, device: str) -> None:
        paths = [str(root.resolve()), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "call_lines.py"), device],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            encoding="utf-8",
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        )
        self.calls: list[tuple[Any, ...]] = [tuple(call) for call in json.loads(self._answer())]

    def _answer(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def time(self, call: tuple[Any, ...]) -> float | str:
        """Return a call's time [µs], or why there is none."""
        if call not in self.calls:
            return "unknown"
        assert self.process.stdin is not None
        self.process.stdin.write(f"{self.calls.index(call)}\n")
        self.process.stdin.flush()
        answer = self._answer().strip()
        try:
            return float(answer)
        except ValueError:
            return answer


def call_rows(base: Path | None, device: str, pairs: int) -> list[dict[str, Any]]:
    """Return a row for each call; without `base` those of this checkout alone."""
    roots = {"us": HERE.parent} | ({} if base is None else {"base_us": base})
    checkouts = {key: Checkout(root, device) for key, root in roots.items()}
    calls = checkouts["us"].calls
    found: dict[Any, list[float]] = {(call, key): [] for call in calls for key in roots}
    for pair in range(pairs):
        for call in calls:
            for key in list(roots)[:: -1 if pair % 2 else 1]:
                time_us = checkouts[key].time(call)
                if isinstance(time_us, float):
                    found[call, key].append(time_us)
                elif pair == 0:
                    print(f"{call} {key}: {time_us}", flush=True)
    rows = []
    for call in calls:
        row = dict(zip(("call", "world_count", "particle_count"), call, strict=True))
        for key in roots:
            row[key] = statistics.median(found[call, key]) if found[call, key] else None
        rows.append(row)
    return rows


@torch.no_grad()
def whole_rows() -> list[dict[str, Any]]:
    """Return times of rollouts in one kernel and as they are run by default [µs], on CUDA.

    `call_us` is what a loop waits that synchronises after each call, `step_us` what a step takes
    between events on the device.
    """
    rule, rows = npa_envs.NPARule(2, 16, 128).cuda(), []
    for size in WHOLE_SIZES:
        x, s = worlds(*size, "cuda")
        for steps in WHOLE_STEPS:
            times: dict[str, list[float]] = {}
            for reading in range(WARM_CALLS + WHOLE_READINGS):
                for way in ("whole", "auto"):
                    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
                    torch.cuda.synchronize()
                    begun = time.perf_counter()
                    begin.record()
                    npa_envs.rollout(rule, x, s, steps, update_prob=0.5, cuda_graph=way)
                    end.record()
                    torch.cuda.synchronize()
                    wall = (time.perf_counter() - begun) * 1e6
                    if reading >= WARM_CALLS:
                        times.setdefault(f"{way}_call_us", []).append(wall)
                        device = begin.elapsed_time(end) * 1e3 / steps
                        times.setdefault(f"{way}_step_us", []).append(device)
            row: dict[str, Any] = dict(zip(("world_count", "particle_count"), size, strict=True))
            row |= {"steps": steps} | {k: statistics.median(v) for k, v in times.items()}
            rows.append(row)
    return rows


def main() -> None:
    """Measure, print and write."""
    parser = script_parser(__doc__)
    parser.add_argument("--base", type=Path, help="folder of the older checkout")
    parser.add_argument("--pairs", type=int, default=5, help="readings of each call")
    parser.add_argument("--whole", action="store_true", help='only cuda_graph="whole"')
    arguments = parser.parse_args()
    if arguments.whole:
        name, rows = "whole", whole_rows()
    else:
        name = torch.device(arguments.device).type
        rows = call_rows(arguments.base, name, arguments.pairs)
    for row in rows:
        print(*(f"{v:.1f}" if isinstance(v, float) else v for v in row.values()), flush=True)
    if arguments.output:
        before = read_json(arguments.output) if arguments.output.exists() else {}
        record = script_facts(arguments) | {"rows": rows}
        write_record(arguments.output, before | {name: record})


if __name__ == "__main__":
    main()
