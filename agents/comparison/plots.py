"""Learning curves with bands over the seeds: a picture for each task."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from npa_envs.agents.comparison.plan import AXES
from npa_envs.agents.comparison.record import Point, RunRecord
from npa_envs.agents.comparison.tables import HEADINGS

ACROSS: dict[str, Callable[[Point], float]] = {
    "wall time [s]": lambda point: point.seconds,
    "particle-steps": lambda point: point.particle_steps,
}
"""What curves are drawn against."""

BAND = 0.2
"""Opacity of the band of one standard error on either side."""

PLACES = 64
"""Places along a curve at which seeds are averaged."""


class Curve(NamedTuple):
    """A mean over seeds."""

    across: NDArray[np.float64]
    """Where, shape [K]."""
    mean: NDArray[np.float64]
    """Mean of the seeds, shape [K]."""
    error: NDArray[np.float64]
    """Its standard error, 0 for a single seed, shape [K]."""


def curve(records: Sequence[RunRecord], across: Callable[[Point], float]) -> Curve | None:
    """Return the mean of learning curves where all of them are; None where they nowhere are.

    Between its points a curve is straight. What does not learn has a single point: its curve is
    that. Runs that broke off are left out, so that they do not cut off the others, unless all did.

    Args:
        records: Of one method on one task from several seeds; those without a curve are left out.
        across: What curves are drawn against.
    """
    lines = []
    for record in _whole(records):
        kept = [point for point in record.curve if np.isfinite(point.mean_return)]
        if kept:
            lines.append(([across(point) for point in kept], [point.mean_return for point in kept]))
    if not lines:
        return None
    first, last = max(line[0][0] for line in lines), min(line[0][-1] for line in lines)
    if first > last:
        return None
    grid = np.linspace(first, last, PLACES if last > first else 1)
    values = np.stack([np.interp(grid, *line) for line in lines])
    error = np.zeros(len(grid))
    if len(lines) > 1:
        error = values.std(axis=0, ddof=1) / np.sqrt(len(lines))
    return Curve(grid, values.mean(axis=0), error)


def _whole(records: Sequence[RunRecord]) -> Sequence[RunRecord]:
    """Return the runs that came to their end, all where none did."""
    return [record for record in records if record.status == "done"] or records


def pictures(records: Sequence[RunRecord]) -> dict[str, bytes]:
    """Return PNG files by their tasks' names. Needs matplotlib.

    Args:
        records: Those of the runs.
    """
    tasks = dict.fromkeys(record.job.task for record in records)
    return {task: _draw([r for r in records if r.job.task == task]) for task in tasks}


def _draw(records: Sequence[RunRecord]) -> bytes:
    from matplotlib.figure import Figure

    axes = [axis for axis in AXES if any(record.job.axis == axis for record in records)]
    methods = list(dict.fromkeys(record.job.method for record in records))
    figure = Figure(figsize=(10.0, 3.4 * len(axes)), layout="constrained")
    grid = figure.subplots(len(axes), len(ACROSS), squeeze=False)
    for axis, panels in zip(axes, grid, strict=True):
        for (label, across), panel in zip(ACROSS.items(), panels, strict=True):
            for number, method in enumerate(methods):
                some = [r for r in records if (r.job.axis, r.job.method) == (axis, method)]
                _draw_method(panel, curve(some, across), f"C{number}", _name(method, records))
            panel.set_xlabel(label)
            panel.set_ylabel("return of held-out episodes")
            panel.set_title(HEADINGS[axis], fontsize=9, loc="left")
            panel.grid(alpha=0.3)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8)
    figure.suptitle(records[0].job.task)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


def _name(method: str, records: Sequence[RunRecord]) -> str:
    """Return what a method is called in a picture: with the number of whole runs where not all."""
    states = [record.status for record in records if record.job.method == method]
    done = states.count("done")
    return method if done == len(states) else f"{method} ({done} of {len(states)})"


def _draw_method(panel: Any, found: Curve | None, colour: str, name: str) -> None:
    if found is None:
        panel.plot([], [], color=colour, label=name)
        return
    if len(found.across) == 1:
        # It does not learn: what it gets, it gets for nothing.
        (mean,), (error,) = found.mean, found.error
        panel.axhline(mean, color=colour, lw=1.0, ls="--", label=name)
        panel.axhspan(mean - error, mean + error, color=colour, alpha=BAND, lw=0)
        return
    panel.plot(found.across, found.mean, color=colour, lw=1.5, label=name)
    low, high = found.mean - found.error, found.mean + found.error
    panel.fill_between(found.across, low, high, color=colour, alpha=BAND, lw=0)
