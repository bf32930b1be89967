"""The calls that calls.py times, by public names alone: older checkouts have them too.

`python call_lines.py DEVICE` writes the calls that it knows, a list of [call, B, N] in JSON, and
then answers each line of its input, the number of one of them, with a time [µs]. On a CPU, whose
calls have one thread, it is the process's own time.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator

import gymnasium
import torch
from torch import Tensor

import npa_envs

SIZES = {"cpu": ((1, 1024),), "cuda": ((1, 1024), (8, 4096), (8, 65536))}
"""B worlds of N particles of calls in a loop of one's own."""
ROLLOUTS = {"cpu": ((1, 64), (64, 64), (1, 256), (1, 1024), (1, 4096)), "cuda": ((8, 4096),)}
"""The same of rollouts, inference and training."""
SMALL = ((64, 256), (1024, 256), (1024, 128), (4096, 64), (1024, 512), (256, 1024))
"""The same of rollouts of many small worlds, on CUDA."""
GARDENS = ("npa/Gardener2D-v0", "npa/Gardener2DSmall-v0")
"""Ids whose 1024 worlds are stepped on CUDA."""
WARM_CALLS = 4
READINGS, LONG_READINGS = 7, 5

Line = tuple[str, int, int]
"""A call, and its B and N."""


def worlds(world_count: int, particle_count: int, device: str) -> tuple[Tensor, Tensor]:
    """Return uniformly scattered particles: positions [B, N, 2], states [B, N, 16], float32."""
    half = 0.7 * math.sqrt(particle_count / 4096)
    generator = torch.Generator().manual_seed(0)
    x = (2.0 * torch.rand(world_count, particle_count, 2, generator=generator) - 1.0) * half
    s = 0.1 * torch.randn(world_count, particle_count, 16, generator=generator)
    return x.to(device), s.to(device)


class ThreeLayers(npa_envs.NPARule):
    """A rule with a network of its own."""

    def __init__(self, *dims: int) -> None:
        super().__init__(*dims)
        self.middle = torch.nn.Linear(128, 128)

    def forward(self, z: Tensor) -> Tensor:
        """Return the update of perception vectors z [..., P]."""
        return self.output(torch.relu(self.middle(torch.relu(self.hidden(z)))))


def median_us(call: Callable[[], object], device: str, readings: int, calls: int = 1) -> float:
    """Return the median time of a call [µs]; a reading is the mean of some calls."""
    clock = time.process_time if device == "cpu" else time.perf_counter

    def reading() -> float:
        for _ in range(calls):
            call()
        if device != "cpu":
            torch.cuda.synchronize()
        return clock()

    for _ in range(WARM_CALLS):
        call()
    ends = [reading() for _ in range(readings + 1)]
    return statistics.median(b - a for a, b in itertools.pairwise(ends)) / calls * 1e6


def rollout_lines(device: str) -> Iterator[tuple[Line, Callable[[], float]]]:
    """Yield rollouts, a step of inference and of training, of a plain rule and of an own one."""
    steps = 8 if device == "cpu" else 64
    for size in ROLLOUTS[device]:
        x, s = worlds(*size, device)
        for name, kind in (("rollout", npa_envs.NPARule), ("rollout, own network", ThreeLayers)):
            torch.manual_seed(0)
            rule = kind(2, 16, 128).to(device)

            def infer(rule=rule, x=x, s=s) -> None:
                with torch.no_grad():
                    npa_envs.rollout(rule, x, s, steps, update_prob=0.5)

            def train(rule=rule, x=x, s=s) -> None:
                rule.zero_grad(set_to_none=True)
                ends = npa_envs.rollout(rule, x, s, steps, update_prob=0.5)
                (ends[0].mean() + ends[1].mean()).backward()

            for what, call in ((name, infer), (f"{name}, training", train)):
                yield (
                    (what, *size),
                    lambda call=call: median_us(call, device, LONG_READINGS) / steps,
                )


def loop_lines(device: str) -> Iterator[tuple[Line, Callable[[], float]]]:
    """Yield perception, with its backward pass, and steps, in loops of one's own."""
    rule = npa_envs.NPARule(2, 16, 128).to(device)
    for size in SIZES[device]:
        x, s = worlds(*size, device)
        leaf = s.clone().requires_grad_()

        @torch.no_grad()
        def perceive(x=x, s=s) -> Tensor:
            return npa_envs.perceive(x, s, eps=0.1, eps0=0.1)

        def both(x=x, leaf=leaf) -> None:
            leaf.grad = None
            npa_envs.perceive(x, leaf, eps=0.1, eps0=0.1).sum().backward()

        @torch.no_grad()
        def step(x=x, s=s) -> None:
            npa_envs.step(rule, x, s, update_prob=0.5)

        @torch.no_grad()
        def fields(x=x, s=s) -> None:
            npa_envs.perception_fields(x, s, eps=0.1)

        def kernels(perceive=perceive) -> float:
            for _ in range(WARM_CALLS):
                perceive()
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                kept = perceive()
            found = median_us(graph.replay, device, READINGS, 10)
            del graph, kept
            return found

        calls = {"perceive": perceive, "perceive, with backward": both, "step": step}
        for what, call in (calls | {"perception_fields": fields}).items():
            yield (what, *size), lambda call=call: median_us(call, device, READINGS, 10)
        if device != "cpu":
            yield ("perceive, CUDA graph", *size), kernels


def crowd_lines() -> Iterator[tuple[Line, Callable[[], float]]]:
    """Yield inference of many small worlds in both ways, and steps of gardens, on CUDA."""
    rule = npa_envs.NPARule(2, 16, 128).cuda()
    for size in SMALL:
        x, s = worlds(*size, "cuda")
        for way in ("auto", "whole"):

            @torch.no_grad()
            def roll(x=x, s=s, way=way) -> None:
                npa_envs.rollout(rule, x, s, 32, update_prob=0.5, cuda_graph=way)

            yield (
                (f"small worlds, {way}", *size),
                lambda roll=roll: median_us(roll, "cuda", LONG_READINGS) / 32,
            )
    for name in GARDENS:
        options = {"vectorization_mode": "vector_entry_point", "output": "torch"}
        env = gymnasium.make_vec(name, num_envs=1024, device="cuda", **options)
        env.reset(seed=0)
        action = torch.as_tensor(env.action_space.sample(), device="cuda")
        yield (
            (name, 1024, env.unwrapped.config.particle_count),
            lambda env=env, action=action: median_us(lambda: env.step(action), "cuda", 5, 3),
        )


def main() -> None:
    """Answer what is asked for."""
    device = sys.argv[1]
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # What libraries print is no answer.
    torch.set_num_threads(1)
    lines = dict(rollout_lines(device)) | dict(loop_lines(device))
    if device != "cpu":
        lines |= dict(crowd_lines())
    print(json.dumps(list(lines)), file=answers)
    for asked in sys.stdin:
        try:
            print([*lines.values()][int(asked)](), file=answers)
        except Exception as problem:  # An older checkout may not know a call or an option.
            print(f"{type(problem).__name__}: {problem}".replace("\n", " "), file=answers)


if __name__ == "__main__":
    main()
