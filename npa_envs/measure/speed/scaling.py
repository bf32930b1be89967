"""Suite `scaling`: what a step costs against N, neighbours, B and C, one of them at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from npa_envs.measure.speed.paper import throughput_row
from npa_envs.measure.speed.session import Session
from npa_envs.measure.speed.timing import Timing
from npa_envs.measure.speed.workloads import Workload

AXES = ("particles", "neighbours", "worlds", "channels")
"""What is varied: N at the same density, neighbours within eps, B, C."""


@dataclass(frozen=True)
class ScalingRow:
    """One step of a 2D workload that differs from its neighbours in the table in one number."""

    axis: str
    """What is varied."""
    value: float
    """Its value here."""
    workload: str
    """Dimension and (worlds B, particles N, steps T)."""
    neighbours: float
    """Mean number of particles within eps of one, itself included, far from the edges."""
    channels: int
    """State channels C."""
    infer_us: Timing
    """A step of inference [µs]."""
    train_us: Timing | None
    """A step of training, storing [µs]."""
    infer_mib: float | None
    """Peak memory of inference above the worlds [MiB]."""
    train_mib: float | None
    """Peak memory of training above the worlds [MiB]."""


@dataclass(frozen=True)
class SlopeRow:
    """How time grows: the slope of log time over log value, fitted to an axis's larger half."""

    axis: str
    """What is varied."""
    infer_slope: float
    """Of inference."""
    train_slope: float
    """Of training."""


def scaling_rows(session: Session) -> list[ScalingRow]:
    """Return the rows of all axes, increasing along each."""
    rows: list[ScalingRow] = []
    for axis, values in zip(AXES, _values(session), strict=True):
        for value in values:
            rows += session.attempt(f"{value} {axis}", partial(_row, session, axis, value))
    return rows


def _values(session: Session) -> tuple[Sequence[int], ...]:
    """Return the values of each axis."""
    if session.small:
        return (256, 1024), (16, 64), (1, 2), (4, 16)
    neighbours, channels = (8, 16, 32, 64, 128, 256), (4, 8, 16, 32, 64)
    if session.cuda:
        return [2**k for k in range(10, 21)], neighbours, [2**k for k in range(8)], channels
    return [2**k for k in range(8, 17)], neighbours, (1, 2, 4, 8, 16), channels


def varied(axis: str, value: int, *, small: bool = False) -> Workload:
    """Return the workload in which one number has a value.

    Args:
        axis: One of `AXES`.
        value: The number.
        small: Take the small worlds of small sessions.
    """
    usual = Workload(2, 1, 512 if small else 4096, 4 if small else 8)
    if axis == "particles":
        return replace(usual, particle_count=value)
    if axis == "worlds":
        return replace(usual, world_count=value, particle_count=min(usual.particle_count, 1024))
    if axis == "channels":
        return replace(usual, state_dim=value)
    share = (value - 1) / (usual.neighbour_count - 1)
    return replace(usual, eps=usual.eps * math.sqrt(share))


def _row(session: Session, axis: str, value: int) -> ScalingRow:
    workload = varied(axis, value, small=session.small)
    cost = throughput_row(session, workload)
    return ScalingRow(
        axis=axis,
        value=value,
        workload=workload.name,
        neighbours=workload.neighbour_count,
        channels=workload.state_dim,
        infer_us=cost.infer_us,
        train_us=cost.train_us,
        infer_mib=cost.infer_mib,
        train_mib=cost.train_mib,
    )


def slope_rows(rows: Sequence[ScalingRow]) -> list[SlopeRow]:
    """Return how the times of each axis grow."""
    return [_slope_row(axis, [row for row in rows if row.axis == axis]) for axis in AXES]


def _slope_row(axis: str, rows: Sequence[ScalingRow]) -> SlopeRow:
    larger = rows[-max(2, math.ceil(len(rows) / 2)) :]
    values = np.log([row.value for row in larger])
    infer = np.log([row.infer_us.median for row in larger])
    train = np.log([row.train_us.median for row in larger if row.train_us])
    return SlopeRow(axis, *(float(np.polyfit(values, times, 1)[0]) for times in (infer, train)))
