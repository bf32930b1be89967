"""Workloads, time and memory of a call, and the session of a benchmark."""

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
    """B worlds of N uniformly scattered particles for a rollout of T steps, and a fresh rule.

    `eps` [length units] is such that particles have about 66 neighbours in 2D.
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
        """Short name: dimension and (B, N, T)."""
        return f"{self.space_dim}D ({self.world_count}, {self.particle_count}, {self.steps})"

    @property
    def half_width(self) -> float:
        """Half the side of the square or cube of particles [length units], by a fixed density."""
        if self.space_dim == 2:
            return 0.7 * math.sqrt(self.particle_count / 4096)
        return 0.8 * math.cbrt(self.particle_count / 16384)

    @property
    def neighbour_count(self) -> float:
        """Mean number of particles within eps of one, itself included, far from the edges."""
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
        """Return a new rule, always with the same weights, with options of `NPARule`."""
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
    """Return a function that runs a rollout, and the generator of its masks.

    `train` computes the gradient of a random linear functional by the rule's weights, `gradients`
    only enables gradients. `rule` are options of the rule, `options` those of `roll`.
    """
    network = workload.rule(x.device, **(rule or {}))
    generator = torch.Generator(x.device).manual_seed(1)
    kwargs = {"eps": workload.eps, "update_prob": workload.update_prob, **options}
    draws = torch.Generator(x.device).manual_seed(2)
    weights = [
        torch.randn(worlds.shape, generator=draws, device=x.device)
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
"""Least duration of a reading, for which short calls are repeated [s]."""


@dataclass(frozen=True)
class Timing:
    """The time of one call [µs]: the median of several readings, and the range of all of them."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        """Return the median and the largest deviation of a reading, as text."""
        off = max(self.high - self.median, self.median - self.low) / self.median
        return f"{self.median:.4g} ±{off:.0%}"

    def divided(self, count: int) -> Timing:
        """Return the time of one of `count` equal parts of the call."""
        return Timing(self.median / count, self.low / count, self.high / count)


@dataclass(frozen=True)
class Cost:
    """The time of a call, and its peak of memory allocated by torch [MiB], None on a CPU."""

    time: Timing
    peak_mib: float | None


def synchronize(device: torch.device) -> None:
    """Wait for all work of a device, if it is CUDA."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def timed(
    run: Callable[[], object], device: torch.device, repeats: int, *, calls: int | None = None
) -> Timing:
    """Return a call's time: up to `repeats` readings of `calls` calls, or of `MIN_SECONDS`."""

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
"""Rows of a suite, instances of one dataclass each, by the table's name."""


NO_TIME = "no time was left"
"""Reason for measurements that had not started at the time limit."""


@dataclass
class TimingSession:
    """Options of one run of `npa-envs bench`, and what it left out."""

    device: torch.device
    repeats: int = 7
    """Readings of every time."""
    small: bool = False
    """Small sizes only."""
    progress: Callable[[int], None] = lambda done: None
    """Called with 1 after each row."""
    left_out: dict[str, str] = field(default_factory=dict)
    """The reason by measurement that was left out."""
    enough: Callable[[], bool] = lambda: False
    """Returns whether the time limit is reached: later rows are left out."""

    @property
    def cuda(self) -> bool:
        """Whether the device is a CUDA device."""
        return self.device.type == "cuda"

    @property
    def size(self) -> str:
        """Size of workloads: "small", "cpu" or "cuda"."""
        return "small" if self.small else self.device.type

    def cost(
        self,
        run: Callable[[], object],
        *,
        graph: bool = True,
        generator: torch.Generator | None = None,
    ) -> Cost:
        """Return time and memory of a call after a first one; `graph`: of replays on CUDA."""
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
        """Return a list of the row that `make` returns, empty if memory or time is short."""
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
        """Return the rows that `calls` (name, function) return, where memory and time allow."""
        return [row for what, make in calls for row in self.attempt(what, make)]
