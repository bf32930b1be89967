"""Tables and curves of robustness: where rules work, how they recover, losses by condition."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

from npa_envs.measure.accuracy.habitats import WORKS
from npa_envs.measure.plots import draw_band, legend_of, mark_decades, new_figure, png
from npa_envs.measure.robustness.plans import CONDITIONS, trained_value
from npa_envs.measure.robustness.recovery import CONTROL, DAMAGES, RECOVERED, Course, ratio
from npa_envs.measure.robustness.study import Response, RuleRecord
from npa_envs.measure.tables import NONE, markdown_table, short


def where_it_works(record: RuleRecord, condition: str) -> str:
    """Return the values of a condition at which a rule works, in words; "" where there are none.

    It works where all seeds are finite and the mean loss is at most `WORKS` times that as trained.
    """
    found = [response for response in record.responses if response.condition == condition]
    if not found:
        return ""
    # What was left out has no mean, so a range ends before it.
    ratios = [ratio(response.mean(), record.trained().mean()) for response in found]
    trained = trained_value(condition, record.update_prob)
    if isinstance(trained, str):
        text = _working_shapes([str(r.value) for r in found], ratios, trained)
    else:
        text = working_range([float(r.value) for r in found], ratios, trained)
    return text + _left_out(found)


def working_range(values: Sequence[float], ratios: Sequence[float], trained: float) -> str:
    """Return the values around the trained one at which a rule works, in words.

    Values increase; ratios are the loss at each over that as trained, NaN where a seed is lost.
    """
    works = [value <= WORKS for value in ratios]
    low = high = min(range(len(values)), key=lambda k: abs(values[k] - trained))
    if not works[low]:
        return f"not at {short(values[low])}"
    while low > 0 and works[low - 1]:
        low -= 1
    while high + 1 < len(values) and works[high + 1]:
        high += 1
    first, last = short(values[low]), short(values[high])
    text = f"{first} alone" if low == high else f"{first} … {last}"
    apart = [short(v) for k, v in enumerate(values) if works[k] and not low <= k <= high]
    return f"{text}, and {', '.join(apart)}" if apart else text


def _working_shapes(shapes: Sequence[str], ratios: Sequence[float], trained: str) -> str:
    """Return the shapes of seeds from which a rule works, as they come; they have no order."""
    pairs = zip(shapes, ratios, strict=True)
    return ", ".join(shape for shape, value in pairs if value <= WORKS) or f"not from {trained}"


def _left_out(found: Sequence[Response]) -> str:
    """Return which values were not measured; nobody knows whether a rule works there."""
    values = [short(response.value) for response in found if not response.losses]
    return f" (not measured: {', '.join(values)})" if values else ""


# Tables in Markdown


SHARES = {
    "what rules are asked to heal": [d.name for d in DAMAGES.values() if not d.beyond],
    "what is beyond that": [d.name for d in DAMAGES.values() if d.beyond],
}
"""Damages whose share that recovered is told together; the control does not count."""


def recovered_share(
    records: Iterable[RuleRecord], damages: Collection[str]
) -> tuple[int, int, int]:
    """Return how many seeds of all rules recovered of damages, are so at the end, and there are."""
    courses = [c for record in records for c in record.courses if c.damage in damages]
    recovered = sum(course.recovered() for course in courses)
    at_end = sum(course.within_at_end() for course in courses)
    return recovered, at_end, sum(len(course.losses) for course in courses)


def tables(records: Sequence[RuleRecord]) -> str:
    """Return all tables in Markdown and, last, the shares that recovered."""
    parts = [
        "Where rules work: values around the trained one, without a gap, at which the mean loss is "
        f"at most {WORKS:g} times that as trained and all seeds are finite; others that work stand "
        f"behind them:\n\n{_by_condition(records)}",
        f"Recovered seeds, and their median recovery time [steps]:\n\n{_by_damage(records, _time)}",
        "Loss over the twin's right after the damage → at the end (medians of the seeds; seeds "
        f"within {RECOVERED:g} at the end):\n\n{_by_damage(records, _size)}",
    ]
    for condition, summary in CONDITIONS.items():
        table = _by_value(records, condition)
        if table:
            parts.append(f"Loss over that as trained, by {summary}:\n\n{table}")
    for summary, damages in SHARES.items():
        recovered, at_end, total = recovered_share(records, damages)
        if total:
            parts.append(
                f"Recovered of {summary} ({', '.join(damages)}): {recovered} of {total} "
                f"rule × damage × seed, {recovered / total:.1%}; within {RECOVERED:g} at the end: "
                f"{at_end}, {at_end / total:.1%}."
            )
    return "\n\n".join(parts) + "\n"


def _time(course: Course) -> str:
    step = course.median_step()
    told = f"{course.recovered()}/{len(course.losses)}"
    return told if step is None else f"{told}, {step:g}"


def _size(course: Course) -> str:
    first, last = _median(course.ratios(0)), _median(course.ratios(-1))
    return f"{short(first)} → {short(last)} ({course.within_at_end()}/{len(course.losses)})"


def _median(values: Sequence[float]) -> float:
    """Return the median; what is not a number counts as worst."""
    ordered = sorted(math.inf if math.isnan(value) else value for value in values)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return low if low == high else 0.5 * (low + high)


def _by_condition(records: Sequence[RuleRecord]) -> str:
    """Return a table of where each rule works."""
    rows = [[r.rule, *(where_it_works(r, name) or NONE for name in CONDITIONS)] for r in records]
    return markdown_table(["rule", *CONDITIONS], rows)


def _by_damage(records: Sequence[RuleRecord], cell: Callable[[Course], str]) -> str:
    done = {course.damage for record in records for course in record.courses}
    names = [name for name in (CONTROL, *DAMAGES) if name in done]
    rows = []
    for record in records:
        found = {course.damage: course for course in record.courses}
        rows.append([record.rule, *(cell(found[n]) if n in found else NONE for n in names)])
    return markdown_table(["rule", *names], rows)


def _by_value(records: Sequence[RuleRecord], condition: str) -> str:
    """Return a table of mean losses over those as trained, which the second column tells."""
    found = {
        (record.rule, response.value): response
        for record in records
        for response in record.responses
        if response.condition == condition
    }
    values = list(dict.fromkeys(value for _, value in found))
    rows = [
        [
            record.rule,
            short(record.trained().mean()),
            *(_change(record, found.get((record.rule, value))) for value in values),
        ]
        for record in records
        if any((record.rule, value) in found for value in values)
    ]
    return markdown_table(["rule", "loss as trained", *map(short, values)], rows) if rows else ""


def _change(record: RuleRecord, response: Response | None) -> str:
    if response is None or not response.losses:
        return NONE
    mean, trained = response.mean(), record.trained().mean()
    return short(mean / trained) if trained else short(mean)


# Curves with bands over the seeds: a picture for each task, a row for each of its rules.


DRAWN = {
    "eps": "ε over the trained one",
    "particles": "N over the trained one",
    "update_prob": "p",
}
"""Conditions that are drawn, and what their axes are called."""


def pictures(records: Sequence[RuleRecord]) -> dict[str, bytes]:
    """Return PNG files by their tasks' names. Needs matplotlib."""
    tasks = dict.fromkeys(record.task for record in records)
    return {task: _draw([r for r in records if r.task == task]) for task in tasks}


def _draw(records: Sequence[RuleRecord]) -> bytes:
    columns = 1 + len(DRAWN)
    figure, grid = new_figure(len(records), columns, (3.1 * columns, 2.3 * len(records)))
    for record, panels in zip(records, grid, strict=True):
        _draw_courses(panels[0], record)
        for condition, panel in zip(DRAWN, panels[1:], strict=True):
            _draw_responses(panel, record, condition)
    for panel, condition in zip(grid[-1], ("", *DRAWN), strict=True):
        panel.set_xlabel(DRAWN.get(condition, "steps after the damage"), fontsize=8)
    legend_of(figure, grid[0][0], ncols=1 + len(DAMAGES), fontsize=7)
    return png(figure, 75)


def _draw_courses(panel: Any, record: RuleRecord) -> None:
    """Draw losses over the twins' after each damage."""
    for place, course in enumerate(record.courses):
        colour = "0.5" if course.damage == CONTROL else f"C{place}"
        columns = [course.ratios(k) for k in range(len(course.steps))]
        _draw_seeds(panel, course.steps, columns, colour, course.damage)
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
    _draw_seeds(panel, values, [response.losses for response in found], "C0", CONDITIONS[condition])
    trained = sorted(record.trained().losses)
    panel.axhline(trained[len(trained) // 2], color="black", lw=0.7, ls=":")
    panel.set(xscale="log", yscale="log")
    panel.set_ylabel("loss", fontsize=8)
    panel.set_xticks(values, [f"{value:.2g}" for value in values], rotation=45)
    mark_decades(panel)


def _draw_seeds(
    panel: Any, across: Sequence[float], columns: Sequence[Sequence[float]], colour: str, name: str
) -> None:
    """Draw the median of the seeds, and a band from the least to the most; gaps at NaN."""
    lost = [any(map(math.isnan, column)) for column in columns]
    # Of an even number the upper one in the middle.
    low, middle, high = (
        [math.nan if gone else sorted(c)[place] for c, gone in zip(columns, lost, strict=True)]
        for place in (0, len(columns[0]) // 2, -1)
    )
    draw_band(panel, across, (low, middle, high), colour, name, marker=".", ms=3, lw=1)
