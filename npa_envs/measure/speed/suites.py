"""Suites of `npa-envs bench`: the tables that each makes, their report and plots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

import torch

from npa_envs.files import json_text
from npa_envs.measure.plots import new_figure, number_plainly, png
from npa_envs.measure.record import machine, versions
from npa_envs.measure.speed.explain import kernel_rows
from npa_envs.measure.speed.throughput import (
    AXES,
    CPU,
    ONE_WORLD,
    PAPER,
    PROFILED,
    PUBLIC,
    SMALL,
    ScalingRow,
    drift_rows,
    one_species_rows,
    public_rows,
    scaling_rows,
    skip_rows,
    slope_rows,
    throughput_rows,
)
from npa_envs.measure.speed.timing import LeftOut, Tables, Timing, TimingSession
from npa_envs.measure.tables import UNMEASURED, as_objects, table_text


def paper(session: TimingSession) -> Tables:
    """Return the paper's table, times of the public call, and errors of float32."""
    workloads = SMALL if session.small else PAPER if session.cuda else CPU
    drifting = SMALL if session.small else PROFILED if session.cuda else (ONE_WORLD,)
    tables: Tables = {
        "throughput": throughput_rows(session, workloads),
        "drift": drift_rows(session, drifting),
    }
    if session.cuda:
        # On a CPU the throughput is that of the public call.
        tables["public"] = public_rows(session, SMALL if session.small else PUBLIC)
    return tables


def scaling(session: TimingSession) -> Tables:
    """Return time and memory against N, neighbours, B and C."""
    rows = scaling_rows(session)
    return {"scaling": rows, "slopes": slope_rows(rows)}


def quick(session: TimingSession) -> Tables:
    """Return the small tables of the suite `paper`."""
    session.small = True
    return paper(session)


SUITES: dict[str, Callable[[TimingSession], Tables]] = {
    "quick": quick,
    "paper": paper,
    "scaling": scaling,
    "skips": lambda session: {"skips": skip_rows(session)},
    "species": lambda session: {"one_species": one_species_rows(session)},
    "kernels": lambda here: {"kernels": kernel_rows(here, SMALL if here.small else PROFILED)},
}
"""What makes the tables of each suite."""


@dataclass(frozen=True)
class BenchReport:
    """One run of one suite."""

    suite: str
    command: str
    commit: str
    """Commit that was measured."""
    device: torch.device
    threads: int
    tables: Tables
    """Rows by the table's name."""
    left_out: Sequence[LeftOut]

    def text(self) -> str:
        """Return the tables as plain text."""
        parts = [f"{self.suite} on {machine(self.device)}, commit {self.commit}"]
        for name, rows in self.tables.items():
            parts.append(f"{name}:\n{table_text(rows, missing=UNMEASURED)}")
        by_reason: dict[str, list[str]] = {}
        for entry in self.left_out:
            by_reason.setdefault(entry.why, []).append(entry.what)
        if by_reason:
            lines = [f"  {why}: {'; '.join(names)}" for why, names in by_reason.items()]
            parts.append("\n".join(["left out:", *lines]))
        return "\n\n".join(parts)

    def json(self) -> str:
        """Return everything as JSON; a number that is not finite becomes null."""
        content = {
            "suite": self.suite,
            "command": self.command,
            "commit": self.commit,
            "date": date.today().isoformat(),
            "device": self.device.type,
            "machine": machine(self.device),
            "threads": self.threads,
            "versions": versions(),
            "tables": {name: as_objects(rows) for name, rows in self.tables.items()},
            "left_out": as_objects(self.left_out),
        }
        return json_text(content)


# Plots: how times grow.

AXIS_LABELS = {
    "particles": "particles N, same density",
    "neighbours": "neighbours of a particle",
    "worlds": "worlds B",
    "channels": "state channels C",
}
"""What the axes of the suite `scaling` are called."""


def pictures(tables: Tables) -> dict[str, bytes]:
    """Return PNG files by their names, of tables that are there and whole. Needs matplotlib."""
    drawn = {}
    rows = tables.get("scaling", [])
    if {row.axis for row in rows} == set(AXES):
        drawn["scaling"] = png(_draw_scaling(rows, "time"))
        if any(row.infer_mib is not None for row in rows):
            drawn["memory"] = png(_draw_scaling(rows, "memory"))
    return drawn


def _draw_scaling(table: Sequence[ScalingRow], what: str) -> Any:
    figure, grid = new_figure(2, 2, (9.2, 7.6))
    panels = grid.ravel()
    unit = "us" if what == "time" else "mib"
    for name, panel in zip(AXES, panels, strict=True):
        rows = [row for row in table if row.axis == name]
        for field, label in (("infer", "inference"), ("train", "training")):
            found = [getattr(row, f"{field}_{unit}") for row in rows]
            # A cell that was not measured is a gap.
            values = [cell.median if isinstance(cell, Timing) else cell for cell in found]
            panel.plot([row.value for row in rows], values, marker="o", ms=4, label=label)
        panel.set(xscale="log", yscale="log", xlabel=AXIS_LABELS[name])
        panel.set_ylabel("time of a step [µs]" if what == "time" else "peak memory [MiB]")
        number_plainly(panel.xaxis, [row.value for row in rows])
        number_plainly(panel.yaxis)
        panel.tick_params(axis="x", labelsize=8)
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    return figure
