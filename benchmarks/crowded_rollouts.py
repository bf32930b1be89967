"""Kernels of a rollout of shipped rules that have grown: what lists with a skin could save.

    python benchmarks/crowded_rollouts.py --device cuda [--output FILE]

Eight worlds of 4096 particles after 1000 steps; µs a step of the public call in a plain loop, the
median of eleven, and of each kernel of one more rollout by torch's profiler. Told beside is how far
the fastest particle moves in 20 steps. Sorting and density are what lists that are kept could save:
the search of all of it, not the sums of the densities.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

import npa_envs
from npa_envs.measure.record import script_facts, script_parser, write_record
from npa_envs.measure.speed.timing import synchronize
from npa_envs.rule.files import load_rule
from npa_envs.tasks.base import seed_worlds
from npa_envs.training.trained_tasks import task_of_rule

RULES = ("maze", "stripes", "cells", "gecko")
WORLDS, GROWN, STEPS, MOVED, READINGS = 8, 1000, 64, 20, 11


def measured(name: str, worlds: int, grown: int, device: torch.device) -> dict[str, Any]:
    """Return what a step of grown worlds of a rule takes."""
    rule = load_rule(name, device=device).float()
    task = task_of_rule(name, rule, device).task
    generator = torch.Generator(device).manual_seed(0)
    options = {"eps": task.eps, "box": task.box, "update_prob": task.update_prob}

    def roll(x: torch.Tensor, s: torch.Tensor, steps: int) -> Any:
        return npa_envs.rollout(rule, x, s, steps, generator=generator, **options)

    with torch.no_grad():
        x, s, _ = seed_worlds(task, worlds, generator=generator, device=device)
        x, s = roll(x, s, grown)
        later = roll(x, s, MOVED)[0] - x
        if task.box is not None:
            sides = torch.tensor(task.box, device=device)
            later = later - sides * torch.round(later / sides)
        times = []
        for reading in range(3 + READINGS):
            synchronize(device)
            begun = time.perf_counter()
            roll(x, s, STEPS)
            synchronize(device)
            if reading >= 3:
                times.append((time.perf_counter() - begun) / STEPS * 1e6)
        cuda = device.type == "cuda"
        with profile(activities=[ProfilerActivity.CUDA if cuda else ProfilerActivity.CPU]) as told:
            roll(x, s, STEPS)
            synchronize(device)
    kind = DeviceType.CUDA if cuda else DeviceType.CPU
    kernels = {
        entry.key: (entry.self_device_time_total if cuda else entry.self_cpu_time_total) / STEPS
        for entry in told.key_averages()
        if entry.device_type == kind
    }
    searching = sum(us for key, us in kernels.items() if "sort_" in key or "density" in key)
    return {
        "rule": name,
        "largest_move_eps": float(later.norm(dim=-1).max()) / task.eps,
        "step_us": statistics.median(times),
        "kernels_us": sum(kernels.values()),
        "sort_and_density_us": searching,
        "kernels": dict(sorted(kernels.items(), key=lambda item: -item[1])[:8]),
    }


def main() -> None:
    """Measure, print and write."""
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("--rules", nargs="+", default=RULES)
    parser.add_argument("--worlds", type=int, default=WORLDS)
    parser.add_argument("--grown", type=int, default=GROWN, help="steps before")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    rows = []
    for name in given.rules:
        row = measured(name, given.worlds, given.grown, torch.device(given.device))
        rows.append(row)
        print({key: value for key, value in row.items() if key != "kernels"}, flush=True)
        if given.output is not None:
            write_record(given.output, {**script_facts(given), "rows": rows})


if __name__ == "__main__":
    main()
