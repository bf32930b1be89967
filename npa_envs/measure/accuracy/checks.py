"""Checks of hard cases: their sessions, figures, limits and verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import torch

Verdict = Literal["pass", "fail", "range", "skipped"]

GROUPS = {
    "geometry": "where particles lie: forwards and backwards, against a float64 reference",
    "values": "what states hold: tiny, huge, infinite, no number",
    "time": "every shipped rule for 100 000 steps",
    "gradients": "how gradients grow with the steps; finite differences; float32's errors",
    "precision": "shorter numbers, order, batches, repetitions, devices, recorded graphs",
}
"""Every group of checks with its summary."""


class Skipped(Exception):
    """A check has nothing to measure; the message is the reason."""


@dataclass(frozen=True)
class CheckResult:
    """Figures of a check by name, and limits of some of them."""

    figures: Mapping[str, float]
    limits: Mapping[str, float] = field(default_factory=dict)
    holds: str = ""
    """For a range: where it holds, in words."""
    note: str = ""

    def exceeded(self) -> list[str]:
        """Return the names whose figure is above its limit, not a number, or missing."""
        nan = float("nan")
        # Comparisons with NaN are false.
        return [
            name for name, limit in self.limits.items() if not self.figures.get(name, nan) <= limit
        ]

    @property
    def verdict(self) -> Verdict:
        """Whether it is as expected; a range is, where all its limits are kept."""
        if self.exceeded():
            return "fail"
        return "range" if self.holds else "pass"


@dataclass
class CheckSession:
    """One run of the command; when quick, with small worlds and few steps."""

    device: torch.device
    quick: bool = False
    seed: int = 0
    kept: dict[Any, Any] = field(default_factory=dict)
    """Results that several checks share."""

    @property
    def cuda(self) -> bool:
        """Whether the device is a CUDA device."""
        return self.device.type == "cuda"

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what a call makes; it is made once for a key."""
        if key not in self.kept:
            self.kept[key] = make()
        return self.kept[key]

    def generator(self, number: int = 0) -> torch.Generator:
        """Return a source of randomness on the device; others for other numbers."""
        return torch.Generator(self.device).manual_seed(1000 * self.seed + number)


@dataclass(frozen=True)
class Check:
    """A hard case GROUP/CASE, its expectation in a sentence, and the function that measures it."""

    name: str
    expected: str
    run: Callable[[CheckSession], CheckResult]
    rule: str = ""
    """What `load_rule` takes, of a check of a rule."""


def group_of(name: str) -> str:
    """Return the group of a check's name."""
    return name.partition("/")[0]


def in_2d_and_3d(
    group: str, cases: Mapping[str, tuple[str, Callable[[int, CheckSession], CheckResult]]]
) -> list[Check]:
    """Return checks GROUP/CASE/2d and /3d of cases: what is expected, and what measures it."""
    return [
        Check(f"{group}/{name}/{space_dim}d", expected, partial(run, space_dim))
        for space_dim in (2, 3)
        for name, (expected, run) in cases.items()
    ]
