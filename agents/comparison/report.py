"""The report of a comparison: tables, learning curves and pictures, and their files."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from npa_envs.agents.comparison.plan import (
    BUDGET_KINDS,
    NOTHING,
    REFERENCE,
    BudgetKind,
    ComparisonPlan,
)
from npa_envs.agents.comparison.single_run import PICTURE, PICTURE_SIDE, RunRecord, mean_of
from npa_envs.agents.learning import CurvePoint
from npa_envs.atomic_files import write_text
from npa_envs.measure.benchmark_records import (
    NONE,
    Record,
    csv_text,
    markdown_table,
    mean_with_error,
    short,
)
from npa_envs.measure.plots import draw_band, legend_of, new_figure, png, write_plots
from npa_envs.render import write_filmstrip

DIVERGED = ("diverged", "left the world")
"""Reasons for the end of episodes that diverged: of worlds, and of species."""

HEADINGS: Mapping[BudgetKind, str] = {
    "seconds": "Equal wall time",
    "particle-steps": "Equal particle-steps",
}

TABLE, RESULTS, CURVES = "comparison.md", "comparison.json", "comparison.csv"


def write_table(
    plan: ComparisonPlan, records: Sequence[RunRecord], folder: Path, command: str
) -> str:
    """Write comparison.md and .json (results by method) and .csv (curves); return the Markdown."""
    table = report_rows(records)
    shown = markdown(table)
    facts = {"command": command, **asdict(plan), "left_out": sorted(map(list, plan.left_out))}
    write_text(folder / TABLE, f"`{command}`\n\n{shown}")
    Record(facts, folder / RESULTS, table).write()
    write_text(folder / CURVES, curves_csv(records))
    return shown


def write_pictures(records: Sequence[RunRecord], folder: Path) -> list[str]:
    """Write filmstrips, and curves if matplotlib is installed; return "wrote PATH" for each."""
    strips = [f"wrote {path}" for path in write_strips(records, folder)]

    def curves() -> dict[str, bytes]:
        tasks = dict.fromkeys(record.job.task for record in records)
        return {task: _curve_plot([r for r in records if r.job.task == task]) for task in tasks}

    return [*strips, *write_plots(curves, folder / "curves_*.png", "curves")]


# Rows: the results of a method on a task


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds with its standard error."""

    mean: float
    standard_error: float
    """NaN where there are fewer than two seeds."""

    def __str__(self) -> str:
        return mean_with_error(self.mean, self.standard_error)


UNKNOWN = Estimate(math.nan, math.nan)


def estimate(values: Iterable[float]) -> Estimate:
    """Return the mean and standard error of values, one for each seed; only finite ones count."""
    finite = [value for value in values if math.isfinite(value)]
    mean = mean_of(finite)
    if len(finite) < 2:
        return Estimate(mean, math.nan)
    variance = sum((value - mean) ** 2 for value in finite) / (len(finite) - 1)
    return Estimate(mean, math.sqrt(variance / len(finite)))


@dataclass(frozen=True)
class ReportRow:
    """The results of a method on a task, over the runs from all seeds."""

    axis: BudgetKind
    task: str
    method: str
    done: int
    diverged: int
    """Number of runs in which numbers became infinite or NaN."""
    failed: int
    counted: int
    """Number of runs with a finite return, over which means are taken."""
    episodes_diverged: float
    """Fraction of the held-out episodes that diverged; NaN without episodes."""
    final_return: Estimate
    final_loss: Estimate
    fraction: Estimate
    """Improvement over doing nothing, as a fraction of the reference method's (`fraction`)."""
    seconds: float
    particle_steps: float

    @property
    def runs(self) -> int:
        """Number of all runs."""
        return self.done + self.diverged + self.failed


def report_rows(records: Iterable[RunRecord]) -> list[ReportRow]:
    """Return a row for each kind of budget, task and method, in the order of the records."""
    groups: dict[tuple[BudgetKind, str, str], list[RunRecord]] = {}
    for record in records:
        job = record.job
        groups.setdefault((job.axis, job.task, job.method), []).append(record)
    returns = {key: estimate(r.mean_return for r in group) for key, group in groups.items()}
    table = []
    for (axis, task, method), group in groups.items():
        result, nothing, reference = (
            returns.get((axis, task, name), UNKNOWN) for name in (method, NOTHING, REFERENCE)
        )
        of_reference = fraction(result, nothing, reference)
        if method == REFERENCE and not math.isnan(of_reference.mean):
            of_reference = Estimate(1.0, math.nan)
        statuses = Counter(record.status for record in group)
        endings = sum((Counter(record.endings or {}) for record in group), Counter())
        diverged = sum(endings[word] for word in DIVERGED)
        last_points = [record.curve[-1] for record in group if record.curve]
        table.append(
            ReportRow(
                axis=axis,
                task=task,
                method=method,
                done=statuses["done"],
                diverged=statuses["diverged"],
                failed=statuses["failed"],
                counted=sum(math.isfinite(record.mean_return) for record in group),
                episodes_diverged=diverged / endings.total() if endings else math.nan,
                final_return=result,
                final_loss=estimate(record.mean_loss for record in group),
                fraction=of_reference,
                seconds=estimate(point.seconds for point in last_points).mean,
                particle_steps=estimate(point.particle_steps for point in last_points).mean,
            )
        )
    return table


def fraction(result: Estimate, nothing: Estimate, reference: Estimate) -> Estimate:
    """Return (R - R_nothing) / (R_reference - R_nothing) of mean returns R, with its error.

    `nothing` is the mean return of the method "zero", `reference` that of "gradient". The fraction
    is NaN unless R_reference > R_nothing. The standard errors of R and R_reference are propagated
    to first order; that of R_nothing, which is in both differences, is ignored.
    """
    gain = reference.mean - nothing.mean
    if not gain > 0.0 or math.isnan(result.mean):
        return UNKNOWN
    mean = (result.mean - nothing.mean) / gain
    spread = math.hypot(result.standard_error, mean * reference.standard_error)
    return Estimate(mean, spread / gain)


# Rows as text


def markdown(table: Sequence[ReportRow]) -> str:
    """Return the rows in Markdown, one table for each kind of budget and task."""
    sections = []
    for axis in BUDGET_KINDS:
        axis_rows = [row for row in table if row.axis == axis]
        if axis_rows:
            sections.append(f"## {HEADINGS[axis]}")
        for task in dict.fromkeys(row.task for row in axis_rows):
            task_rows = [row for row in axis_rows if row.task == task]
            sections.append(f"### {task}\n\n{_table(task_rows)}")
            methods = {row.method for row in task_rows}
            missing = [f"`{name}`" for name in (NOTHING, REFERENCE) if name not in methods]
            if missing:
                sections.append(f"Fractions need runs of {' and '.join(missing)}.")
    return "\n\n".join(sections) + "\n"


def _table(table: Sequence[ReportRow]) -> str:
    heads = (
        "method", "runs", "return", "final loss", f"fraction of {REFERENCE}", "seconds",
        "particle-steps",
    )  # fmt: skip

    def rank(row: ReportRow) -> float:
        mean = row.final_return.mean
        return math.inf if math.isnan(mean) else -mean

    def cells(row: ReportRow) -> list[str]:
        runs = [f"{row.done}"]
        runs += [f"{row.diverged} diverged"] if row.diverged else []
        runs += [f"{row.failed} failed"] if row.failed else []
        if row.episodes_diverged > 0.0:
            runs.append(f"{row.episodes_diverged:.0%} of episodes diverged")
        partial = f" (of {row.counted} of {row.runs})" if row.counted < row.runs else ""
        numbers = (row.final_return, row.final_loss, row.fraction)
        shown = [str(n) if math.isnan(n.mean) else f"{n}{partial}" for n in numbers]
        spent = (row.seconds, row.particle_steps)
        amounts = [NONE if math.isnan(value) else short(value) for value in spent]
        return [row.method, ", ".join(runs), *shown, *amounts]

    return markdown_table(heads, map(cells, sorted(table, key=rank)))


# Learning curves


def curves_csv(records: Iterable[RunRecord]) -> str:
    """Return the points of all learning curves as comma-separated values, one per line."""
    names = [field.name for field in fields(CurvePoint)]
    lines = [
        [r.job.axis, r.job.task, r.job.method, r.job.seed, r.status, *astuple(point)]
        for r in records
        for point in r.curve
    ]
    return csv_text(["axis", "task", "method", "seed", "status", *names], lines)


ACROSS = {"wall time [s]": "seconds", "particle-steps": "particle_steps"}
"""Field of `CurvePoint` along a plot's horizontal axis, by the axis' label."""

CURVE_POINTS = 64
"""Number of points of a mean learning curve."""


Curve = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Points of a mean learning curve: times, mean returns, standard errors (0 for one seed)."""


def mean_curve(records: Sequence[RunRecord], across: str) -> Curve | None:
    """Return the mean over runs of a method's learning curves; None if they do not overlap.

    Curves are interpolated linearly along `across`, the field "seconds" or "particle_steps" of
    `CurvePoint`, where all of them overlap. A method that does not learn has a single point. Failed
    and diverged runs, whose curves are short, count only if there are no others.
    """
    lines = []
    for record in [record for record in records if record.status == "done"] or records:
        points = [(getattr(point, across), point.mean_return) for point in record.curve]
        points = [point for point in points if np.isfinite(point[1])]
        if points:
            lines.append(np.array(points).T)
    if not lines:
        return None
    first, last = max(line[0][0] for line in lines), min(line[0][-1] for line in lines)
    if first > last:
        return None
    grid = np.linspace(first, last, CURVE_POINTS if last > first else 1)
    values = np.stack([np.interp(grid, *line) for line in lines])
    error = np.zeros(len(grid))
    if len(lines) > 1:
        error = values.std(axis=0, ddof=1) / np.sqrt(len(lines))
    return grid, values.mean(axis=0), error


def _curve_plot(records: Sequence[RunRecord]) -> bytes:
    axes = [axis for axis in BUDGET_KINDS if any(record.job.axis == axis for record in records)]
    names = {}
    for method in dict.fromkeys(record.job.method for record in records):
        states = [record.status for record in records if record.job.method == method]
        done, count = states.count("done"), len(states)
        names[method] = method if done == count else f"{method} ({done} of {count})"
    figure, grid = new_figure(len(axes), len(ACROSS), (10.0, 3.4 * len(axes)))
    for axis, panels in zip(axes, grid, strict=True):
        for (label, across), panel in zip(ACROSS.items(), panels, strict=True):
            for number, (method, name) in enumerate(names.items()):
                method_records = [
                    r for r in records if (r.job.axis, r.job.method) == (axis, method)
                ]
                _draw_curve(panel, mean_curve(method_records, across), f"C{number}", name)
            panel.set(xlabel=label, ylabel="return of held-out episodes")
            panel.set_title(HEADINGS[axis], fontsize=9, loc="left")
            panel.grid(alpha=0.3)
    legend_of(figure, grid[0][0], "right center", fontsize=8)
    figure.suptitle(records[0].job.task)
    return png(figure)


def _draw_curve(panel: Any, drawn: Curve | None, colour: str, name: str) -> None:
    if drawn is None:
        panel.plot([], [], color=colour, label=name)
        return
    across, mean, error = drawn
    lines = (mean - error, mean, mean + error)
    if len(across) == 1:
        # The method does not learn.
        (low,), (middle,), (high,) = lines
        panel.axhline(middle, color=colour, lw=1.0, ls="--", label=name)
        panel.axhspan(low, high, color=colour, alpha=0.2, lw=0)
    else:
        draw_band(panel, across, lines, colour, name, lw=1.5)


# Filmstrips


def write_strips(records: Sequence[RunRecord], folder: Path) -> list[Path]:
    """Write a filmstrip for each kind of budget and task; return the paths.

    It has a column for each method and a row for each seed, with the runs' pictures in the
    comparison's `folder`, each of the end of a held-out episode.
    """
    groups: dict[tuple[BudgetKind, str], dict[tuple[int, str], RunRecord]] = {}
    for record in records:
        job = record.job
        groups.setdefault((job.axis, job.task), {})[job.seed, job.method] = record
    written = []
    kinds = sorted(groups.items(), key=lambda item: BUDGET_KINDS.index(item[0][0]))
    for (axis, task), runs in kinds:
        methods = list(dict.fromkeys(method for _, method in runs))
        frames, captions = [], []
        for seed, method in itertools.product(sorted({seed for seed, _ in runs}), methods):
            run = runs.get((seed, method))
            frames.append(np.full((PICTURE_SIDE, PICTURE_SIDE, 3), 255, np.uint8))
            result: str = "not run" if run is None else run.status
            if run is not None and run.status == "done":
                result = f"loss {run.mean_loss:.3f}"
            if run is not None and (path := folder / run.job.folder / PICTURE).exists():
                with Image.open(path) as picture:
                    frames[-1] = np.asarray(picture.convert("RGB"))
            captions.append(f"{method}, seed {seed}: {result}")
        written.append(folder / f"grown_{task}_{axis}.png")
        write_filmstrip(written[-1], frames, captions, columns=len(methods))
    return written
