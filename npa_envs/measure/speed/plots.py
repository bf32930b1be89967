"""Plots of `npa-envs bench`: fronts of run time against error, and how times grow."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from npa_envs.measure.plots import new_figure, number_plainly, png
from npa_envs.measure.speed.strategies import PRECISIONS, STRATEGIES
from npa_envs.measure.speed.suites import Report
from npa_envs.measure.speed.throughput import AXES, ScalingRow

FLOOR = 1e-16
"""Errors below this, as that of the float64 reference itself, are drawn here."""

COLOURS = dict(zip(STRATEGIES, ("C0", "C4", "C1", "C2", "C3"), strict=True))
"""Colour of each strategy."""

MARKERS = dict(zip(PRECISIONS, ("s", "o", "^", "D", "v"), strict=True))
"""Shape of each precision."""

AXIS_LABELS = {
    "particles": "particles N, same density",
    "neighbours": "neighbours of a particle",
    "worlds": "worlds B",
    "channels": "state channels C",
}
"""What the axes of the suite `scaling` are called."""


class Point(NamedTuple):
    """One way to compute something: its error (dimensionless) and its time [µs]."""

    error: float
    time: float
    strategy: str
    precision: str


def pictures(report: Report) -> dict[str, bytes]:
    """Return PNG files by their names, as many as the report has tables for. Needs matplotlib."""
    drawn = {}
    if "perception" in report.tables:
        drawn["pareto"] = png(_draw_fronts(report))
    if "scaling" in report.tables:
        drawn["scaling"] = png(_draw_scaling(report, "time"))
        if any(row.infer_mib is not None for row in report.tables["scaling"]):
            drawn["memory"] = png(_draw_scaling(report, "memory"))
    return drawn


def front(points: Iterable[Point]) -> list[Point]:
    """Return the points that no other one beats in both time and error, by increasing error."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.error, point.time)):
        if not best or point.time < best[-1].time:
            best.append(point)
    return best


def _draw_fronts(report: Report) -> Any:
    largest = _largest_common(report.tables["perception"])
    perception = [
        Point(row.perception, row.forward_us.median, row.strategy, row.precision)
        for row in report.tables["perception"]
        if (row.space_dim, row.worlds, row.particles) == (2, 1, largest)
    ]
    rollouts = report.tables["rollouts"]
    most = max(row.particles for row in rollouts)
    steps = [
        Point(row.s_8, row.step_us.median, row.strategy, row.precision)
        for row in rollouts
        if row.particles == most
    ]
    figure, (axes,) = new_figure(1, 2, (9.2, 3.8))
    _draw_front(axes[0], perception, "relative error of perception z", "time [µs]")
    axes[0].set_title(f"one perception, N {largest}")
    _draw_front(axes[1], steps, "relative error of states after 8 steps", "time of a step [µs]")
    axes[1].set_title(f"gecko, p 0.5, N {most}")
    _add_legend(figure, [*perception, *steps])
    return figure


def _largest_common(rows: Sequence[Any]) -> int:
    """Return the most particles of a 2D world that every strategy was measured on."""
    counts: set[int] = {row.particles for row in rows if (row.space_dim, row.worlds) == (2, 1)}
    names: dict[int, set[str]] = {count: set() for count in counts}
    for row in rows:
        if row.particles in counts:
            names[row.particles].add(row.strategy)
    return max(counts, key=lambda count: (len(names[count]), count))


def _draw_front(axis: Any, points: Sequence[Point], across: str, up: str) -> None:
    """Draw points, coloured by strategy and shaped by precision, over the front of the best."""
    drawn = [point._replace(error=max(point.error, FLOOR)) for point in points]
    best = front(drawn)
    line = [point.error for point in best], [point.time for point in best]
    axis.step(*line, where="post", color="0.8", zorder=1)
    for point in drawn:
        axis.scatter(
            point.error,
            point.time,
            color=COLOURS[point.strategy],
            marker=MARKERS[point.precision],
            s=36,
            zorder=2,
        )
    axis.set(xscale="log", yscale="log", xlabel=across, ylabel=up)
    axis.margins(0.08)
    number_plainly(axis.yaxis)
    axis.grid(alpha=0.3)


def _add_legend(figure: Any, points: Sequence[Point]) -> None:
    """Say which colours and shapes stand for what."""
    from matplotlib.lines import Line2D

    strategies = dict.fromkeys(point.strategy for point in points)
    precisions = dict.fromkeys(point.precision for point in points)
    marks = [
        *(
            Line2D([], [], ls="", marker="o", color=COLOURS[name], label=name)
            for name in strategies
        ),
        *(
            Line2D([], [], ls="", marker=MARKERS[name], color="0.4", label=name)
            for name in precisions
        ),
        Line2D([], [], color="0.8", label="front"),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=5, fontsize=8)


def _draw_scaling(report: Report, what: str) -> Any:
    figure, grid = new_figure(2, 2, (9.2, 7.6))
    panels = grid.ravel()
    for name, panel in zip(AXES, panels, strict=True):
        rows: list[ScalingRow] = [row for row in report.tables["scaling"] if row.axis == name]
        for label, values in _curves(rows, what).items():
            panel.plot([row.value for row in rows], values, marker="o", ms=4, label=label)
        panel.set(xscale="log", yscale="log", xlabel=AXIS_LABELS[name])
        panel.set_ylabel("time of a step [µs]" if what == "time" else "peak memory [MiB]")
        number_plainly(panel.xaxis, [row.value for row in rows])
        number_plainly(panel.yaxis)
        panel.tick_params(axis="x", labelsize=8)
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    return figure


def _curves(rows: Sequence[ScalingRow], what: str) -> dict[str, list[float | None]]:
    """Return the values of each curve; what was not measured is a gap."""
    if what == "memory":
        return {
            "inference": [row.infer_mib for row in rows],
            "training": [row.train_mib for row in rows],
        }
    return {
        "inference": [row.infer_us.median for row in rows],
        "training": [row.train_us.median if row.train_us else None for row in rows],
    }
