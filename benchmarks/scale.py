"""Time of the paper's training over processes: run it alone, or by torchrun on several GPUs.

    python benchmarks/scale.py --worlds 8 16
    torchrun --nproc-per-node=2 benchmarks/scale.py --alone 8 --worlds 16 8

A line is a JSON object for each batch size: of `--alone` the first process trains while the others
wait, of `--worlds` all train together. Blocks of all batch sizes take turns, so that a clock that
changes reaches each. A line has the worlds of the whole batch, milliseconds of an iteration by the
clock (`ms`, median of the blocks), those that the host took to launch them (`host_ms`), and the
loss after the first ten iterations. `reduce_ms` is the time of the reduction on the process that
came last, `waited_ms` how much longer another one was in it (medians of more iterations, on CUDA).

Rollouts have 64 steps, the middle of the paper's range, so that one recording serves all
iterations.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor

from npa_envs.checks import check_device
from npa_envs.training import Trainer, preset, task_entry
from npa_envs.training.process_group import ALONE, ProcessGroup
from npa_envs.training.process_launcher import joined_processes

WARM_UP = 10
"""Iterations before the first block."""


def main() -> None:
    """Measure batches of some sizes in turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, nargs="*", default=[8], help="of all processes")
    parser.add_argument("--alone", type=int, nargs="*", default=[], help="of the first process")
    parser.add_argument("--blocks", type=int, default=10)
    parser.add_argument("--iterations", type=int, default=20, help="of a block")
    parser.add_argument("--steps", type=int, default=64)
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--memory", default="store")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--eager", action="store_true", help="record no graphs")
    told = parser.parse_args()
    with joined_processes() as ranks, tempfile.TemporaryDirectory() as folder:
        forms = [(ALONE, worlds) for worlds in told.alone if ranks.first]
        forms += [(ranks, worlds) for worlds in told.worlds]
        made = [Run(*form, told, Path(folder) / str(n)) for n, form in enumerate(forms)]
        waiting = 0 if ranks.first else len(told.alone)
        for _ in range(told.blocks):
            for _ in range(waiting):
                ranks.any(False)
            for run in made:
                run.block(ranks, told.iterations)
        for run in made:
            run.reductions(told.iterations)
            if ranks.first:
                print(json.dumps(run.line(told)), flush=True)


class Run:
    """One batch size: its trainer, and what was measured.

    Args:
        sharing: The processes that train it.
        worlds: Worlds of the whole batch.
        told: The command's options.
        folder: Where the run is written to.
    """

    def __init__(
        self, sharing: ProcessGroup, worlds: int, told: argparse.Namespace, folder: Path
    ) -> None:
        self._sharing = sharing
        self._worlds = worlds
        self._device = check_device(told.device)
        config = preset(
            "paper",
            target="gecko",
            particle_count=told.particles,
            world_count=worlds,
            pool_size=64 * worlds,
            steps=[told.steps, told.steps + 1],
            memory=told.memory,
            device=told.device,
            cuda_graph=not told.eager,
            log_interval=10,
            tensorboard=False,
            out=folder,
        )
        task = task_entry("morphogenesis2d").make(config.task, self._device)
        self._trainer = Trainer(task, config, task_name="morphogenesis2d", processes=sharing)
        self._iterate(WARM_UP)
        self._loss = self._trainer._cycle.batch.terms[0].item()
        self._times: list[float] = []
        self._host_times: list[float] = []
        self._reductions: dict[str, float] = {}

    def _iterate(self, count: int) -> None:
        """Train as the trainer's own loop does."""
        for _ in range(count):
            self._sharing.agree_to_stop(False)
            self._trainer.iterate()

    def block(self, all_ranks: ProcessGroup, iterations: int) -> None:
        """Time some iterations."""
        wait(self._sharing, self._device)
        start = time.perf_counter()
        self._iterate(iterations)
        launched = time.perf_counter()
        wait(self._sharing, self._device)
        self._times.append((time.perf_counter() - start) / iterations * 1e3)
        self._host_times.append((launched - start) / iterations * 1e3)
        if not self._sharing.distributed:
            all_ranks.any(False)

    def reductions(self, iterations: int) -> None:
        """Time the reductions of some iterations, by events of the device."""
        sharing, plain = self._sharing, self._sharing.reduce
        if not sharing.distributed or self._device.type != "cuda":
            return
        marks: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []

        def timed(means: Sequence[Tensor], total: Tensor | None = None) -> None:
            marks.append(
                (torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True))
            )
            marks[-1][0].record()
            plain(means, total)
            marks[-1][1].record()

        wait(sharing, self._device)
        sharing.reduce = timed  # type: ignore[method-assign]
        self._iterate(iterations)
        sharing.reduce = plain  # type: ignore[method-assign]
        wait(sharing, self._device)
        mine = [first.elapsed_time(last) for first, last in marks]
        theirs: list[list[float]] = [[] for _ in range(sharing.count)]
        dist.all_gather_object(theirs, mine)
        by_iteration = list(zip(*theirs, strict=True))
        self._reductions = {
            "reduce_ms": round(statistics.median(map(min, by_iteration)), 4),
            "waited_ms": round(
                statistics.median(max(times) - min(times) for times in by_iteration), 4
            ),
        }

    def line(self, told: argparse.Namespace) -> dict[str, object]:
        """Return the measurements."""
        return {
            "processes": self._sharing.count if self._sharing.distributed else "alone",
            "worlds": self._worlds,
            "particles": told.particles,
            "steps": told.steps,
            "memory": told.memory,
            "recorded": self._device.type == "cuda" and not told.eager,
            "ms": round(statistics.median(self._times), 4),
            "ms_least": round(min(self._times), 4),
            "ms_most": round(max(self._times), 4),
            "host_ms": round(statistics.median(self._host_times), 4),
            **self._reductions,
            "loss": self._loss,
        }


def wait(ranks: ProcessGroup, device: torch.device) -> None:
    """Wait for the device of each process."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    ranks.any(False)


if __name__ == "__main__":
    main()
