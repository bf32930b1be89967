"""Time of a round of PPO: of one process alone, and of several that torchrun has started.

    torchrun --nproc-per-node=2 benchmarks/learners.py --worlds 128 64

Of each number of worlds, for each GPU, there are two lines, JSON objects: that of a process that
learns alone, while the others do the same, and that of all together with as many worlds each. They
hold milliseconds of a round (median; together on the slowest process), the mean square of the last
advantages, about 1, and the norm of all weights at last, which tell that all went well.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import torch
from scale import wait

from npa_envs.agents.learning import Problem
from npa_envs.agents.learning.ppo import Learner, PPOOptions
from npa_envs.devices import check_device
from npa_envs.training.ranks import ALONE, Ranks, joined_ranks


def main() -> None:
    """Measure runs of some sizes, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[128], help="of each process")
    parser.add_argument("--particles", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--device", default="cuda")
    told = parser.parse_args()
    with joined_ranks() as ranks:
        for worlds in told.worlds:
            for sharing in (ALONE, ranks):
                ranks.any(False)
                line = measured(sharing, worlds * sharing.count, told)
                if ranks.first:
                    print(json.dumps(line), flush=True)


def measured(ranks: Ranks, worlds: int, told: argparse.Namespace) -> dict[str, object]:
    """Return what one number of worlds, of all processes together, takes."""
    device = check_device(told.device)
    problem = Problem(
        env_id="npa/Morphogenesis2D-v0",
        keywords={"target": "heart", "particle_count": told.particles},
        episode_steps=96,
    )
    learner = Learner(problem, PPOOptions(worlds=worlds), 0, device, None, ranks)
    times = []
    for number in range(told.rounds + 4):
        wait(ranks, device)
        start = time.perf_counter()
        batch = learner.play()
        learner.improve(1.0 - number / (told.rounds + 4))
        wait(ranks, device)
        times.append((time.perf_counter() - start) * 1e3)
    ranks.check_same(list(learner.actor.parameters()))
    weights = torch.cat([weight.detach().flatten() for weight in learner.actor.parameters()])
    return {
        "processes": ranks.count if ranks.together else "alone",
        "worlds": worlds,
        "particles": told.particles,
        # The first rounds load kernels and record.
        "ms": round(statistics.median(times[4:]), 3),
        "ms_least": round(min(times[4:]), 3),
        "ms_first": [round(one, 1) for one in times[:4]],
        "advantage": batch.advantages.square().mean().item(),
        "weights": weights.norm().item(),
    }


if __name__ == "__main__":
    main()
