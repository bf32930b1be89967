"""The suites of `npa-envs bench`: which tables each one makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from npa_envs.errors import NPAError, suggest
from npa_envs.measure.speed import ratios as guard
from npa_envs.measure.speed.drift import drift_rows
from npa_envs.measure.speed.explain import kernel_rows
from npa_envs.measure.speed.paper import (
    CPU,
    ONE_WORLD,
    PAPER,
    PROFILED,
    SMALL,
    aim_rows,
    throughput_rows,
)
from npa_envs.measure.speed.peers import peer_rows
from npa_envs.measure.speed.perception import perception_rows
from npa_envs.measure.speed.rollouts import rollout_rows
from npa_envs.measure.speed.scaling import scaling_rows, slope_rows
from npa_envs.measure.speed.session import Session, Tables
from npa_envs.measure.speed.skips import one_species_rows, skip_rows
from npa_envs.measure.speed.workloads import Workload


@dataclass(frozen=True)
class Suite:
    """Some measurements that belong together."""

    summary: str
    """What it measures, in a few words."""
    run: Callable[[Session], Tables]
    """Makes its tables."""
    guarded: bool = False
    """Whether ratios are measured as well."""

    def ratios(self, session: Session) -> dict[str, float]:
        """Return how many times faster the library is; empty where the suite does not ask."""
        return guard.ratios(session) if self.guarded else {}


def accuracy(session: Session) -> Tables:
    """Return run time against error: of perception, of rollouts, of other libraries."""
    geckos = [1024] if session.small else [1024, 4096]
    return {
        "perception": [
            row for workload in _worlds(session) for row in perception_rows(session, workload)
        ],
        "rollouts": [row for count in geckos for row in rollout_rows(session, count)],
        "peers": peers(session),
    }


def _worlds(session: Session) -> list[Workload]:
    """Return the worlds that the suite `accuracy` perceives."""
    if session.small:
        return [Workload(2, 1, 1024, 1), Workload(3, 1, 512, 1)]
    flat = [Workload(2, 1, count, 1) for count in (1024, 4096, 65536 if session.cuda else 16384)]
    return [*flat, Workload(2, 8, 4096, 1), Workload(3, 1, 1024, 1), Workload(3, 1, 16384, 1)]


def peers(session: Session) -> list[object]:
    """Return the rows of other libraries, in 2D and 3D."""
    worlds = (Workload(2, 1, 1024, 1), Workload(3, 1, 512 if session.small else 1024, 1))
    return [row for workload in worlds for row in peer_rows(session, workload)]


def paper(session: Session) -> Tables:
    """Return the paper's table: inference, training and memory; and float32's errors there."""
    workloads = SMALL if session.small else PAPER if session.cuda else CPU
    drifting = SMALL if session.small else PROFILED if session.cuda else (ONE_WORLD,)
    rows = throughput_rows(session, workloads)
    tables: Tables = {"throughput": rows, "drift": drift_rows(session, drifting)}
    if session.cuda and not session.small:
        tables["aims"] = aim_rows(rows)
    return tables


def scaling(session: Session) -> Tables:
    """Return time and memory against N, neighbours, B and C."""
    rows = scaling_rows(session)
    return {"scaling": rows, "slopes": slope_rows(rows)}


def quick(session: Session) -> Tables:
    """Return the small tables of the suites `accuracy` and `paper`."""
    session.small = True
    return {**accuracy(session), **paper(session)}


def skipped(session: Session) -> Tables:
    """Return what it saves to leave out what a scene does not need."""
    return {"skips": skip_rows(session)}


def species(session: Session) -> Tables:
    """Return what one species costs where there could be several."""
    return {"one_species": one_species_rows(session)}


def kernels(session: Session) -> Tables:
    """Return the kernels of the paper's workloads."""
    return {"kernels": kernel_rows(session, SMALL if session.small else PROFILED)}


SUITES = {
    "quick": Suite("small worlds; about a minute on a CPU", quick, guarded=True),
    "paper": Suite("the paper's workloads: inference, training, memory, errors", paper),
    "accuracy": Suite("run time against error, by strategy and precision; peers", accuracy),
    "scaling": Suite("time and memory against N, neighbours, B and C", scaling),
    "skips": Suite("what it saves to leave out what a scene does not need", skipped),
    "species": Suite("what a world of one species pays for others: rollouts in turn", species),
    "kernels": Suite("which CUDA kernels a step takes, and how long each", kernels),
}
"""Every suite by its name."""


def suite_of(name: str) -> Suite:
    """Return the suite of a name.

    Raises:
        NPAError: There is none.
    """
    if name not in SUITES:
        raise NPAError(f"unknown suite {name!r}: {suggest(name, SUITES)}")
    return SUITES[name]
