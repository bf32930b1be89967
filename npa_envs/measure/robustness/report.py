"""Losses of rules under other conditions and after damage: records, tables and pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from statistics import median
from typing import Any

import torch

from npa_envs.measure.benchmark_records import (
    NONE,
    Record,
    as_objects,
    markdown_table,
    number,
    short,
)
from npa_envs.measure.plots import draw_band, legend_of, new_figure, number_plainly, png
from npa_envs.measure.robustness.trials import (
    CONDITIONS,
    CONTROL,
    DAMAGES,
    RECOVERED,
    LossCurve,
    RuleTrial,
    healing,
    ratio,
    trained_value,
)
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import StreamId

WORKS = 2.0
"""A rule works under a condition if its loss is at most this many times the trained one."""

MAX_PARTICLES = {"cpu": 1 << 17, "cuda": 1 << 21}
"""Most particles of all worlds together; values that need more are left out."""


@dataclass(frozen=True)
class Response:
    """The losses of all seeds at one value of a condition."""

    condition: str
    value: float | str
    steps: int
    """Steps from the seed."""
    losses: tuple[float, ...]
    """Loss of each seed, NaN if a world is not finite; empty if the value was left out."""
    note: str = ""
    """Why the value was left out."""

    def mean(self) -> float:
        """Return the mean loss of the seeds; NaN if one is not finite, or there are none."""
        return math.fsum(self.losses) / len(self.losses) if self.losses else math.nan


class RuleRecord(Record[Response]):
    """Measurements of one rule: loss curves after damage, and losses under other conditions."""

    command = "robustness"

    def __init__(
        self,
        facts: Mapping[str, Any],
        path: Path | None = None,
        *,
        curves: Sequence[LossCurve] = (),
        responses: Sequence[Response] = (),
        **about: Any,
    ) -> None:
        super().__init__(facts, path, responses)
        self.curves = list(curves)
        """Loss curve after each damage, the control first."""
        self.about: dict[str, Any] = {"done": True, "seconds": 0.0, "command": "", "date": ""}
        """Other fields of the file: `rule`, `task`, `metric`, trained `update_prob`, `done`, ..."""
        self.about |= about

    @property
    def rule(self) -> str:
        """The rule's name."""
        return str(self.about["rule"])

    @property
    def done(self) -> bool:
        """Whether everything is measured."""
        return bool(self.about["done"])

    def content(self) -> dict[str, Any]:
        """Return the fields of the file, except the facts."""
        curves = [asdict(curve) for curve in self.curves]
        for fields, curve in zip(curves, self.curves, strict=True):
            fields["twins"] = fields.pop("undamaged")
            fields["recovery_steps"] = curve.recovery_steps()
        return {**self.about, "courses": curves, "responses": as_objects(self.rows)}

    def parse(self, content: dict[str, Any]) -> list[Response]:
        """Set curves and other fields from a file's JSON object; return its responses."""

        def numbers(values: list[float | None]) -> tuple[float, ...]:
            return tuple(map(number, values))

        self.curves = []
        for row in content.pop("courses"):
            losses, undamaged = (tuple(map(numbers, row[name])) for name in ("losses", "twins"))
            self.curves.append(LossCurve(row["damage"], tuple(row["steps"]), losses, undamaged))
        rows = content.pop("responses")
        del content["facts"]
        self.about = content
        return [Response(**row | {"losses": numbers(row["losses"])}) for row in rows]

    def responses_to(self, condition: str) -> list[Response]:
        """Return the responses to a condition."""
        return [response for response in self.rows if response.condition == condition]

    def trained(self) -> Response:
        """Return the response under the conditions of training."""
        return next(response for response in self.responses_to("eps") if response.value == 1.0)


def measure_rule(
    record: RuleRecord,
    trial: RuleTrial,
    most_particles: int,
    *,
    enough: Callable[[], bool] = lambda: False,
) -> None:
    """Measure what is missing in a rule's record; save it after each value of a condition.

    Values of conditions that need more than `most_particles` particles are left out. Once `enough`
    returns True, no further value is measured, and the record stays unfinished.
    """
    begin = time.perf_counter() - record.about["seconds"]
    grown, trained = grow(trial)
    if not record.curves:
        record.curves = healing(trial, grown)
        record.about |= {
            "task": trial.task_name,
            "metric": trial.metric_name,
            "update_prob": float(trial.task.update_prob),
            "date": date.today().isoformat(),
            "done": False,
        }
    record.write()
    rest = responses(trial, trained, most_particles, done=len(record.rows))
    while not enough():
        response = next(rest, None)
        record.about["seconds"] = round(time.perf_counter() - begin, 2)
        if response is None:
            record.about["done"] = True
            record.write()
            break
        record.add(response)


def grow(
    trial: RuleTrial, condition: str = "", value: float | str = 1.0
) -> tuple[Particles, Response]:
    """Grow worlds as in training, or with `condition` at `value`; return them and their losses."""
    initial = trial.initial_worlds(
        fraction=float(value) if condition == "particles" else 1.0,
        shape=str(value) if condition == "shape" else "trained",
    )
    changed: dict[str, Any] = {}
    time_scale = 1.0
    if condition in ("update_prob", "dt"):
        changed[condition] = value
        # The same number of updates, or total time, as in training.
        time_scale = float(value) / (trial.task.update_prob if condition == "update_prob" else 1.0)
    elif condition in ("eps", "noise"):
        name = "eps" if condition == "eps" else "position_noise"
        changed[name] = float(value) * trial.task.eps
    chunk = trial.plan.chunk
    steps = chunk * max(1, round(trial.plan.grow_steps / time_scale / chunk))
    worlds, losses = trial.run(initial, trial.random(StreamId.GROWTH), [steps], **changed)
    by_seed = tuple(trial.by_seed(losses[0]).tolist())
    return worlds, Response(condition, value, steps, by_seed)


@torch.no_grad()
def responses(
    trial: RuleTrial, trained: Response, most_particles: int, *, done: int = 0
) -> Iterator[Response]:
    """Yield the response to each value of each condition, without the first `done`."""
    every = [(name, value) for name, values in trial.plan.values.items() for value in values]
    for condition, value in every[done:]:
        if value == trained_value(condition, trial.task.update_prob):
            yield Response(condition, value, trained.steps, trained.losses)
            continue
        fraction = float(value) if condition == "particles" else 1.0
        total = trial.world_count * trial.particles(fraction)
        if total > max(most_particles, trial.world_count * trial.particle_count):
            yield Response(condition, value, 0, (), note=f"{total} particles in all")
            continue
        try:
            yield grow(trial, condition, value)[1]
        except torch.OutOfMemoryError:
            yield Response(condition, value, 0, (), note=f"no memory for {total} particles")


# The values at which rules work, as text


def where_it_works(record: RuleRecord, condition: str) -> str:
    """Return the values of a condition at which a rule works, as text; "" if none was measured.

    It works if all seeds are finite and the mean loss is at most `WORKS` times the trained one.
    """
    measured = record.responses_to(condition)
    if not measured:
        return ""
    # The ratio of a value that was left out is NaN, so a range ends before it.
    ratios = [ratio(response.mean(), record.trained().mean()) for response in measured]
    trained = trained_value(condition, record.about["update_prob"])
    if isinstance(trained, str):
        pairs = zip(measured, ratios, strict=True)
        works = [str(response.value) for response, value in pairs if value <= WORKS]
        text = ", ".join(works) or f"not from {trained}"
    else:
        text = working_range([float(r.value) for r in measured], ratios, trained)
    left_out = [short(response.value) for response in measured if not response.losses]
    return text + (f" (not measured: {', '.join(left_out)})" if left_out else "")


def working_range(values: Sequence[float], ratios: Sequence[float], trained: float) -> str:
    """Return, as text, the values around the trained one with a ratio of at most `WORKS`.

    Values increase. A ratio is a value's loss over the trained loss, NaN if a seed has diverged.
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


# Tables in Markdown


DAMAGE_GROUPS = {
    "what rules are asked to heal": [name for name, d in DAMAGES.items() if not d.beyond],
    "what is beyond that": [name for name, d in DAMAGES.items() if d.beyond],
}
"""Damages whose recovered seeds are counted together, without the control."""


def recovered_counts(
    records: Iterable[RuleRecord], damages: Collection[str]
) -> tuple[int, int, int]:
    """Return how many seeds recovered at any step, how many at the last one, and their number."""
    curves = [c for record in records for c in record.curves if c.damage in damages]
    recovered = sum(curve.recovered() for curve in curves)
    at_end = sum(curve.recovered_at_end() for curve in curves)
    return recovered, at_end, sum(len(curve.losses) for curve in curves)


def tables(records: Sequence[RuleRecord]) -> str:
    """Return all tables in Markdown and, last, the fractions of recovered seeds."""
    ranges = [[r.rule, *(where_it_works(r, name) or NONE for name in CONDITIONS)] for r in records]
    works = markdown_table(["rule", *CONDITIONS], ranges)
    parts = [
        "Where rules work: values around the trained one, without a gap, at which the mean loss is "
        f"at most {WORKS:g} times that as trained and all seeds are finite; others that work stand "
        f"behind them:\n\n{works}",
        f"Recovered seeds, and their median recovery time [steps]:\n\n{_by_damage(records, _time)}",
        "Loss over the twin's right after the damage → at the end (medians of the seeds; seeds "
        f"within {RECOVERED:g} at the end):\n\n{_by_damage(records, _size)}",
    ]
    for condition, summary in CONDITIONS.items():
        if table := _by_value(records, condition):
            parts.append(f"Loss over that as trained, by {summary}:\n\n{table}")
    for summary, damages in DAMAGE_GROUPS.items():
        recovered, at_end, total = recovered_counts(records, damages)
        if total:
            parts.append(
                f"Recovered of {summary} ({', '.join(damages)}): {recovered} of {total} "
                f"rule × damage × seed, {recovered / total:.1%}; within {RECOVERED:g} at the end: "
                f"{at_end}, {at_end / total:.1%}."
            )
    return "\n\n".join(parts) + "\n"


def _time(curve: LossCurve) -> str:
    step, recovered = curve.median_step(), f"{curve.recovered()}/{len(curve.losses)}"
    return recovered if step is None else f"{recovered}, {step:g}"


def _size(curve: LossCurve) -> str:
    first, last = _median(curve.ratios(0)), _median(curve.ratios(-1))
    return f"{short(first)} → {short(last)} ({curve.recovered_at_end()}/{len(curve.losses)})"


def _median(values: Sequence[float]) -> float:
    """Return the median; NaN counts as infinite."""
    return median(math.inf if math.isnan(value) else value for value in values)


def _by_damage(records: Sequence[RuleRecord], cell: Callable[[LossCurve], str]) -> str:
    done = {curve.damage for record in records for curve in record.curves}
    names = [name for name in (CONTROL, *DAMAGES) if name in done]
    rows = []
    for record in records:
        curves = {curve.damage: curve for curve in record.curves}
        rows.append([record.rule, *(cell(curves[n]) if n in curves else NONE for n in names)])
    return markdown_table(["rule", *names], rows)


def _by_value(records: Sequence[RuleRecord], condition: str) -> str:
    """Return a Markdown table of each rule's loss as trained, and its multiple at each value."""
    values = list(
        dict.fromkeys(r.value for record in records for r in record.responses_to(condition))
    )
    rows = []
    for record in records:
        responses_by_value = {
            response.value: response for response in record.responses_to(condition)
        }
        if responses_by_value:
            cells = [_change(record, responses_by_value.get(value)) for value in values]
            rows.append([record.rule, short(record.trained().mean()), *cells])
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
"""Conditions that are drawn, and the labels of their axes."""


def pictures(records: Sequence[RuleRecord]) -> dict[str, bytes]:
    """Return PNG files by their tasks' names. Needs matplotlib."""
    tasks = dict.fromkeys(record.about["task"] for record in records)
    return {task: _draw([r for r in records if r.about["task"] == task]) for task in tasks}


def _draw(records: Sequence[RuleRecord]) -> bytes:
    columns = 1 + len(DRAWN)
    figure, grid = new_figure(len(records), columns, (3.1 * columns, 2.3 * len(records)))
    for record, (damaged, *panels) in zip(records, grid, strict=True):
        damaged.set_title(record.rule, fontsize=9, loc="left")
        damaged.set(xscale="symlog", xlabel="steps after the damage", ylabel="loss over the twin's")
        damaged.axhline(RECOVERED, color="black", lw=0.7, ls=":")
        for k, curve in enumerate(record.curves):
            colour = "0.5" if curve.damage == CONTROL else f"C{k}"
            ratios = [curve.ratios(k) for k in range(len(curve.steps))]
            _draw_seeds(damaged, curve.steps, ratios, colour, curve.damage)
        for (condition, label), panel in zip(DRAWN.items(), panels, strict=True):
            panel.set(xscale="log", xlabel=label, ylabel="loss")
            trained = sorted(record.trained().losses)
            panel.axhline(trained[len(trained) // 2], color="black", lw=0.7, ls=":")
            measured = [response for response in record.responses_to(condition) if response.losses]
            values = [float(response.value) for response in measured]
            losses = [response.losses for response in measured]
            _draw_seeds(panel, values, losses, "C0", CONDITIONS[condition])
            number_plainly(panel.xaxis, values)
    legend_of(figure, grid[0][0], ncols=1 + len(DAMAGES), fontsize=7)
    return png(figure, 75)


def _draw_seeds(
    panel: Any, across: Sequence[float], columns: Sequence[Sequence[float]], colour: str, name: str
) -> None:
    """Plot the seeds' median and range in each of `columns` over `across`; NaN makes gaps."""
    diverged = [any(map(math.isnan, column)) for column in columns]
    # The upper median of an even number.
    low, middle, high = (
        [math.nan if flag else sorted(c)[k] for c, flag in zip(columns, diverged, strict=True)]
        for k in (0, len(columns[0]) // 2, -1)
    )
    draw_band(panel, across, (low, middle, high), colour, name, marker=".", ms=3, lw=1)
    panel.set_yscale("log")
    number_plainly(panel.yaxis)
