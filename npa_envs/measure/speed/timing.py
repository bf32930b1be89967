"""What `npa-envs bench` times (workloads), how it times (time, memory), and a run's session."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from npa_envs.rule.rule import NPARule
from npa_envs.world.cuda_graph import capture
from npa_envs.world.rollout import rollout

# Workloads: uniformly scattered particles


@dataclass(frozen=True)
class Workload:
    """A rollout of T steps: B worlds of N uniformly scattered particles, and an untrained rule.

    With the default radius `eps` [length units] particles have about 66 neighbours in 2D.
    """

    space_dim: int
    world_count: int
    particle_count: int
    steps: int
    hidden_dim: int = 128
    state_dim: int = 16
    eps: float = 0.1
    update_prob: float = 0.5

    @property
    def name(self) -> str:
        """Space dimension and (B, N, T), such as "2D (8, 4096, 64)"."""
        return f"{self.space_dim}D ({self.world_count}, {self.particle_count}, {self.steps})"

    @property
    def half_width(self) -> float:
        """Half the side of the square or cube of particles [length units], at a fixed density."""
        if self.space_dim == 2:
            return 0.7 * math.sqrt(self.particle_count / 4096)
        return 0.8 * math.cbrt(self.particle_count / 16384)

    @property
    def neighbour_count(self) -> float:
        """Mean number of particles within `eps` of one far from the edges, itself included."""
        ball = math.pi * self.eps**2 if self.space_dim == 2 else 4 / 3 * math.pi * self.eps**3
        volume = math.prod((2.0 * self.half_width,) * self.space_dim)
        return 1.0 + self.particle_count * ball / volume

    def worlds(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return float32 positions [length units], [B, N, D], and states, [B, N, C]."""
        generator = torch.Generator(device).manual_seed(0)
        shape = (self.world_count, self.particle_count)
        x = torch.rand(*shape, self.space_dim, generator=generator, device=device)
        s = torch.randn(*shape, self.state_dim, generator=generator, device=device)
        return x.mul_(2.0).sub_(1.0).mul_(self.half_width), s.mul_(0.1)

    def rule(self, device: torch.device, **options: Any) -> NPARule:
        """Return a new rule, always with the same weights; `options` are those of `NPARule`."""
        # Weights are drawn from torch's global generators, whose state must not change.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            dims = (self.space_dim, self.state_dim, self.hidden_dim)
            rule = NPARule(*dims, eps0=self.eps, **options)
        return rule.to(device)


def rollout_call(
    workload: Workload,
    x: Tensor,
    s: Tensor,
    *,
    train: bool = False,
    gradients: bool = False,
    rule: Mapping[str, bool] | None = None,
    roll: Callable[..., Any] = rollout,
    **options: Any,
) -> tuple[Callable[[], None], torch.Generator]:
    """Return a function that runs a workload's rollout from x and s, and its masks' generator.

    With `train` it also computes the rule's weight gradients of a random linear functional of the
    result; with `gradients` it only records what a gradient needs. `rule` are options of
    `NPARule`, `options` those of `roll`, the function that is timed.
    """
    network = workload.rule(x.device, **(rule or {}))
    generator = torch.Generator(x.device).manual_seed(1)
    kwargs = {"eps": workload.eps, "update_prob": workload.update_prob, **options}
    source = torch.Generator(x.device).manual_seed(2)
    weights = [
        torch.randn(worlds.shape, generator=source, device=x.device)
        for worlds in ((x, s) if train else ())
    ]

    def run() -> None:
        with torch.set_grad_enabled(train or gradients):
            worlds = roll(network, x, s, workload.steps, generator=generator, **kwargs)
            if train:
                terms = [(a * b).sum() for a, b in zip(worlds, weights, strict=True)]
                torch.autograd.grad(terms[0] + terms[1], list(network.parameters()))

    return run, generator


# Time

MIN_SECONDS = {"cpu": 2e-3, "cuda": 1e-2}
"""Minimum duration of a reading [s], by kind of device; short calls are repeated within it."""


@dataclass(frozen=True)
class Timing:
    """Time of one call [µs]: the median, the lowest and the highest of several readings."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        """Return the median and the largest deviation from it, such as "12.5 ±3%"."""
        off = max(self.high - self.median, self.median - self.low) / self.median
        return f"{self.median:.4g} ±{off:.0%}"

    def divided(self, count: int) -> Timing:
        """Return the time of one of `count` equal parts of the call."""
        return Timing(self.median / count, self.low / count, self.high / count)


@dataclass(frozen=True)
class Cost:
    """Time of a call, and the peak of memory that torch allocates in it [MiB]; None on a CPU."""

    time: Timing
    peak_mib: float | None


def synchronize(device: torch.device) -> None:
    """Wait until a CUDA device has done all its work; on a CPU do nothing."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def timed(
    run: Callable[[], object], device: torch.device, repeats: int, *, calls: int | None = None
) -> Timing:
    """Return a call's time: each reading is a mean of `calls` calls; None: of `MIN_SECONDS`."""

    def reading(count: int) -> float:
        synchronize(device)
        start = time.perf_counter()
        for _ in range(count):
            run()
        synchronize(device)
        return (time.perf_counter() - start) / count * 1e6

    count = calls or max(1, math.ceil(MIN_SECONDS[device.type] * 1e6 / reading(1)))
    readings = [reading(count)]
    # Slow calls have fewer readings: those of a second, but at least three.
    while len(readings) < repeats and (len(readings) < 3 or sum(readings) * count < 1e6):
        readings.append(reading(count))
    return Timing(statistics.median(readings), min(readings), max(readings))


# The session

Row = TypeVar("Row")

Tables = dict[str, list[Any]]
"""Tables by name: lists of rows, which are instances of one dataclass."""


NO_TIME = "no time was left"
"""Why measurements that had not started at the time limit were left out."""


@dataclass
class TimingSession:
    """Options of one run of `npa-envs bench`, and the measurements that it left out."""

    device: torch.device
    repeats: int = 7
    """Maximum number of readings of a time (`timed`)."""
    small: bool = False
    """Whether only small worlds are measured."""
    progress: Callable[[int], None] = lambda done: None
    """Called with 1 after each row."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Name of each measurement that was left out, and the reason."""
    enough: Callable[[], bool] = lambda: False
    """Returns whether the time limit is reached; then no further row is measured."""

    @property
    def cuda(self) -> bool:
        """Whether the device is a CUDA device."""
        return self.device.type == "cuda"

    @property
    def size(self) -> str:
        """Which workloads are measured: "small", "cpu" or "cuda"."""
        return "small" if self.small else self.device.type

    def cost(
        self,
        run: Callable[[], object],
        *,
        graph: bool = True,
        generator: torch.Generator | None = None,
    ) -> Cost:
        """Return time and memory of calls after a first one; with `graph`, of replays on CUDA."""
        device = self.device
        run()
        synchronize(device)
        if not self.cuda:
            return Cost(timed(run, device, self.repeats), None)
        gc.collect()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        replay = capture(run, device, generator=generator, warm_up=run).replay if graph else run
        timing = timed(replay, device, self.repeats)
        return Cost(timing, (torch.cuda.max_memory_allocated(device) - before) / 2**20)

    def attempt(self, what: str, make: Callable[[], Row]) -> list[Row]:
        """Return [make()]; if memory or time does not suffice, [], with `what` in `left_out`."""
        if self.enough():
            self.left_out[what] = NO_TIME
            return []
        try:
            return [make()]
        except torch.OutOfMemoryError:
            self.left_out[what] = "not enough memory"
        finally:
            self.progress(1)
        return []

    def rows(self, calls: Iterable[tuple[str, Callable[[], Row]]]) -> list[Row]:
        """Return the rows of `calls`, pairs of a name and a function, by `attempt`."""
        return [row for what, make in calls for row in self.attempt(what, make)]
