"""One world of up to 1e8 particles on one GPU: time of a step, and peak of memory.

    python benchmarks/large_worlds.py --out results.json

Worlds are as dense as those of `npa-envs bench` (66 neighbours), with 16 channels and an untrained
rule of 128 hidden units. Memory is all that torch has held, worlds at the beginning included.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from npa_envs.measure.speed.throughput import rollout_call
from npa_envs.measure.speed.workloads import Workload

INFERENCE = (2**22, 2**24, 40_000_000, 100_000_000, 120_000_000)
TRAINING = (2**22, 2**24)


def measured(
    particle_count: int, steps: int, device: torch.device, *, train: bool
) -> dict[str, object]:
    """Return what a rollout of a world takes."""
    workload = Workload(2, 1, particle_count, steps)
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    x, s = workload.worlds(device)
    options = {"cuda_graph": False}
    call, _ = rollout_call(
        workload, x, s, train=train, memory="minimal" if train else "store", **options
    )
    call()
    times = []
    for _ in range(3):
        torch.cuda.synchronize(device)
        start = time.perf_counter()
        call()
        torch.cuda.synchronize(device)
        times.append((time.perf_counter() - start) / steps)
    best = sorted(times)[1]
    return {
        "particles": particle_count,
        "steps": steps,
        "train": train,
        "ms_a_step": round(best * 1e3, 3),
        "particle_steps_a_second": round(particle_count / best),
        "peak_gib": round(torch.cuda.max_memory_allocated(device) / 2**30, 2),
        "worlds_gib": round((x.nbytes + s.nbytes) / 2**30, 2),
    }


def main() -> None:
    """Measure and write one line after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--inference", type=int, nargs="*", default=INFERENCE)
    parser.add_argument("--training", type=int, nargs="*", default=TRAINING)
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--training-steps", type=int, default=16)
    told = parser.parse_args()
    device = torch.device("cuda", torch.cuda.current_device())
    lines = [{"device": torch.cuda.get_device_name(device)}]
    asked = [(n, told.steps, False) for n in told.inference]
    asked += [(n, told.training_steps, True) for n in told.training]
    for particle_count, steps, train in asked:
        try:
            line = measured(particle_count, steps, device, train=train)
        except Exception as error:
            line = {"particles": particle_count, "train": train, "error": str(error)[:500]}
        print(json.dumps(line), flush=True)
        lines.append(line)
        if told.out is not None:
            told.out.write_text(json.dumps(lines, indent=1) + "\n")


if __name__ == "__main__":
    main()
