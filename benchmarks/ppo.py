"""What the device's own PPO and Stable-Baselines3's get done in a second; see --help.

All forms learn in as many of the same worlds of the morphogenesis environment, their other options
as by default. Of the device's form also how long the GPU was at work while it learned: the time in
which at least one kernel or copy ran, as the profiler saw it, over the wall time of as many rounds.
The profiler takes time on the host, so that the share under it is a lower bound.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from npa_envs.agents.learning import Budget, Problem, train
from npa_envs.agents.learning.ppo import Learner, world_bytes
from npa_envs.agents.learning.ppo_settings import Settings
from npa_envs.measure.speed.report import script_facts

FORMS = ("ppo", "ppo_rows", "ppo_world")
"""Methods of npa_envs.agents.learning; the first is the device's own."""


def make_problem(world_count: int, particle_count: int) -> Problem:
    """Return the worlds to learn in: hearts of as many particles, in episodes of 48 steps."""
    # As many neighbours whatever the number of particles.
    eps = 0.1 * (1024 / particle_count) ** 0.5
    return Problem(
        env_id="npa/Morphogenesis2D-v0",
        keywords={
            "target": "heart",
            "particle_count": particle_count,
            "state_dim": 16,
            "state_scale": 0.1,
            "seed_radius": 0.4,
            "eps": eps,
            "eps0": eps,
        },
        episode_steps=48,
        num_envs=world_count,
    )


def speed(form: str, problem: Problem, seconds: float, device: str) -> dict[str, Any]:
    """Return how many particle-steps a form learned from in a second, evaluations not counted."""
    options = {"worlds": problem.num_envs} if form == FORMS[0] else {}
    log = train(form, problem, Budget(seconds=seconds), 0, device=device, entries=1, **options).log
    last = log[-1]
    return {
        "form": form,
        "seconds": last.seconds,
        "particle_steps": last.particle_steps,
        "particle_steps_per_second": last.particle_steps / last.seconds,
        "mean_return": last.mean_return,
    }


def covered(intervals: Iterable[tuple[float, float]]) -> float:
    """Return the length of the union of intervals (begin, end)."""
    total, reached = 0.0, float("-inf")
    for begin, end in sorted(intervals):
        total += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return total


def device_share(problem: Problem, rounds: int, device: str) -> dict[str, Any]:
    """Return the share of the wall time of some rounds in which the GPU was at work, and memory."""
    place = torch.device(device)
    settings = Settings(worlds=problem.num_envs)
    # What the forms before have left.
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(place)
    held = torch.cuda.memory_reserved(place)
    learner = Learner(problem, settings, 0, place, None)

    def learn(count: int) -> float:
        torch.cuda.synchronize(place)
        begin = time.perf_counter()
        for _ in range(count):
            learner.play()
            learner.improve(1.0)
        torch.cuda.synchronize(place)
        return time.perf_counter() - begin

    # Graphs are captured and memory is taken.
    learn(4)
    plain = learn(rounds)
    activities = [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profiler:
        wall = learn(rounds)
    kinds = torch.autograd.DeviceType.CUDA
    spans = [
        (event.time_range.start, event.time_range.end)
        for event in profiler.events()
        if event.device_type == kinds
    ]
    busy = covered(spans) * 1e-6
    return {
        "rounds": rounds,
        "seconds": plain,
        "seconds_profiled": wall,
        "seconds_busy": busy,
        "share_busy": busy / plain,
        "share_busy_profiled": busy / wall,
        "device_events": len(spans),
        "particle_steps_per_second": rounds * learner.round_size / plain,
        "reserved_mib": (torch.cuda.max_memory_reserved(place) - held) / 2**20,
        "expected_mib": problem.num_envs * world_bytes(problem, settings, place) / 2**20,
    }


def main() -> None:
    """Measure, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--particles", type=int, default=1024)
    parser.add_argument("--seconds", type=float, default=10.0, help="that each form learns")
    parser.add_argument("--rounds", type=int, default=16, help="of the device's form, profiled")
    parser.add_argument("--commit", default="unknown", help="commit that is measured")
    parser.add_argument("--output", type=Path, help="JSON file to write")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    problem = make_problem(arguments.worlds, arguments.particles)
    rows = [speed(form, problem, arguments.seconds, arguments.device) for form in FORMS]
    print(f"{'form':10} {'particle-steps/s':>17} {'ppo over it':>12} {'return':>8}")
    for row in rows:
        ratio = rows[0]["particle_steps_per_second"] / row["particle_steps_per_second"]
        print(
            f"{row['form']:10} {row['particle_steps_per_second']:17.3g} {ratio:12.1f} "
            f"{row['mean_return']:8.3f}"
        )
    cuda = torch.device(arguments.device).type == "cuda"
    share = device_share(problem, arguments.rounds, arguments.device) if cuda else None
    if share:
        print(
            f"{FORMS[0]}: {share['rounds']} rounds take {share['seconds']:.3f} s, in which the GPU "
            f"is at work for {share['seconds_busy']:.3f} s, {100 * share['share_busy']:.1f} % "
            f"(under the profiler {100 * share['share_busy_profiled']:.1f} %); it takes "
            f"{share['reserved_mib']:.0f} MiB, {share['expected_mib']:.0f} were expected"
        )
    report = {
        **script_facts(arguments.commit, torch.device(arguments.device)),
        "worlds": arguments.worlds,
        "particles": arguments.particles,
        "rows": rows,
        "device_share": share,
    }
    if arguments.output:
        arguments.output.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
