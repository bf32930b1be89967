"""Suite `skips`: what it saves to leave out what a scene does not need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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

STATIC_STEPS = 32
"""Steps of a rollout that does once what never changes."""


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
    steps: int | None = None
    """Steps of both; default: the workload's."""


def skips(workload: Workload) -> list[Skip]:
    """Return all that rollouts leave out."""
    side = 2.0 * workload.half_width
    training = {"train": True}
    # What follows from positions is computed anew in each step if they may get a gradient.
    rebuilt = {"detach_positions": False}
    static = {"rule": {"static": True}}
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
        Skip("displacements", "static=True", rebuilt, {**static, **rebuilt}),
        Skip(
            "cells, densities, moments and pair weights",
            "static=True, without position_noise",
            {**static, **rebuilt},
            static,
            STATIC_STEPS,
        ),
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

    def cost(options: dict[str, Any], steps: int | None) -> Timing:
        rolled = replace(workload, steps=steps or workload.steps)
        run, generator = rollout_call(rolled, x, s, **options)
        return session.cost(run, generator=generator).time.divided(rolled.steps)

    rows: list[SkipRow] = []
    for skip in skips(workload):
        rows += session.attempt(skip.left_out, partial(_row, skip, cost))
    return rows


def _row(skip: Skip, cost: Callable[[dict[str, Any], int | None], Timing]) -> SkipRow:
    done, skipped = cost(skip.done, skip.steps), cost(skip.skipped, skip.steps)
    saved = 1.0 - skipped.median / done.median
    return SkipRow(skip.left_out, skip.condition, done, skipped, f"{saved:.0%}")
