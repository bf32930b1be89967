"""The report of a comparison: tables, learning curves and pictures, and their files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from npa_envs.agents.comparison.plan import AXES, NOTHING, YARDSTICK, Axis, ComparisonPlan
from npa_envs.agents.comparison.run import PICTURE, SIZE, RunRecord
from npa_envs.agents.learning import CurvePoint
from npa_envs.files import write_text
from npa_envs.measure.plots import draw_band, legend_of, new_figure, png, write_plots
from npa_envs.measure.record import NONE, Record, csv_text, markdown_table, mean_with_error, short
from npa_envs.render import write_filmstrip

LOST = ("diverged", "left the world")
"""Endings of diverged episodes: of worlds, and of species."""

HEADINGS: Mapping[Axis, str] = {
    "seconds": "Equal wall time",
    "particle-steps": "Equal particle-steps",
}

TABLE, FIGURES, CURVES = "comparison.md", "comparison.json", "comparison.csv"


def write_table(
    plan: ComparisonPlan, records: Sequence[RunRecord], folder: Path, command: str
) -> str:
    """Write the table, in Markdown and as JSON, and all curves; return the table in Markdown."""
    table = rows(records)
    shown = text(table)
    at_once = plan.settings.get("runs_at_once", 1)
    if "seconds" in plan.budgets and at_once > 1:
        shown += (
            f"\nUp to {at_once} runs at once shared a device: their fractions of its time are not "
            "controlled.\n"
        )
    facts = {"command": command, **asdict(plan), "left_out": sorted(map(list, plan.left_out))}
    write_text(folder / TABLE, f"`{command}`\n\n{shown}")
    Record(facts, folder / FIGURES, table).write()
    write_text(folder / CURVES, curves(records))
    return shown


def write_pictures(records: Sequence[RunRecord], folder: Path) -> list[str]:
    """Write filmstrips and, with matplotlib, curves; return a line of text for each file."""
    strips = [f"wrote {path}" for path in write_strips(records, folder)]
    return [*strips, *write_plots(lambda: pictures(records), folder / "curves_*.png", "curves")]


# Rows: the results of a method on a task


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds."""

    mean: float
    standard_error: float
    """NaN where there are fewer than two seeds."""

    def __str__(self) -> str:
        return mean_with_error(self.mean, self.standard_error)


UNKNOWN = Estimate(math.nan, math.nan)


def estimate(values: Iterable[float]) -> Estimate:
    """Return the mean of the finite values, one for each seed, with its standard error."""
    kept = [value for value in values if math.isfinite(value)]
    if not kept:
        return UNKNOWN
    mean = sum(kept) / len(kept)
    if len(kept) < 2:
        return Estimate(mean, math.nan)
    variance = sum((value - mean) ** 2 for value in kept) / (len(kept) - 1)
    return Estimate(mean, math.sqrt(variance / len(kept)))


@dataclass(frozen=True)
class ReportRow:
    """The results of a method on a task, over its seeds."""

    axis: Axis
    """Kind of the budget."""
    task: str
    method: str
    done: int
    diverged: int
    """Runs whose numbers became infinite or NaN."""
    failed: int
    counted: int
    """Runs with a finite return, over which means are taken."""
    episodes_diverged: float
    """Fraction of the held-out episodes that diverged; NaN without episodes."""
    final_return: Estimate
    final_loss: Estimate
    fraction: Estimate
    """Fraction of the gradient's improvement over doing nothing."""
    seconds: float
    particle_steps: float

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.done + self.diverged + self.failed


def rows(records: Iterable[RunRecord]) -> list[ReportRow]:
    """Return a row for each axis, task and method, in the order of the records."""
    groups: dict[tuple[Axis, str, str], list[RunRecord]] = {}
    for record in records:
        job = record.job
        groups.setdefault((job.axis, job.task, job.method), []).append(record)
    returns = {key: estimate(r.mean_return for r in some) for key, some in groups.items()}

    def fraction_of(key: tuple[Axis, str, str]) -> Estimate:
        nothing, yardstick = (
            returns.get((*key[:2], method), UNKNOWN) for method in (NOTHING, YARDSTICK)
        )
        found = fraction(returns[key], nothing, yardstick)
        known = key[2] == YARDSTICK and not math.isnan(found.mean)
        return Estimate(1.0, math.nan) if known else found

    return [_row(some, returns[key], fraction_of(key)) for key, some in groups.items()]


def _row(records: Sequence[RunRecord], final_return: Estimate, of_yardstick: Estimate) -> ReportRow:
    job = records[0].job
    states = [record.status for record in records]
    lasts = [record.curve[-1] for record in records if record.curve]
    endings = [record.endings for record in records if record.endings]
    episodes = sum(sum(ending.values()) for ending in endings)
    lost = sum(ending.get(word, 0) for ending in endings for word in LOST)
    return ReportRow(
        axis=job.axis,
        task=job.task,
        method=job.method,
        done=states.count("done"),
        diverged=states.count("diverged"),
        failed=states.count("failed"),
        counted=sum(math.isfinite(record.mean_return) for record in records),
        episodes_diverged=lost / episodes if episodes else math.nan,
        final_return=final_return,
        final_loss=estimate(record.mean_loss for record in records),
        fraction=of_yardstick,
        seconds=estimate(last.seconds for last in lasts).mean,
        particle_steps=estimate(last.particle_steps for last in lasts).mean,
    )


def fraction(result: Estimate, nothing: Estimate, yardstick: Estimate) -> Estimate:
    """Return (R - R_nothing) / (R_yardstick - R_nothing) of mean returns R, with its error.

    It is NaN if the yardstick is not better than nothing. The errors of R and R_yardstick are
    propagated to first order; that of R_nothing, which is in both differences, is ignored.
    """
    gain = yardstick.mean - nothing.mean
    if not gain > 0.0 or math.isnan(result.mean):
        return UNKNOWN
    share = (result.mean - nothing.mean) / gain
    spread = math.hypot(result.standard_error, share * yardstick.standard_error)
    return Estimate(share, spread / gain)


# Rows as text


def text(table: Sequence[ReportRow]) -> str:
    """Return a table in Markdown for each axis and task."""
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


def _table(table: Sequence[ReportRow]) -> str:
    heads = (
        "method", "runs", "return", "final loss", f"fraction of {YARDSTICK}", "seconds",
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


def curves(records: Iterable[RunRecord]) -> str:
    """Return all learning curves as comma-separated values, a line for each point."""
    names = [field.name for field in fields(CurvePoint)]
    lines = [
        [r.job.axis, r.job.task, r.job.method, r.job.seed, r.status, *astuple(point)]
        for r in records
        for point in r.curve
    ]
    return csv_text(["axis", "task", "method", "seed", "status", *names], lines)


ACROSS: dict[str, Callable[[CurvePoint], float]] = {
    "wall time [s]": lambda point: point.seconds,
    "particle-steps": lambda point: point.particle_steps,
}

CURVE_POINTS = 64
"""Points of a mean curve."""


class Curve(NamedTuple):
    """A mean over seeds at K points: abscissa, mean, and standard error, shape [K] each."""

    across: NDArray[np.float64]
    mean: NDArray[np.float64]
    error: NDArray[np.float64]
    """0 for a single seed."""


def curve(records: Sequence[RunRecord], across: Callable[[CurvePoint], float]) -> Curve | None:
    """Return the mean of learning curves, interpolated linearly, where they overlap, or None.

    A method that does not learn has a single point. Failed and diverged runs, whose curves are
    short, count only if there are no others.
    """
    lines = []
    for record in [record for record in records if record.status == "done"] or records:
        kept = [point for point in record.curve if np.isfinite(point.mean_return)]
        if kept:
            lines.append(([across(point) for point in kept], [point.mean_return for point in kept]))
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
    return Curve(grid, values.mean(axis=0), error)


def pictures(records: Sequence[RunRecord]) -> dict[str, bytes]:
    """Return PNG files of the curves by task. Needs matplotlib."""
    tasks = dict.fromkeys(record.job.task for record in records)
    return {task: _picture([r for r in records if r.job.task == task]) for task in tasks}


def _picture(records: Sequence[RunRecord]) -> bytes:
    axes = [axis for axis in AXES if any(record.job.axis == axis for record in records)]
    names = {}
    for method in dict.fromkeys(record.job.method for record in records):
        states = [record.status for record in records if record.job.method == method]
        done, count = states.count("done"), len(states)
        names[method] = method if done == count else f"{method} ({done} of {count})"
    figure, grid = new_figure(len(axes), len(ACROSS), (10.0, 3.4 * len(axes)))
    for axis, panels in zip(axes, grid, strict=True):
        for (label, across), panel in zip(ACROSS.items(), panels, strict=True):
            for number, (method, name) in enumerate(names.items()):
                some = [r for r in records if (r.job.axis, r.job.method) == (axis, method)]
                _draw(panel, curve(some, across), f"C{number}", name)
            panel.set(xlabel=label, ylabel="return of held-out episodes")
            panel.set_title(HEADINGS[axis], fontsize=9, loc="left")
            panel.grid(alpha=0.3)
    legend_of(figure, grid[0][0], "right center", fontsize=8)
    figure.suptitle(records[0].job.task)
    return png(figure)


def _draw(panel: Any, found: Curve | None, colour: str, name: str) -> None:
    if found is None:
        panel.plot([], [], color=colour, label=name)
    elif len(found.across) == 1:
        # The method does not learn.
        (mean,), (error,) = found.mean, found.error
        panel.axhline(mean, color=colour, lw=1.0, ls="--", label=name)
        panel.axhspan(mean - error, mean + error, color=colour, alpha=0.2, lw=0)
    else:
        lines = (found.mean - found.error, found.mean, found.mean + found.error)
        draw_band(panel, found.across, lines, colour, name, lw=1.5)


# Filmstrips: the last picture of a held-out episode of each run


def write_strips(records: Sequence[RunRecord], folder: Path) -> list[Path]:
    """Write a filmstrip for each task and axis: a column for each method, a row for each seed.

    The pictures of the runs are read from the comparison's folder.
    """
    written = []
    for axis in AXES:
        for task in dict.fromkeys(r.job.task for r in records if r.job.axis == axis):
            some = [r for r in records if (r.job.axis, r.job.task) == (axis, task)]
            found = {(record.job.method, record.job.seed): record for record in some}
            methods = list(dict.fromkeys(method for method, _ in found))
            seeds = sorted({seed for _, seed in found})
            cells = [(method, seed) for seed in seeds for method in methods]
            frames = [_frame(found.get(cell), folder) for cell in cells]
            captions = [
                f"{method}, seed {seed}: {_result(found.get((method, seed)))}"
                for method, seed in cells
            ]
            written.append(folder / f"grown_{task}_{axis}.png")
            write_filmstrip(written[-1], frames, captions, columns=len(methods))
    return written


def _result(record: RunRecord | None) -> str:
    if record is None or record.status != "done":
        return "not run" if record is None else record.status
    return f"loss {record.mean_loss:.3f}"


def _frame(record: RunRecord | None, folder: Path) -> NDArray[np.uint8]:
    path = None if record is None else folder / record.job.folder / PICTURE
    if path is None or not path.exists():
        return np.full((SIZE, SIZE, 3), 255, np.uint8)
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))
