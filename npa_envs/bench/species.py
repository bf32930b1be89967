"""Suite `species`: what a world of one species pays for the others that could be there: nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from npa_envs.bench.session import Session
from npa_envs.bench.timing import Timing, compare
from npa_envs.bench.workloads import Workload, rollout_call
from npa_envs.rule.rule import NPARule
from npa_envs.world.species import rollout_species

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
