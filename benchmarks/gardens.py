"""Rewards in gardens of the policies zero, random, scripted and gradient; run with --help.

    python benchmarks/gardens.py [--ids npa/Gardener2D-v0 ...] [--device cuda] [--output FILE]
    python benchmarks/gardens.py --policies --worlds 1 1024        speed alone

Episodes have the sixteen seeds of `npa_envs.agents.learning.problem.EVALUATION_SEEDS`. Results are
the mean reward of a step with its standard error over episodes and, for shepherds, the success
rate.

`--worlds` also measures speed: steps of all worlds a second over an episode that ends with a reset
of all, the median of three. Actions are zero; on CUDA observations stay on the device.
"""

from __future__ import annotations

import math
import statistics
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from scripts import script_facts, script_parser

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.agents.garden_policies import (
    GradientGardener,
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.learning.problem import EVALUATION_SEEDS
from npa_envs.measure.benchmark_records import write_record
from npa_envs.measure.speed.timing import synchronize
from npa_envs.registration import GARDEN_IDS

POLICIES = ("zero", "random", "scripted", "gradient")


def measured(name: str, policy: str, device: str, count: int, steps: int | None) -> dict[str, Any]:
    """Return the rewards of a policy in the first episode of each seed."""
    scripted = ScriptedShepherd if "Shepherd" in name else ScriptedGardener
    makes = (StillGardener, RandomGardener, scripted, GradientGardener)
    limit = steps or gymnasium.spec(name).max_episode_steps
    env = gymnasium.make_vec(
        name,
        count,
        vectorization_mode="vector_entry_point",
        max_episode_steps=limit,
        device=device,
    )
    act = dict(zip(POLICIES, makes, strict=True))[policy](env)
    begun, earned = time.perf_counter(), np.zeros(count)
    seen, _ = env.reset(seed=list(EVALUATION_SEEDS[:count]))
    for _ in range(limit):
        seen, rewards, _, _, infos = env.step(act(seen))
        earned += rewards / limit
    row = {
        "id": name,
        "policy": policy,
        "reward": float(earned.mean()),
        "error": float(earned.std(ddof=1) / math.sqrt(count)) if count > 1 else None,
        "episodes": count,
        "steps": limit,
        "seconds": time.perf_counter() - begun,
    }
    if "is_success" in infos["final_info"]:
        row["success"] = float(np.mean(infos["final_info"]["is_success"]))
    return row


def speed(name: str, count: int, device: str) -> dict[str, Any]:
    """Return how many steps of all worlds are made in a second."""
    limit = gymnasium.spec(name).max_episode_steps
    output = "torch" if device.startswith("cuda") else "numpy"
    made = {"device": device, "output": output}
    env = gymnasium.make_vec(name, count, vectorization_mode="vector_entry_point", **made)
    action = torch.zeros(env.action_space.shape, device=device)
    env.reset(seed=0)
    times = []
    # The first episode compiles.
    for _ in range(4):
        synchronize(torch.device(device))
        begun = time.perf_counter()
        for _ in range(limit):
            env.step(action)
        synchronize(torch.device(device))
        times.append(time.perf_counter() - begun)
    seconds = statistics.median(times[1:]) / limit
    return {"id": name, "worlds": count, "seconds": seconds, "steps_a_second": count / seconds}


def main(arguments: list[str] | None = None) -> None:
    """Measure, print and write."""
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("--ids", nargs="+", default=GARDEN_IDS, choices=GARDEN_IDS)
    parser.add_argument("--policies", nargs="*", default=POLICIES, choices=POLICIES)
    parser.add_argument("--episodes", type=int, default=len(EVALUATION_SEEDS))
    parser.add_argument("--steps", type=int, help="of an episode; default: the registered ones")
    parser.add_argument("--worlds", type=int, nargs="*", default=(), help="whose speed to measure")
    given = parser.parse_args(arguments)
    torch.set_num_threads(given.threads)
    rows = []
    for name in given.ids:
        for policy in given.policies:
            row = measured(name, policy, given.device, given.episodes, given.steps)
            rows.append(row)
            success = f", success {row['success']:.2f}" if "success" in row else ""
            error = "" if row["error"] is None else f" ± {row['error']:.3f}"
            print(f"{name} {policy}: {row['reward']:.3f}{error}{success}", flush=True)
    speeds = [speed(name, count, given.device) for name in given.ids for count in given.worlds]
    for row in speeds:
        print(f"{row['id']}, {row['worlds']} worlds: {row['steps_a_second']:.0f} steps a second")
    if given.output is not None:
        write_record(given.output, {**script_facts(given), "rows": rows, "speeds": speeds})


if __name__ == "__main__":
    main()
