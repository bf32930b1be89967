"""Suite `skips`: what it saves to leave out what a scene does not need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor

from npa_envs.measure.speed.session import Session
from npa_envs.measure.speed.timing import Timing, compare
from npa_envs.measure.speed.workloads import Workload, rollout_call
from npa_envs.rule.rule import NPARule
from npa_envs.world.species import rollout_species

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


# Suite `species`: what a world of one species pays for the others that could be there: nothing.


SPECIES_WORLDS, CPU_SPECIES_WORLDS, SMALL_SPECIES_WORLDS = (
    (Workload(2, 8, 4096, 16), Workload(2, 1, 256, 16)),
    (Workload(2, 1, 4096, 4), Workload(2, 1, 256, 4)),
    (Workload(2, 1, 256, 2),),
)
"""Worlds to measure on: of CUDA, of a CPU, of small sessions. What is paid once shows in few steps
of few particles."""

PAIRS_PER_REPEAT = 3
"""Pairs of readings for each reading of other tables: a ratio of nearly 1 needs more of them."""


@dataclass(frozen=True)
class OneSpeciesRow:
    """The same rule and worlds by both rollouts; times are those of one step."""

    workload: str
    """Dimension and (worlds B, particles N, steps T)."""
    what: str
    """"inference", or "training": also a functional's gradient by the rule's weights."""
    calls: str
    """"eager", or "graph" where CUDA replays what was captured and the host does nothing."""
    rollout_us: Timing
    """A step of `rollout` [µs]."""
    species_us: Timing
    """A step of `rollout_species` with one species [µs]."""
    ratio: float
    """Median of species_us / rollout_us over pairs of readings in turn; aimed at: at most 1.03."""


def one_species_rows(session: Session) -> list[OneSpeciesRow]:
    """Return what one species costs beside `rollout`, inference and training."""
    workloads = (
        SMALL_SPECIES_WORLDS
        if session.small
        else SPECIES_WORLDS
        if session.cuda
        else CPU_SPECIES_WORLDS
    )
    rows: list[OneSpeciesRow] = []
    for workload in workloads:
        for train in (False, True):
            for graph in (False, True) if session.cuda else (False,):
                what = f"one species, {'training' if train else 'inference'} of {workload.name}"
                rows += session.attempt(
                    what, partial(_species_row, session, workload, train, graph)
                )
    return rows


def _species_row(session: Session, workload: Workload, train: bool, graph: bool) -> OneSpeciesRow:
    x, s = workload.worlds(session.device)
    make: Callable[..., Any] = partial(rollout_call, workload, x, s, train=train)
    # Each draws the same masks, as often as the other one is called.
    alone, species = make(), make(roll=roll_one_species)
    compared = compare(
        alone, species, session.device, repeats=PAIRS_PER_REPEAT * session.repeats, graph=graph
    )
    return OneSpeciesRow(
        workload.name,
        "training" if train else "inference",
        "graph" if graph else "eager",
        compared.first.divided(workload.steps),
        compared.second.divided(workload.steps),
        compared.ratio,
    )


def roll_one_species(
    rule: NPARule, x: Tensor, s: Tensor, steps: int, **options: Any
) -> tuple[Tensor, Tensor]:
    """Roll worlds out as those of one species that sees densities as it does alone."""
    count = [x.shape[1]]
    worlds: tuple[Tensor, Tensor] = rollout_species(
        [rule], x, s, steps, counts=count, density_counts=count, **options
    )
    return worlds
