"""Suite `skips`: what it saves to leave out what a scene does not need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from npa_envs.bench.session import Session
from npa_envs.bench.timing import Timing
from npa_envs.bench.workloads import Workload
from npa_envs.dynamics import rollout

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
    """Options of the rollout that does it: `Rollouts.cost` says which there are."""
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
            {**training, "memory": "recompute"},
            training,
        ),
    ]


def skip_rows(session: Session) -> list[SkipRow]:
    """Return what each omission saves, measured with and without it in one run."""
    workload = SMALL_WORLDS if session.small else WORLDS if session.cuda else CPU_WORLDS
    rollouts = Rollouts(session, workload)
    rows: list[SkipRow] = []
    for skip in skips(workload):
        rows += session.attempt(skip.left_out, partial(_row, skip, rollouts.cost))
    return rows


def _row(skip: Skip, cost: Callable[..., Timing]) -> SkipRow:
    done, skipped = cost(**skip.done), cost(**skip.skipped)
    saved = 1.0 - skipped.median / done.median
    return SkipRow(skip.left_out, skip.condition, done, skipped, f"{saved:.0%}")


class Rollouts:
    """Rollouts of the same worlds under different conditions.

    Args:
        session: Device and readings.
        workload: Worlds, radius and steps.
    """

    def __init__(self, session: Session, workload: Workload) -> None:
        self._session = session
        self._workload = workload
        self._x, self._s = workload.worlds(session.device)

    def cost(
        self,
        *,
        train: bool = False,
        gradients: bool = False,
        rule: dict[str, bool] | None = None,
        **options: Any,
    ) -> Timing:
        """Return the time of one step.

        Args:
            train: Include the backward pass.
            gradients: Without it, let autograd store what it would read.
            rule: Options of the rule.
            options: Options of `rollout`.
        """
        session, workload = self._session, self._workload
        network = workload.rule(session.device, **(rule or {}))
        generator = torch.Generator(session.device).manual_seed(1)
        given = {"eps": workload.eps, "update_prob": workload.update_prob, **options}

        def run() -> None:
            with torch.set_grad_enabled(train or gradients):
                x, s = rollout(
                    network, self._x, self._s, workload.steps, generator=generator, **given
                )
                if train:
                    torch.autograd.grad(x.sum() + s.sum(), list(network.parameters()))

        return session.cost(run, generator=generator).time.divided(workload.steps)
