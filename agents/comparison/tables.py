"""Records as a table: what each method reached on each task, and the gradient beside it."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from typing import Any, NamedTuple

from npa_envs.agents.comparison.plan import AXES, Axis
from npa_envs.agents.comparison.record import Point, RunRecord

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
