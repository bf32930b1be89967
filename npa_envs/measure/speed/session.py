"""What every suite is given, and where it says what it left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from npa_envs.measure.speed.precisions import PRECISIONS, Precision
from npa_envs.measure.speed.strategies import STRATEGIES, Strategy
from npa_envs.measure.speed.timing import Cost, measure

Row = TypeVar("Row")

Tables = dict[str, list[Any]]
"""Rows of a suite, instances of one dataclass each, by the table's name."""


@dataclass(frozen=True)
class LeftOut:
    """Something that a suite did not measure."""

    what: str
    """Strategy, precision, workload or peer."""
    why: str
    """The reason, in a few words."""


@dataclass
class Session:
    """One run of the benchmark."""

    device: torch.device
    """Where everything is measured."""
    repeats: int = 7
    """Readings of every time."""
    small: bool = False
    """Small sizes only: about a minute on a CPU."""
    strategies: list[Strategy] = field(default_factory=lambda: list(STRATEGIES.values()))
    """Strategies to measure."""
    precisions: list[Precision] = field(default_factory=lambda: list(PRECISIONS.values()))
    """Precisions to measure."""
    progress: Callable[[int], None] = lambda done: None
    """Called with 1 after each row."""
    left_out: list[LeftOut] = field(default_factory=list)
    """What could not be measured, each once."""

    @property
    def cuda(self) -> bool:
        """Whether the device is a CUDA device."""
        return self.device.type == "cuda"

    def cost(
        self,
        run: Callable[[], object],
        *,
        graph: bool = True,
        generator: torch.Generator | None = None,
    ) -> Cost:
        """Return what a call costs; arguments as `measure`."""
        return measure(run, self.device, repeats=self.repeats, graph=graph, generator=generator)

    def attempt(self, what: str, make: Callable[[], Row]) -> list[Row]:
        """Return the row that a call makes, none where the device's memory does not suffice.

        Args:
            what: What is measured, for the note on what was left out.
            make: Measures it.
        """
        try:
            return [make()]
        except torch.OutOfMemoryError:
            self.leave_out(what, "not enough memory")
            return []
        finally:
            self.progress(1)

    def leave_out(self, what: str, why: str) -> None:
        """Note that something is not measured."""
        entry = LeftOut(what, why)
        if entry not in self.left_out:
            self.left_out.append(entry)

    def usable_precisions(self) -> Iterator[Precision]:
        """Yield the precisions that the device has."""
        for precision in self.precisions:
            why = precision.obstacle(self.device)
            if why is None:
                yield precision
            else:
                self.leave_out(precision.name, why)

    def usable_strategies(self, x: Tensor) -> Iterator[Strategy]:
        """Yield the strategies that have something to measure on worlds like `x`, [B, N, D]."""
        for strategy in self.strategies:
            why = strategy.obstacle(x)
            if why is None:
                yield strategy
            else:
                number = str(x.dtype).removeprefix("torch.")
                shape = f"{x.shape[2]}D ({x.shape[0]}, {x.shape[1]})"
                self.leave_out(f"{strategy.name}, {number}, {shape}", why)


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Return |value - expected| / |expected| in the Euclidean norm, taken in float64."""
    exact = expected.detach().double()
    return float((value.detach().double() - exact).norm() / exact.norm())
