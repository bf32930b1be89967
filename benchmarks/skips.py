"""Time that rollouts save by leaving out what a scene does not need, and that species cost.

python benchmarks/skips.py --device cuda --output FILE
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from scripts import script_facts, script_parser
from torch import Tensor

from npa_envs.atomic_files import write_text
from npa_envs.checks import check_device
from npa_envs.measure.speed.suites import BenchReport
from npa_envs.measure.speed.timing import Timing, TimingSession, Workload, rollout_call
from npa_envs.rule.rule import NPARule
from npa_envs.world.rollout import rollout
from npa_envs.world.species import rollout_species

SKIPPED = {
    "cuda": Workload(2, 8, 4096, 16),
    "cpu": Workload(2, 1, 4096, 4),
    "small": Workload(2, 1, 256, 2),
}
"""Workload of the suite by `TimingSession.size`."""


@dataclass(frozen=True)
class SkipRow:
    """A computation that rollouts skip under a condition; times of a step with and without [µs]."""

    left_out: str
    condition: str
    done_us: Timing
    skipped_us: Timing
    saved: str


Skip = tuple[str, str, dict[str, Any], dict[str, Any]]
"""A computation, the condition to leave it out, and options of `rollout_call` with, without it."""


def skips(workload: Workload) -> list[Skip]:
    """Return all computations that rollouts of a workload can leave out."""
    side = 2.0 * workload.half_width
    training: dict[str, Any] = {"train": True}
    # Cells and densities are computed in each step if positions may have a gradient.
    rebuilt: dict[str, Any] = {"detach_positions": False}
    longer = rebuilt | {"steps": 32}
    static: dict[str, Any] = {"rule": {"static": True}}

    def option(name: str) -> dict[str, Any]:
        return {"rule": {name: False}}

    return [
        (
            "what a backward pass reads: signs of hidden units, volumes, kernel sums",
            "no gradient is enabled", {"gradients": True}, {},
        ),
        (
            "cotangents of positions and densities",
            "detach_positions (default)", training | rebuilt, training,
        ),
        (
            "perception, network and lists of inactive particles",
            "update_prob < 1", {"update_prob": 1.0}, {},
        ),
        ("the state gradient", "state_gradient=False", {}, option("state_gradient")),
        (
            "the moment matrix and its inverse",
            "moment_correction=False", {}, option("moment_correction"),
        ),
        (
            "columns of the density gradient",
            "density_gradient=False", {}, option("density_gradient"),
        ),
        ("displacements", "static=True", rebuilt, static | rebuilt),
        (
            "cells, densities and neighbour lists",
            "static=True, without position_noise", static | longer, static | {"steps": 32},
        ),
        ("periodic images", "box=None (default)", {"box": (side, side)}, {}),
        (
            "a second forward pass, for the backward pass",
            "memory='store' (default)", training | {"memory": "minimal"}, training,
        ),
    ]  # fmt: skip


def skip_rows(session: TimingSession) -> list[SkipRow]:
    """Return a row for each computation of `skips`."""
    workload = SKIPPED[session.size]
    x, s = workload.worlds(session.device)

    def cost(options: dict[str, Any]) -> Timing:
        kwargs: dict[str, Any] = {"steps": workload.steps} | options
        rolled = replace(workload, steps=kwargs.pop("steps"))
        run, generator = rollout_call(rolled, x, s, **kwargs)
        return session.cost(run, generator=generator).time.divided(rolled.steps)

    def row(left_out: str, condition: str, *options: dict[str, Any]) -> SkipRow:
        return _skip_row(left_out, condition, *map(cost, options))

    return session.rows((skip[0], partial(row, *skip)) for skip in skips(workload))


def _skip_row(left_out: str, condition: str, done: Timing, skipped: Timing) -> SkipRow:
    saved = 1.0 - skipped.median / done.median
    return SkipRow(left_out, condition, done, skipped, f"{saved:.0%}")


# What `rollout_species` with one species costs more than `rollout`.

SPECIES = {
    "cuda": (Workload(2, 8, 4096, 16), Workload(2, 1, 256, 16)),
    "cpu": (Workload(2, 1, 4096, 4), Workload(2, 1, 256, 4)),
    "small": (Workload(2, 1, 256, 2),),
}
"""Workloads of the suite by `TimingSession.size`; ones of few particles show the cost of a call."""


def one_species_rows(session: TimingSession) -> list[SkipRow]:
    """Return rows of what `rollout` skips, on CUDA also where graphs replay the calls."""

    def row(workload: Workload, train: bool, graph: bool) -> SkipRow:
        x, s = workload.worlds(session.device)
        counts = [workload.particle_count]

        def roll_species(rule: NPARule, *arguments: Any, **options: Any) -> tuple[Tensor, ...]:
            options |= {"counts": counts, "density_counts": counts}
            return rollout_species([rule], *arguments, **options)

        times = []
        # Both draw the same masks.
        for roll in (roll_species, rollout):
            run, generator = rollout_call(workload, x, s, train=train, roll=roll)
            cost = session.cost(run, graph=graph, generator=generator)
            times.append(cost.time.divided(workload.steps))
        what = f"{'training' if train else 'inference'}, {'graph' if graph else 'eager'}"
        return _skip_row(f"species, {workload.name}", what, *times)

    graphs = (False, True) if session.cuda else (False,)
    cases = itertools.product(SPECIES[session.size], (False, True), graphs)
    return session.rows((f"one species, {case}", partial(row, *case)) for case in cases)


def main() -> int:
    """Measure, print and write; return 0."""
    parser = script_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="small worlds only")
    parser.add_argument("--repeats", type=int, default=7, help="readings of every time")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    session = TimingSession(
        device=check_device(arguments.device), repeats=arguments.repeats, small=arguments.quick
    )
    tables = {"skips": skip_rows(session), "one_species": one_species_rows(session)}
    facts = script_facts(arguments)
    report = BenchReport(
        "skips", facts["command"], facts["commit"], arguments.threads, session, tables
    )
    print(report.text())
    if arguments.output is not None:
        write_text(arguments.output, report.json())
    return 0


if __name__ == "__main__":
    sys.exit(main())
