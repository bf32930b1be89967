"""Suite `skips`: what it saves to leave out what a scene does not need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from npa_envs.bench.session import Session
from npa_envs.bench.timing import Timing
from npa_envs.bench.workloads import Workload, rollout_call

WORLDS, CPU_WORLDS, SMALL_WORLDS = (
    Workload(2, 8, 4096, 16),
    Workload(2, 1, 4096, 4),
    Workload(2, 1, 256, 2),
)
"""Worlds to measure on: of CUDA, of a CPU, of small sessions."""


@dataclass(frozen=True)
class SkipRow:
    """Something that is left out; times are those of one step of a rollout."""

    left_out: str
    """What."""
    condition: str
    """Where it is left out."""
    done_us: Timing
    """A step with it [µs]."""
    skipped_us: Timing
    """The same step without it [µs]."""
    saved: str
    """Share of the step that is saved."""


@dataclass(frozen=True)
class Skip:
    """Two rollouts that differ in one condition alone."""

    left_out: str
    """What the second one leaves out."""
    condition: str
    """The condition."""
    done: dict[str, Any]
    """Options of the rollout that does it: `rollout_call` says which there are."""
    skipped: dict[str, Any]
    """Options of the one that leaves it out."""


def skips(workload: Workload) -> list[Skip]:
    """Return all that rollouts leave out."""
    side = 2.0 * workload.half_width
    training = {"train": True}
    return [
        Skip(
            "what a backward pass reads: signs of hidden units, volumes, kernel sums",
            "no gradient is enabled",
            {"gradients": True},
            {},
        ),
        Skip(
            "cotangents of positions and densities",
            "detach_positions (default)",
            {**training, "detach_positions": False},
            training,
        ),
        Skip(
            "perception, network and lists of inactive particles",
            "update_prob < 1",
            {"update_prob": 1.0},
            {},
        ),
        Skip("the state gradient", "state_gradient=False", {}, {"rule": {"state_gradient": False}}),
        Skip(
            "the moment matrix and its inverse",
            "moment_correction=False",
            {},
            {"rule": {"moment_correction": False}},
        ),
        Skip(
            "columns of the density gradient",
            "density_gradient=False",
            {},
            {"rule": {"density_gradient": False}},
        ),
        Skip("displacements", "static=True", {}, {"rule": {"static": True}}),
        Skip("periodic images", "box=None (default)", {"box": (side, side)}, {}),
        Skip(
            "a second forward pass, for the backward pass",
            "memory='store' (default)",
            {**training, "memory": "minimal"},
            training,
        ),
    ]


def skip_rows(session: Session) -> list[SkipRow]:
    """Return what each omission saves, measured with and without it in one run."""
    workload = SMALL_WORLDS if session.small else WORLDS if session.cuda else CPU_WORLDS
    x, s = workload.worlds(session.device)

    def cost(options: dict[str, Any]) -> Timing:
        run, generator = rollout_call(workload, x, s, **options)
        return session.cost(run, generator=generator).time.divided(workload.steps)

    rows: list[SkipRow] = []
    for skip in skips(workload):
        rows += session.attempt(skip.left_out, partial(_row, skip, cost))
    return rows


def _row(skip: Skip, cost: Callable[[dict[str, Any]], Timing]) -> SkipRow:
    done, skipped = cost(skip.done), cost(skip.skipped)
    saved = 1.0 - skipped.median / done.median
    return SkipRow(skip.left_out, skip.condition, done, skipped, f"{saved:.0%}")
