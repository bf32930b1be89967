"""Suites of `npa-envs bench`: their workloads and tables, the report of a run, and plots."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from typing import Any

from npa_envs.atomic_files import json_text
from npa_envs.measure.benchmark_records import (
    UNMEASURED,
    as_objects,
    machine,
    measured_facts,
    table_text,
)
from npa_envs.measure.plots import new_figure, number_plainly, png
from npa_envs.measure.speed.explain import kernel_rows
from npa_envs.measure.speed.timing import (
    Tables,
    Timing,
    TimingSession,
    Workload,
    rollout_call,
    timed,
)
from npa_envs.world.capture_cache import release_captures
from npa_envs.world.rollout import Memory

# Suite `paper`: inference and training, storing and recomputing.

PROFILED = (
    Workload(2, 8, 4096, 64),
    Workload(2, 1, 4096, 64),
    Workload(2, 8, 65536, 8),
    Workload(3, 4, 16384, 24, 256),
)
"""Workloads of the table of the paper's authors."""

PAPER = (*PROFILED, Workload(2, 1, 2**20, 8), Workload(2, 1, 2**24, 4))
"""Workloads of the suite `paper` on CUDA; of the last one only inference is measured."""

CPU = (Workload(2, 1, 4096, 16), Workload(2, 4, 1024, 16))
"""Workloads of the suite `paper` on a CPU."""

SMALL = (Workload(2, 1, 1024, 8),)
"""Workloads of the suite `quick`, on any device."""


@dataclass(frozen=True)
class ThroughputRow:
    """Times of one step of a workload [µs], and peaks of memory without the worlds [MiB].

    `memory` is the option of `rollout`. Numbers that were not measured are None.
    """

    workload: str
    memory: str
    infer_us: Timing
    train_us: Timing | None
    worlds_mib: float
    infer_mib: float | None
    train_mib: float | None


def throughput_rows(session: TimingSession, workloads: Sequence[Workload]) -> list[ThroughputRow]:
    """Return a row for each workload with memory="store", and one with "recompute" if trained."""
    calls = []
    for workload in workloads:
        train = workload != PAPER[-1]
        if not train:
            session.left_out[f"training of {workload.name}"] = "a workload of inference only"
        modes: tuple[Memory, ...] = ("store", "recompute") if train else ("store",)
        for memory in modes:
            row = partial(throughput_row, session, workload, memory, train=train)
            calls.append((f"{workload.name}, {memory}", row))
    return session.rows(calls)


def throughput_row(
    session: TimingSession, workload: Workload, memory: Memory = "store", *, train: bool = True
) -> ThroughputRow:
    """Return times and memory of a step of a workload, without training unless `train`."""
    x, s = workload.worlds(session.device)
    roll, generator = rollout_call(workload, x, s)
    infer, training = session.cost(roll, generator=generator), None
    if train:
        pull_back, generator = rollout_call(workload, x, s, train=True, memory=memory)
        training = session.cost(pull_back, generator=generator)
    return ThroughputRow(
        workload.name,
        memory,
        infer.time.divided(workload.steps),
        training.time.divided(workload.steps) if training else None,
        (x.nbytes + s.nbytes) / 2**20,
        infer.peak_mib,
        training.peak_mib if training else None,
    )


@dataclass(frozen=True)
class PublicRow:
    """Times of a step of `rollout` [µs], whose calls are synchronised one by one.

    The `launched` ones are of calls with `cuda_graph=False`; the others replay a CUDA graph.
    """

    workload: str
    infer_us: Timing
    train_us: Timing
    launched_infer_us: Timing
    launched_train_us: Timing


def _public_row(session: TimingSession, workload: Workload) -> PublicRow:
    x, s = workload.worlds(session.device)
    timings = []
    calls: tuple[dict[str, Any], ...] = ({}, {"cuda_graph": False})
    for options in calls:
        for train in (False, True):
            run, _ = rollout_call(workload, x, s, train=train, **options)
            for _ in range(3):
                run()
            timing = timed(run, session.device, session.repeats, calls=1)
            timings.append(timing.divided(workload.steps))
    release_captures()
    return PublicRow(workload.name, *timings)


# Suite `scaling`: N, neighbours, B and C, varied one at a time.

AXES = {
    "particles": "particles N, same density",
    "neighbours": "neighbours of a particle",
    "worlds": "worlds B",
    "channels": "state channels C",
}
"""Quantities that are varied, by name, with their labels in plots."""


@dataclass(frozen=True)
class ScalingRow:
    """Times [µs] and memory [MiB] of a step; `neighbours` is a mean, with the particle itself."""

    axis: str
    value: float
    workload: str
    neighbours: float
    channels: int
    infer_us: Timing
    train_us: Timing | None
    infer_mib: float | None
    train_mib: float | None


def scaling_rows(session: TimingSession) -> list[ScalingRow]:
    """Return a row for each value of each of `AXES`; values increase."""
    if session.small:
        values: tuple[Sequence[int], ...] = (256, 1024), (16, 64), (1, 2), (4, 16)
    else:
        powers, worlds = (range(10, 21), 8) if session.cuda else (range(8, 17), 5)
        neighbours, channels = (8, 16, 32, 64, 128, 256), (4, 8, 16, 32, 64)
        values = [2**k for k in powers], neighbours, [2**k for k in range(worlds)], channels
    return session.rows(
        (f"{value} {axis}", partial(_scaling_row, session, axis, value))
        for axis, axis_values in zip(AXES, values, strict=True)
        for value in axis_values
    )


def varied(axis: str, value: int, *, small: bool = False) -> Workload:
    """Return the usual 2D workload, in which one of `AXES` has another value."""
    usual = Workload(2, 1, 512 if small else 4096, 4 if small else 8)
    if axis == "particles":
        return replace(usual, particle_count=value)
    if axis == "worlds":
        return replace(usual, world_count=value, particle_count=min(usual.particle_count, 1024))
    if axis == "channels":
        return replace(usual, state_dim=value)
    factor = (value - 1) / (usual.neighbour_count - 1)
    return replace(usual, eps=usual.eps * math.sqrt(factor))


def _scaling_row(session: TimingSession, axis: str, value: int) -> ScalingRow:
    workload = varied(axis, value, small=session.small)
    cost = throughput_row(session, workload)
    fields = (axis, value, cost.workload, workload.neighbour_count, workload.state_dim)
    return ScalingRow(*fields, cost.infer_us, cost.train_us, cost.infer_mib, cost.train_mib)


# The suites


def paper(session: TimingSession) -> Tables:
    """Return the tables of the suite `paper`: `throughput` and, on CUDA, `public`."""
    workloads = SMALL if session.small else PAPER if session.cuda else CPU
    tables: Tables = {"throughput": throughput_rows(session, workloads)}
    if session.cuda:
        # On a CPU `throughput` measures the same calls.
        public = SMALL if session.small else (*PROFILED, Workload(2, 64, 256, 32))
        tables["public"] = session.rows((w.name, partial(_public_row, session, w)) for w in public)
    return tables


SUITES: dict[str, Callable[[TimingSession], Tables]] = {
    "quick": lambda session: paper(replace(session, small=True)),
    "paper": paper,
    "scaling": lambda session: {"scaling": scaling_rows(session)},
    "kernels": lambda here: {"kernels": kernel_rows(here, SMALL if here.small else PROFILED)},
}
"""Suites by name: functions that measure and return their tables."""


@dataclass(frozen=True)
class BenchReport:
    """Result of one run of a suite."""

    suite: str
    command: str
    commit: str
    """Commit that was measured."""
    threads: int
    session: TimingSession
    tables: Tables

    def text(self) -> str:
        """Return the tables, and what was left out, as plain text."""
        parts = [f"{self.suite} on {machine(self.session.device)}, commit {self.commit}"]
        for name, rows in self.tables.items():
            parts.append(f"{name}:\n{table_text(rows, missing=UNMEASURED)}")
        by_reason: dict[str, list[str]] = {}
        for what, why in self.session.left_out.items():
            by_reason.setdefault(why, []).append(what)
        if by_reason:
            lines = [f"  {why}: {'; '.join(names)}" for why, names in by_reason.items()]
            parts.append("\n".join(["left out:", *lines]))
        return "\n\n".join(parts)

    def json(self) -> str:
        """Return everything as JSON; infinite numbers and NaN become null."""
        content = {
            "suite": self.suite,
            "command": self.command,
            "date": date.today().isoformat(),
            **measured_facts(self.session.device, self.commit, threads=self.threads),
            "tables": {name: as_objects(rows) for name, rows in self.tables.items()},
            "left_out": [{"what": k, "why": why} for k, why in self.session.left_out.items()],
        }
        return json_text(content)


# Plots: how times grow.


def pictures(tables: Tables) -> dict[str, bytes]:
    """Return plots (PNG files by name) if the table `scaling` has all axes. Needs matplotlib."""
    rows = tables.get("scaling", [])
    if {row.axis for row in rows} != set(AXES):
        return {}
    drawn = {"scaling": _draw_scaling(rows, "us", "time of a step [µs]")}
    if any(row.infer_mib is not None for row in rows):
        drawn["memory"] = _draw_scaling(rows, "mib", "peak memory [MiB]")
    return drawn


def _draw_scaling(table: Sequence[ScalingRow], unit: str, name: str) -> bytes:
    """Return a PNG: columns `infer_UNIT` and `train_UNIT`, called `name`, over each of `AXES`."""
    figure, grid = new_figure(2, 2, (9.2, 7.6))
    for axis, panel in zip(AXES, grid.flat, strict=True):
        rows = [row for row in table if row.axis == axis]
        values = [row.value for row in rows]
        for field, label in (("infer", "inference"), ("train", "training")):
            cells = [getattr(row, f"{field}_{unit}") for row in rows]
            # Missing values make gaps.
            numbers = [cell.median if isinstance(cell, Timing) else cell for cell in cells]
            panel.plot(values, numbers, marker="o", ms=4, label=label)
        panel.set(xscale="log", yscale="log", xlabel=AXES[axis], ylabel=name)
        number_plainly(panel.xaxis, values)
        number_plainly(panel.yaxis)
        panel.grid(alpha=0.3)
    grid[0][0].legend()
    return png(figure)
