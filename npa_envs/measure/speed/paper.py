"""Suite `paper`: what a step of inference and of training costs, storing and recomputing."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch

from npa_envs.measure.speed.session import Session
from npa_envs.measure.speed.timing import Cost, Timing
from npa_envs.measure.speed.workloads import Workload, rollout_call
from npa_envs.world.rollout import Memory


class Aim(NamedTuple):
    """What a workload should cost on an H200."""

    infer_us: float
    """A step of inference [µs]."""
    train_us: float
    """A step of training [µs], the faster of storing and recomputing."""
    train_mib: float | None
    """Peak memory of training with recomputing [MiB]."""


EIGHT_WORLDS = Workload(2, 8, 4096, 64)
ONE_WORLD = Workload(2, 1, 4096, 64)
LARGE_WORLDS = Workload(2, 8, 65536, 8)
CUBES = Workload(3, 4, 16384, 24, 256)
MILLION = Workload(2, 1, 2**20, 8)
SIXTEEN_MILLION = Workload(2, 1, 2**24, 4)

PAPER = (EIGHT_WORLDS, ONE_WORLD, LARGE_WORLDS, CUBES, MILLION, SIXTEEN_MILLION)
"""Workloads on CUDA."""

PROFILED = PAPER[:4]
"""Those of the authors' own table."""

CPU = (Workload(2, 1, 4096, 16), Workload(2, 4, 1024, 16))
"""Workloads on a CPU."""

SMALL = (Workload(2, 1, 1024, 8),)
"""Workloads of small sessions."""

INFERENCE_ONLY = (SIXTEEN_MILLION,)
"""Workloads that are not trained."""

AIMS = {
    EIGHT_WORLDS: Aim(72, 163, 395),
    ONE_WORLD: Aim(50, 120, 64),
    LARGE_WORLDS: Aim(700, 1450, 810),
    CUBES: Aim(150, 310, 450),
    MILLION: Aim(1500, 3500, None),
}
"""What is aimed at on an H200."""


@dataclass(frozen=True)
class ThroughputRow:
    """A workload in one of the two ways to remember a rollout; times are those of one step."""

    workload: str
    """Dimension and (worlds B, particles N, steps T)."""
    memory: str
    """Whether training stores what the backward pass reads, or recomputes two steps in three."""
    infer_us: Timing
    """A step of inference [µs]."""
    train_us: Timing | None
    """A step of training [µs]."""
    worlds_mib: float
    """Memory of the worlds themselves [MiB]."""
    infer_mib: float | None
    """Peak memory of inference above the worlds [MiB]."""
    train_mib: float | None
    """Peak memory of training above the worlds [MiB]."""


@dataclass(frozen=True)
class AimRow:
    """A workload against what is aimed at on an H200."""

    workload: str
    """Dimension and (worlds B, particles N, steps T)."""
    infer_us: float
    """A step of inference [µs]."""
    infer_aim: float
    """What it should be [µs]."""
    train_us: float
    """A step of training, storing or recomputing, whichever is faster [µs]."""
    train_aim: float
    """What it should be [µs]."""
    recompute_mib: float
    """Peak memory of training with recomputing [MiB]."""
    mib_aim: float | None
    """What it should be [MiB]."""
    recompute_slower: float
    """Training's time with recomputing over the faster one's (dimensionless)."""


def throughput_rows(session: Session, workloads: Sequence[Workload]) -> list[ThroughputRow]:
    """Return two rows for each workload: storing and recomputing."""
    rows: list[ThroughputRow] = []
    for workload in workloads:
        train = workload not in INFERENCE_ONLY
        if not train:
            session.leave_out(f"training of {workload.name}", "a workload of inference only")
        modes: tuple[Memory, ...] = ("store", "recompute") if train else ("store",)
        for memory in modes:
            rows += session.attempt(
                f"{workload.name}, {memory}",
                partial(throughput_row, session, workload, memory, train=train),
            )
    return rows


def throughput_row(
    session: Session, workload: Workload, memory: Memory = "store", *, train: bool = True
) -> ThroughputRow:
    """Return what a step of a workload costs."""
    x, s = workload.worlds(session.device)
    infer, training = rollout_costs(session, workload, x, s, memory, train=train)
    return ThroughputRow(
        workload=workload.name,
        memory=memory,
        infer_us=infer.time.divided(workload.steps),
        train_us=training.time.divided(workload.steps) if training else None,
        worlds_mib=(x.nbytes + s.nbytes) / 2**20,
        infer_mib=infer.peak_mib,
        train_mib=training.peak_mib if training else None,
    )


def rollout_costs(
    session: Session,
    workload: Workload,
    x: torch.Tensor,
    s: torch.Tensor,
    memory: Memory,
    *,
    train: bool,
) -> tuple[Cost, Cost | None]:
    """Return what a rollout costs, and what it costs with a functional's gradient by the weights.

    Args:
        session: Device and readings.
        workload: Rule, radius and steps.
        x: Positions [length units], shape [B, N, D].
        s: States, dimensionless, shape [B, N, C].
        memory: What training does about what the backward pass reads.
        train: Whether to measure training at all.
    """
    infer, generator = rollout_call(workload, x, s)
    inference = session.cost(infer, generator=generator)
    if not train:
        return inference, None
    pull_back, generator = rollout_call(workload, x, s, train=True, memory=memory)
    return inference, session.cost(pull_back, generator=generator)


def aim_rows(rows: Sequence[ThroughputRow]) -> list[AimRow]:
    """Return the workloads that have an aim against it; none where memory was not measured."""
    aims = {workload.name: aim for workload, aim in AIMS.items()}
    return [
        _aim_row(store, recompute, aims[store.workload])
        for store, recompute in itertools.pairwise(rows)
        if store.workload == recompute.workload in aims
    ]


def _aim_row(store: ThroughputRow, recompute: ThroughputRow, aim: Aim) -> AimRow:
    assert store.train_us is not None
    assert recompute.train_us is not None
    assert recompute.train_mib is not None
    train_us = min(store.train_us.median, recompute.train_us.median)
    return AimRow(
        workload=store.workload,
        infer_us=min(store.infer_us.median, recompute.infer_us.median),
        infer_aim=aim.infer_us,
        train_us=train_us,
        train_aim=aim.train_us,
        recompute_mib=recompute.train_mib,
        mib_aim=aim.train_mib,
        recompute_slower=recompute.train_us.median / train_us,
    )
