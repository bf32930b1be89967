"""Time of the paper's training over processes: run it alone, or by torchrun on several GPUs.

    python benchmarks/scale.py --worlds 8
    torchrun --nproc-per-node=2 benchmarks/scale.py --worlds 8 16

A line is a JSON object: processes, worlds of the whole batch, milliseconds of an iteration (median
of ten blocks, on the slowest process), and the loss after the first ten iterations. Rollouts have
64 steps, the middle of the paper's range, so that one recording serves all iterations.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import torch

from npa_envs.devices import check_device
from npa_envs.training import Trainer, preset, task_entry
from npa_envs.training.ranks import Ranks, joined_ranks

BLOCKS = 10


def main() -> None:
    """Measure batches of some sizes, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[8])
    parser.add_argument("--iterations", type=int, default=20, help="of a block")
    parser.add_argument("--steps", type=int, default=64)
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--memory", default="store")
    parser.add_argument("--device", default="cuda")
    told = parser.parse_args()
    with joined_ranks() as ranks:
        for worlds in told.worlds:
            line = measured(ranks, worlds, told)
            if ranks.first:
                print(json.dumps(line), flush=True)


def measured(ranks: Ranks, worlds: int, told: argparse.Namespace) -> dict[str, object]:
    """Return what one batch size takes."""
    device = check_device(told.device)
    with tempfile.TemporaryDirectory() as folder:
        config = preset(
            "paper",
            target="gecko",
            particle_count=told.particles,
            world_count=worlds,
            pool_size=64 * worlds,
            steps=[told.steps, told.steps + 1],
            memory=told.memory,
            device=told.device,
            log_interval=10,
            tensorboard=False,
            out=Path(folder),
        )
        task = task_entry("morphogenesis2d").make(config.task, device)
        trainer = Trainer(task, config, task_name="morphogenesis2d")
        for _ in range(10):
            trainer.iterate()
        loss = trainer._cycle.batch.terms[0].item()
        blocks = []
        for _ in range(BLOCKS):
            wait(ranks, device)
            start = time.perf_counter()
            for _ in range(told.iterations):
                trainer.iterate()
            wait(ranks, device)
            blocks.append((time.perf_counter() - start) / told.iterations * 1e3)
    return {
        "processes": ranks.count if ranks.together else "alone",
        "worlds": worlds,
        "particles": told.particles,
        "steps": told.steps,
        "memory": told.memory,
        "ms": round(statistics.median(blocks), 4),
        "ms_least": round(min(blocks), 4),
        "ms_most": round(max(blocks), 4),
        "loss": loss,
    }


def wait(ranks: Ranks, device: torch.device) -> None:
    """Wait for the device of each process."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    ranks.any(False)


if __name__ == "__main__":
    main()
