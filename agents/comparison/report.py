"""Records as a table: what each method reached on each task, and the gradient beside it."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from npa_envs.agents.comparison.pictures import write_strips
from npa_envs.agents.comparison.plan import AXES, Axis, Plan
from npa_envs.agents.comparison.record import Point, RunRecord
from npa_envs.files import write_text
from npa_envs.measure.speed.plots import write_plots

YARDSTICK, NOTHING = "gradient", "zero"
"""Methods whose returns count as 1 and as 0."""

LOST = ("diverged", "left the world")
"""Endings of episodes that diverged: of worlds, and of species."""

NONE = "–"
"""What is not known."""

HEADINGS: Mapping[Axis, str] = {
    "seconds": "Equal wall time",
    "particle-steps": "Equal particle-steps",
}


class Estimate(NamedTuple):
    """A mean over seeds."""

    mean: float
    """The mean; NaN where there is nothing to take it of."""
    error: float
    """Its standard error; NaN where there are fewer than two seeds."""

    def __str__(self) -> str:
        if math.isnan(self.mean):
            return NONE
        told = f"{self.mean:.3f}"
        return told if math.isnan(self.error) else f"{told} ± {self.error:.3f}"


def estimate(values: Iterable[float]) -> Estimate:
    """Return the mean of values and its standard error.

    Args:
        values: One for each seed; what is not finite is left out.
    """
    kept = [value for value in values if math.isfinite(value)]
    if not kept:
        return Estimate(math.nan, math.nan)
    mean = sum(kept) / len(kept)
    if len(kept) < 2:
        return Estimate(mean, math.nan)
    variance = sum((value - mean) ** 2 for value in kept) / (len(kept) - 1)
    return Estimate(mean, math.sqrt(variance / len(kept)))


@dataclass(frozen=True)
class Row:
    """What a method reached on a task, over its seeds."""

    axis: Axis
    """What was equal for all methods."""
    task: str
    """The task."""
    method: str
    """The method."""
    done: int
    """Runs that came to their end."""
    diverged: int
    """Runs whose numbers became infinite or NaN."""
    failed: int
    """Runs that ended in another error."""
    counted: int
    """Runs whose return is finite: those that means are taken of."""
    episodes_diverged: float
    """Share of the held-out episodes in which a world diverged; NaN without episodes."""
    final_return: Estimate
    """Of held-out episodes."""
    final_loss: Estimate
    """At the ends of the same episodes."""
    fraction: Estimate
    """Of the gradient's improvement over doing nothing."""
    seconds: float
    """Mean wall time that training took [s]."""
    particle_steps: float
    """Mean particle-steps that training took."""

    @property
    def runs(self) -> int:
        """All runs, whatever became of them."""
        return self.done + self.diverged + self.failed


def rows(records: Iterable[RunRecord]) -> list[Row]:
    """Return a row for each method on each task for each axis, in the order of the records.

    Args:
        records: Those of the runs.
    """
    groups: dict[tuple[Axis, str, str], list[RunRecord]] = {}
    for record in records:
        job = record.job
        groups.setdefault((job.axis, job.task, job.method), []).append(record)
    returns = {key: _returns(some) for key, some in groups.items()}
    empty = Estimate(math.nan, math.nan)
    return [
        _row(
            some,
            returns[key],
            nothing=returns.get((*key[:2], NOTHING), empty),
            yardstick=returns.get((*key[:2], YARDSTICK), empty),
        )
        for key, some in groups.items()
    ]


def fraction(reached: Estimate, nothing: Estimate, yardstick: Estimate) -> Estimate:
    """Return (R - R_nothing) / (R_yardstick - R_nothing), with the error that both R have.

    It is not defined where the yardstick is no better than nothing. Errors are propagated to first
    order; that of R_nothing, which is the same in both differences, is left out.

    Args:
        reached: The method's mean return R.
        nothing: That of zero actions.
        yardstick: That of the gradient.
    """
    gain = yardstick.mean - nothing.mean
    if not gain > 0.0 or math.isnan(reached.mean):
        return Estimate(math.nan, math.nan)
    share = (reached.mean - nothing.mean) / gain
    return Estimate(share, math.hypot(reached.error, share * yardstick.error) / gain)


def _returns(records: Sequence[RunRecord]) -> Estimate:
    return estimate(record.mean_return for record in records)


def _row(
    records: Sequence[RunRecord], reached: Estimate, *, nothing: Estimate, yardstick: Estimate
) -> Row:
    job = records[0].job
    states = [record.status for record in records]
    lasts = [record.curve[-1] for record in records if record.curve]
    endings = [record.endings for record in records if record.endings]
    episodes = sum(sum(ending.values()) for ending in endings)
    lost = sum(ending.get(word, 0) for ending in endings for word in LOST)
    share = fraction(reached, nothing, yardstick)
    if job.method == YARDSTICK and not math.isnan(share.mean):
        share = Estimate(1.0, math.nan)
    return Row(
        axis=job.axis,
        task=job.task,
        method=job.method,
        done=states.count("done"),
        diverged=states.count("diverged"),
        failed=states.count("failed"),
        counted=sum(math.isfinite(record.mean_return) for record in records),
        episodes_diverged=lost / episodes if episodes else math.nan,
        final_return=reached,
        final_loss=estimate(record.mean_loss for record in records),
        fraction=share,
        seconds=estimate(last.seconds for last in lasts).mean,
        particle_steps=estimate(last.particle_steps for last in lasts).mean,
    )


def text(table: Sequence[Row]) -> str:
    """Return rows as tables in Markdown, one for each axis and task.

    Args:
        table: The rows.
    """
    parts = []
    for axis in AXES:
        found = [row for row in table if row.axis == axis]
        if found:
            parts.append(f"## {HEADINGS[axis]}")
        for task in dict.fromkeys(row.task for row in found):
            some = [row for row in found if row.task == task]
            parts.append(f"### {task}\n\n{_table(some)}")
            methods = {row.method for row in some}
            missing = [f"`{name}`" for name in (NOTHING, YARDSTICK) if name not in methods]
            if missing:
                parts.append(f"Fractions need runs of {' and '.join(missing)}.")
    return "\n\n".join(parts) + "\n"


def _table(table: Sequence[Row]) -> str:
    heads = (
        "method", "runs", "return", "final loss", f"fraction of {YARDSTICK}", "seconds",
        "particle-steps",
    )  # fmt: skip
    lines: list[Sequence[str]] = [heads, ["---"] * len(heads)]
    for row in sorted(table, key=lambda row: -_rank(row.final_return.mean)):
        numbers = (row.final_return, row.final_loss, row.fraction)
        spent = (_short(row.seconds), _short(row.particle_steps))
        shown = (_marked(number, row) for number in numbers)
        lines.append((row.method, _told(row), *shown, *spent))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _marked(number: Estimate, row: Row) -> str:
    """Return a mean, and of how many runs it is where not of all."""
    partial = row.counted < row.runs and not math.isnan(number.mean)
    return f"{number} (of {row.counted} of {row.runs})" if partial else str(number)


def _rank(value: float) -> float:
    return -math.inf if math.isnan(value) else value


def _told(row: Row) -> str:
    """Return how many runs there are, and what went wrong."""
    parts = [f"{row.done}"]
    if row.diverged:
        parts.append(f"{row.diverged} diverged")
    if row.failed:
        parts.append(f"{row.failed} failed")
    if row.episodes_diverged > 0.0:
        parts.append(f"{row.episodes_diverged:.0%} of episodes diverged")
    return ", ".join(parts)


def _short(value: float) -> str:
    return NONE if math.isnan(value) else f"{value:.3g}"


def as_json(table: Sequence[Row], facts: Mapping[str, Any]) -> str:
    """Return rows and what they follow from as JSON; a number that is not finite becomes null.

    Args:
        table: The rows.
        facts: What they follow from, as JSON has it.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, Estimate):
            return {"mean": plain(value.mean), "standard_error": plain(value.error)}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    own = [{field.name: plain(getattr(row, field.name)) for field in fields(row)} for row in table]
    content = {"facts": dict(facts), "rows": own}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def curves(records: Iterable[RunRecord]) -> str:
    """Return all learning curves as comma-separated values, a line for each point.

    Args:
        records: Those of the runs; of those that failed, the curves up to there.
    """
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    runs = ("axis", "task", "method", "seed", "status")
    writer.writerow((*runs, *(field.name for field in fields(Point))))
    for record in records:
        job = record.job
        named = (job.axis, job.task, job.method, job.seed, record.status)
        for point in record.curve:
            numbers = (f"{value:.12g}" for value in astuple(point))
            writer.writerow((*named, *numbers))
    return written.getvalue()


# Learning curves with bands over the seeds: a picture for each task.


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


# The files that show a whole comparison, written anew whenever a run is over.


TABLE, FIGURES, CURVES = "comparison.md", "comparison.json", "comparison.csv"
"""Names of the files of the table, and of the curves."""


def write_table(plan: Plan, records: Sequence[RunRecord], folder: Path, command: str) -> str:
    """Write the table, in Markdown and as JSON, and all curves; return the table in Markdown.

    Args:
        plan: What was compared.
        records: Those of the runs that are over.
        folder: The comparison's folder.
        command: The command line.

    Raises:
        NPAError: A file cannot be written.
    """
    table = rows(records)
    told = text(table) + _sharing(plan)
    write_text(folder / TABLE, f"`{command}`\n\n{told}")
    write_text(folder / FIGURES, as_json(table, _facts(plan, command)))
    write_text(folder / CURVES, curves(records))
    return told


def _sharing(plan: Plan) -> str:
    """Return what is to be said where runs of equal wall time were not alone; else nothing."""
    at_once = plan.settings.get("runs_at_once", 1)
    if "seconds" not in plan.budgets or at_once == 1:
        return ""
    return (
        f"\nUp to {at_once} runs at once shared a device: what each had of it in its wall time is "
        "not controlled.\n"
    )


def _facts(plan: Plan, command: str) -> dict[str, Any]:
    """Return what a table follows from, as JSON has it."""
    fields = asdict(plan) | {"left_out": sorted(map(list, plan.left_out))}
    return {"command": command, **fields}


def write_pictures(records: Sequence[RunRecord], folder: Path) -> list[str]:
    """Write what was grown and, where matplotlib is installed, the curves; return what was done.

    Args:
        records: Those of the runs that are over.
        folder: The comparison's folder.

    Raises:
        NPAError: A file cannot be written.
    """
    strips = [f"wrote {path}" for path in write_strips(records, folder)]
    return [*strips, *write_plots(lambda: pictures(records), folder / "curves_*.png", "curves")]
