"""Curves with bands over the seeds: a picture for each task, a row for each of its rules."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

from npa_envs.measure.robustness.plans import CONDITIONS
from npa_envs.measure.robustness.record import RuleRecord
from npa_envs.measure.robustness.recovery import CONTROL, RECOVERED
from npa_envs.measure.speed.plots import number_plainly

DRAWN = {
    "eps": "ε over the trained one",
    "particles": "N over the trained one",
    "update_prob": "p",
}
"""Conditions that are drawn, and what their axes are called."""

BAND = 0.15
"""Opacity of the band from the best seed to the worst."""

FEW_DECADES = 100.0
"""Axes whose ends are fewer times apart have marks within decades."""


def pictures(records: Sequence[RuleRecord]) -> dict[str, bytes]:
    """Return PNG files by their tasks' names. Needs matplotlib.

    Args:
        records: Those of the rules.
    """
    by_task: dict[str, list[RuleRecord]] = {}
    for record in records:
        by_task.setdefault(record.task, []).append(record)
    return {task: _draw(some) for task, some in by_task.items()}


def _draw(records: Sequence[RuleRecord]) -> bytes:
    from matplotlib.figure import Figure

    columns = 1 + len(DRAWN)
    figure = Figure(figsize=(3.1 * columns, 2.3 * len(records)), layout="constrained")
    grid = figure.subplots(len(records), columns, squeeze=False)
    for record, panels in zip(records, grid, strict=True):
        _draw_courses(panels[0], record)
        for condition, panel in zip(DRAWN, panels[1:], strict=True):
            _draw_responses(panel, record, condition)
    for panel, condition in zip(grid[-1], ("", *DRAWN), strict=True):
        panel.set_xlabel(DRAWN.get(condition, "steps after the damage"), fontsize=8)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=7)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=75)
    return buffer.getvalue()


def _draw_courses(panel: Any, record: RuleRecord) -> None:
    """Draw losses over the twins' after each damage."""
    for number, course in enumerate(record.courses):
        colour = "0.5" if course.damage == CONTROL else f"C{number}"
        columns = [course.ratios(place) for place in range(len(course.steps))]
        _draw_band(panel, course.steps, columns, colour, course.damage)
    panel.axhline(RECOVERED, color="black", lw=0.7, ls=":")
    steps = record.courses[0].steps
    panel.set_xscale("symlog", linthresh=max(1, steps[1]))
    panel.set_xlim(0, steps[-1])
    ticks = [step for step in steps if step & (step - 1) == 0]
    panel.set_xticks(ticks, [str(step) for step in ticks], rotation=45)
    panel.set_yscale("log")
    panel.set_ylabel("loss over the twin's", fontsize=8)
    panel.set_title(record.rule, fontsize=9, loc="left")
    mark_decades(panel)


def _draw_responses(panel: Any, record: RuleRecord, condition: str) -> None:
    """Draw losses by the values of a condition."""
    found = [r for r in record.responses if r.condition == condition and r.losses]
    values = [float(response.value) for response in found]
    _draw_band(panel, values, [response.losses for response in found], "C0", CONDITIONS[condition])
    trained = sorted(record.trained().losses)
    panel.axhline(trained[len(trained) // 2], color="black", lw=0.7, ls=":")
    panel.set(xscale="log", yscale="log")
    panel.set_ylabel("loss", fontsize=8)
    panel.set_xticks(values, [f"{value:.2g}" for value in values], rotation=45)
    mark_decades(panel)


def mark_decades(panel: Any) -> None:
    """Mark 1, 2 and 5 of each decade of a logarithmic axis y, or the decades where they are many.

    Args:
        panel: Matplotlib's axes.
    """
    low, high = panel.get_ylim()
    fine = high < FEW_DECADES * low
    panel.minorticks_off()
    number_plainly(panel.yaxis, within=(1, 2, 5) if fine else (1,), text="{:g}".format)
    panel.tick_params(labelsize=7)


def _draw_band(
    panel: Any, across: Sequence[float], columns: Sequence[Sequence[float]], colour: str, name: str
) -> None:
    """Draw the median of the seeds, and a band from the least to the most; gaps at NaN."""
    ordered = [sorted(column) for column in columns]
    whole = [not any(math.isnan(value) for value in column) for column in columns]

    def line(place: int) -> list[float]:
        pairs = zip(ordered, whole, strict=True)
        # Of an even number the upper one in the middle.
        return [column[place] if ok else math.nan for column, ok in pairs]

    middle = len(ordered[0]) // 2
    panel.plot(across, line(middle), marker=".", ms=3, lw=1, color=colour, label=name)
    panel.fill_between(across, line(0), line(-1), color=colour, alpha=BAND, lw=0)
