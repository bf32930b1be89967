"""One world of up to 1e8 particles on one GPU: time of a step, and peak of memory.

    python benchmarks/large_worlds.py --out results.json

Worlds have the density of `npa-envs bench` (66 neighbours), 16 channels and an untrained rule with
128 hidden units. Memory is the peak allocated by torch, with the worlds.

The last line is a check. A world of 1e8 particles consists of copies of one of 2^20 that do not
perceive each other: after one and two steps of all particles each copy must equal the one at the
origin, up to rounding. Far from the origin coordinates are rounded more, which can move a moment
matrix over the threshold of its inverse, so that a few particles may differ by much.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from npa_envs.measure.speed.timing import Workload, rollout_call
from npa_envs.world.rollout import rollout

INFERENCE = (2**22, 2**24, 40_000_000, 100_000_000, 120_000_000)
TRAINING = (2**22, 2**24)


def measured(
    particle_count: int, steps: int, device: torch.device, *, train: bool
) -> dict[str, object]:
    """Return time and memory of a rollout of one world."""
    workload = Workload(2, 1, particle_count, steps)
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
        "reserved_gib": round(torch.cuda.max_memory_reserved(device) / 2**30, 2),
        "worlds_gib": round((x.nbytes + s.nbytes) / 2**30, 2),
    }


@torch.no_grad()
def checked(copies: int, particle_count: int, device: torch.device) -> dict[str, object]:
    """Return how far copies within one world are from the one at the origin, after two steps."""
    workload = Workload(2, 1, particle_count, 2)
    x, s = workload.worlds(device)
    # On a grid of 2^-14, positions of copies are exact in float32.
    x = (x * 2.0**14).round() / 2.0**14
    rule = workload.rule(device)
    draws = torch.Generator(device).manual_seed(3)
    for weight in rule.parameters():
        noise = torch.randn(weight.shape, generator=draws, device=device)
        weight.copy_(0.1 * noise)
    given = {"eps": workload.eps, "update_prob": 1.0, "cuda_graph": False}
    side = math.ceil(math.sqrt(copies))
    pitch = math.ceil(2.0 * workload.half_width + 10.0 * workload.eps)
    number = torch.arange(copies, device=device)
    places = torch.stack((number % side, number // side), -1).float()
    places = ((places - side // 2) * pitch)[:, None]
    found: dict[str, object] = {"copies": copies, "particles": copies * particle_count}
    found["float32_step_at_the_edge"] = float(torch.finfo().eps * places.abs().max() / 2)
    for steps in (1, 2):
        all_x = (x + places).reshape(1, -1, 2)
        all_x, all_s = rollout(rule, all_x, s.repeat(1, copies, 1), steps, **given)
        parts_x, parts_s = all_x.view(copies, -1, 2), all_s.view(copies, particle_count, -1)
        origin = int(places.abs().sum(dim=(1, 2)).argmin())
        own_x, own_s = parts_x[origin], parts_s[origin]
        rows = []
        for place, part_x, part_s in zip(places, parts_x, parts_s, strict=True):
            far_x = (part_x - place - own_x).abs().amax(dim=1)
            far_s = (part_s - own_s).abs().amax(dim=1)
            rows.append(
                {
                    "mean_x": float(far_x.mean()),
                    "mean_s": float(far_s.mean()),
                    "worst_x": float(far_x.max()),
                    "worst_s": float(far_s.max()),
                    "share_beyond_1e-3": float((far_s > 1e-3).float().mean()),
                }
            )
        found[f"after_{steps}"] = {
            "moved_x": float((own_x - x[0]).abs().mean()),
            "moved_s": float((own_s - s[0]).abs().mean()),
            "largest_of_all_copies": {name: max(row[name] for row in rows) for name in rows[0]},
            "smallest_of_others": {name: sorted(row[name] for row in rows)[1] for name in rows[0]},
        }
    return found


def main() -> None:
    """Measure and write one line after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--inference", type=int, nargs="*", default=INFERENCE)
    parser.add_argument("--training", type=int, nargs="*", default=TRAINING)
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--training-steps", type=int, default=16)
    parser.add_argument("--copies", type=int, default=95, help="of the check; 0: none")
    told = parser.parse_args()
    device = torch.device("cuda", torch.cuda.current_device())
    lines: list[dict[str, object]] = [{"device": torch.cuda.get_device_name(device)}]
    asked = [(n, told.steps, False) for n in told.inference]
    asked += [(n, told.training_steps, True) for n in told.training]
    measurements: list[tuple[dict[str, object], Callable[[], dict[str, object]]]] = [
        ({"particles": n, "train": train}, partial(measured, n, steps, device, train=train))
        for n, steps, train in asked
    ]
    if told.copies:
        measurements.append(({"copies": told.copies}, partial(checked, told.copies, 2**20, device)))
    for what, measure in measurements:
        torch.cuda.empty_cache()
        begun = time.perf_counter()
        try:
            line = measure()
        except Exception as error:
            line = what | {"error": str(error)[:500]}
        print(json.dumps(line | {"seconds": round(time.perf_counter() - begun, 1)}), flush=True)
        lines.append(line)
        if told.out is not None:
            told.out.write_text(json.dumps(lines, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
