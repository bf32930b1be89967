"""Time and memory of rollouts on the workloads of the paper's table; run with --help.

Positions are uniform in a square of half-width 0.7 sqrt(N / 4096) (a cube of half-width 0.8 in 3D),
eps 0.1, update probability 0.5; the loss is a random linear functional of the final x and s. On
CUDA the whole rollout (and its backward pass) is captured in one graph and replayed.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import NamedTuple

import torch

import npa_envs


class Workload(NamedTuple):
    """One row of the table."""

    space_dim: int
    world_count: int
    particle_count: int
    steps: int
    hidden_dim: int = 128

    @property
    def name(self) -> str:
        """Short name of the row."""
        return f"{self.space_dim}D ({self.world_count}, {self.particle_count}, {self.steps})"


PAPER = (
    Workload(2, 8, 4096, 64),
    Workload(2, 1, 4096, 64),
    Workload(2, 8, 65536, 8),
    Workload(3, 4, 16384, 24, 256),
)
CPU = (Workload(2, 1, 4096, 16), Workload(2, 4, 1024, 16))


def world(workload: Workload, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the workload's initial worlds."""
    generator = torch.Generator(device).manual_seed(0)
    side = 0.8 if workload.space_dim == 3 else 0.7 * math.sqrt(workload.particle_count / 4096)
    shape = (workload.world_count, workload.particle_count)
    x = torch.rand(*shape, workload.space_dim, generator=generator, device=device)
    s = torch.randn(*shape, 16, generator=generator, device=device)
    return (2.0 * x - 1.0) * side, 0.1 * s


def timed(run: Callable[[], None], device: torch.device, repeats: int) -> float:
    """Return the median time of a call in seconds."""
    times = []
    for _ in range(repeats):
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        if device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def captured(run: Callable[[], None], device: torch.device, generator: torch.Generator) -> Callable:
    """Return a replay of `run` on CUDA, and `run` itself elsewhere."""
    if device.type != "cuda":
        run()
        return run
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        run()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    graph.register_generator_state(generator)
    with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
        run()
    return graph.replay


def measure(
    workload: Workload, device: torch.device, memory: str, repeats: int
) -> dict[str, float | str]:
    """Return µs a step of inference and training, and the peak memory of training in MiB."""
    torch.manual_seed(0)
    rule = npa_envs.NPARule(workload.space_dim, 16, workload.hidden_dim).to(device)
    x0, s0 = world(workload, device)
    x_weight, s_weight = torch.randn_like(x0), torch.randn_like(s0)
    generator = torch.Generator(device).manual_seed(1)
    parameters = list(rule.parameters())

    def infer() -> None:
        with torch.no_grad():
            npa_envs.rollout(rule, x0, s0, workload.steps, eps=0.1, generator=generator)

    def train() -> None:
        x, s = npa_envs.rollout(
            rule, x0, s0, workload.steps, eps=0.1, generator=generator, memory=memory
        )
        loss = (x * x_weight).sum() + (s * s_weight).sum()
        torch.autograd.grad(loss, parameters)

    row: dict[str, float | str] = {"workload": workload.name, "memory": memory}
    scale = 1e6 / workload.steps
    row["infer_us"] = timed(captured(infer, device, generator), device, repeats) * scale
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        reserved, allocated = torch.cuda.memory_reserved(), torch.cuda.memory_allocated()
        replay = captured(train, device, generator)
        row["train_us"] = timed(replay, device, repeats) * scale
        row["peak_reserved_mib"] = (torch.cuda.max_memory_reserved() - reserved) / 2**20
        row["peak_allocated_mib"] = (torch.cuda.max_memory_allocated() - allocated) / 2**20
        del replay
        torch.cuda.empty_cache()
    else:
        row["train_us"] = timed(captured(train, device, generator), device, repeats) * scale
    return row


def main() -> None:
    """Measure, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--commit", default="unknown", help="commit that is measured")
    parser.add_argument("--output", type=Path, help="JSON file to write")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    rows = []
    for workload in PAPER if device.type == "cuda" else CPU:
        for memory in ("store", "recompute"):
            row = measure(workload, device, memory, arguments.repeats)
            rows.append(row)
            print({k: round(v, 1) if isinstance(v, float) else v for k, v in row.items()})
    machine = torch.cuda.get_device_name() if device.type == "cuda" else "CPU, 1 thread of kernels"
    report = {
        "command": " ".join(["python", *sys.argv]),
        "commit": arguments.commit,
        "date": date.today().isoformat(),
        "machine": machine,
        "torch": torch.__version__,
        "rows": rows,
    }
    if arguments.output:
        arguments.output.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
