"""Losses of rules under other conditions and after damage: records, tables and pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from itertools import compress
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
)
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import StreamId

WORKS = 2.0
"""A rule works at a value of a condition if its loss / the trained loss is at most this."""

MAX_PARTICLES = {"cpu": 1 << 17, "cuda": 1 << 21}
"""Maximum number of particles in all worlds together, by kind of device."""


@dataclass(frozen=True)
class Response:
    """The losses of all seeds at one value of a condition of `CONDITIONS`."""

    condition: str
    value: float | str
    steps: int
    """Steps from the start to the losses."""
    losses: tuple[float, ...]
    """Loss of each seed, NaN if a world is not finite; empty if the value was not measured."""
    note: str = ""
    """Why the value was not measured; "" if it was."""

    def mean(self) -> float:
        """Return the mean loss of the seeds, NaN if a loss is not finite or none was measured."""
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
        """Loss curve of the control, and then of each damage."""
        self.about: dict[str, Any] = {"done": True, "seconds": 0.0, "command": "", "date": ""}
        """Other fields of the file: `rule`, `task`, `metric`, `update_prob` of training, ..."""
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
        """Return the fields of the file except the run metadata, for JSON."""
        curves = [asdict(curve) for curve in self.curves]
        for fields, curve in zip(curves, self.curves, strict=True):
            fields["twins"] = fields.pop("undamaged")
            fields["recovery_steps"] = curve.recovery_steps()
        return {**self.about, "courses": curves, "responses": as_objects(self.rows)}

    def parse(self, content: dict[str, Any]) -> list[Response]:
        """Set `curves` and `about` from the JSON object of a file; return its responses."""

        def numbers(values: list[float | None]) -> tuple[float, ...]:
            return tuple(map(number, values))

        self.curves = []
        for row in content.pop("courses"):
            losses, undamaged = (tuple(map(numbers, row[name])) for name in ("losses", "twins"))
            near = tuple(map(numbers, row.get("near", ())))
            curve = LossCurve(row["damage"], tuple(row["steps"]), losses, undamaged, near)
            self.curves.append(curve)
        rows = content.pop("responses")
        del content["facts"]
        self.about = content
        return [Response(**row | {"losses": numbers(row["losses"])}) for row in rows]

    def responses_to(self, condition: str) -> list[Response]:
        """Return the seeds' losses at each value of a condition, in the order of measurement."""
        return [response for response in self.rows if response.condition == condition]

    def trained(self) -> Response:
        """Return the seeds' losses under the conditions of training."""
        return next(response for response in self.responses_to("eps") if response.value == 1.0)


def measure_rule(
    record: RuleRecord, trial: RuleTrial, *, enough: Callable[[], bool] = lambda: False
) -> None:
    """Measure what is missing in a rule's record; write it after each value of a condition.

    Once `enough` returns True, no further value is measured, and the record is not done.
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
    missing = responses(trial, trained, done=len(record.rows))
    while not enough():
        response = next(missing, None)
        record.about["seconds"] = round(time.perf_counter() - begin, 2)
        if response is None:
            record.about["done"] = True
            record.write()
            break
        record.add(response)


def grow(
    trial: RuleTrial, condition: str = "", value: float | str = 1.0
) -> tuple[Particles, Response]:
    """Grow worlds as in training, or with `condition` at `value`; return worlds and losses."""
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
def responses(trial: RuleTrial, trained: Response, *, done: int = 0) -> Iterator[Response]:
    """Yield the response at each value of each condition of the plan, without the first `done`."""
    every = [(name, value) for name, values in trial.plan.values.items() for value in values]
    trained_values = {"update_prob": trial.task.update_prob, "noise": 0.0, "shape": "trained"}
    for condition, value in every[done:]:
        # Values of other conditions are factors on those of training.
        if value == trained_values.get(condition, 1.0):
            yield Response(condition, value, trained.steps, trained.losses)
            continue
        fraction = float(value) if condition == "particles" else 1.0
        total = trial.world_count * trial.particles(fraction)
        if total > max(MAX_PARTICLES[trial.device.type], trial.world_count * trial.particle_count):
            yield Response(condition, value, 0, (), note=f"{total} particles in all")
            continue
        try:
            yield grow(trial, condition, value)[1]
        except torch.OutOfMemoryError:
            yield Response(condition, value, 0, (), note=f"no memory for {total} particles")


# Tables in Markdown


def where_it_works(record: RuleRecord, condition: str) -> str:
    """Return the values of a condition at which a rule works, as text; "" if it has no responses.

    It works if all worlds are finite and the mean loss is at most `WORKS` times the trained loss.
    """
    measured = record.responses_to(condition)
    if not measured:
        return ""
    trained = record.trained().mean()
    # The ratio of a value with a seed that diverged, or that was left out, is NaN.
    works = [short(r.value) for r in measured if ratio(r.mean(), trained) <= WORKS]
    left_out = [short(response.value) for response in measured if not response.losses]
    text = ", ".join(works) or "nowhere"
    return text + (f" (not measured: {', '.join(left_out)})" if left_out else "")


def tables(records: Sequence[RuleRecord]) -> str:
    """Return all tables of several rules, with their headings, in Markdown."""
    ranges = [[r.rule, *(where_it_works(r, name) or NONE for name in CONDITIONS)] for r in records]
    works = markdown_table(["rule", *CONDITIONS], ranges)
    parts = [
        "Where rules work: values at which the mean loss is at most "
        f"{WORKS:g} times that under training conditions and all seeds are finite:\n\n{works}",
        "Recovered of the seeds that the damage changed, and their median recovery time [steps]:"
        f"\n\n{_by_damage(records)}",
    ]
    for condition, summary in CONDITIONS.items():
        if table := _by_value(records, condition):
            parts.append(f"Loss over that under training conditions, by {summary}:\n\n{table}")
    return "\n\n".join(parts) + "\n"


def _by_damage(records: Sequence[RuleRecord]) -> str:
    done = {curve.damage for record in records for curve in record.curves}
    names = [name for name in (CONTROL, *DAMAGES) if name in done]
    rows = []
    for record in records:
        cells = dict.fromkeys(names, NONE)
        for curve in record.curves:
            counted = [*compress(curve.recovery_steps(), curve.changed())]
            steps = [step for step in counted if step is not None]
            time = f", {median(steps):g}" if steps else ""
            cells[curve.damage] = f"{len(steps)}/{len(counted)}{time}"
        rows.append([record.rule, *cells.values()])
    return markdown_table(["rule", *names], rows)


def _by_value(records: Sequence[RuleRecord], condition: str) -> str:
    """Return a Markdown table by rule: the trained loss, and loss / trained loss at each value."""
    values = list(
        dict.fromkeys(r.value for record in records for r in record.responses_to(condition))
    )
    rows = []
    for record in records:
        trained = record.trained().mean()
        cells = dict.fromkeys(values, NONE)
        for response in record.responses_to(condition):
            if response.losses:
                mean = response.mean()
                cells[response.value] = short(mean / trained) if trained else short(mean)
        if record.responses_to(condition):
            rows.append([record.rule, short(trained), *cells.values()])
    return markdown_table(["rule", "trained loss", *map(short, values)], rows) if rows else ""


# Curves with bands over the seeds: a picture for each task, a row for each of its rules.

DRAWN = {
    "eps": "ε over the trained one",
    "particles": "N over the trained one",
    "update_prob": "p",
}
"""Conditions that are drawn, and the labels of their axes."""


def pictures(records: Sequence[RuleRecord]) -> dict[str, bytes]:
    """Return a PNG file of all records of a task, by the task's name. Needs matplotlib."""
    tasks = dict.fromkeys(record.about["task"] for record in records)
    return {task: _draw([r for r in records if r.about["task"] == task]) for task in tasks}


def _draw(records: Sequence[RuleRecord]) -> bytes:
    columns = 1 + len(DRAWN)
    figure, grid = new_figure(len(records), columns, (3.1 * columns, 2.3 * len(records)))
    for record, (damaged, *panels) in zip(records, grid, strict=True):
        damaged.set_title(record.rule, fontsize=9, loc="left")
        damaged.set(xscale="symlog", xlabel="steps after the damage", ylabel="loss over the copy's")
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
    """Plot the median and the range of each of `columns` at `across` (x); NaN makes gaps."""
    diverged = [any(map(math.isnan, column)) for column in columns]
    # The upper median of an even number.
    low, middle, high = (
        [math.nan if flag else sorted(c)[k] for c, flag in zip(columns, diverged, strict=True)]
        for k in (0, len(columns[0]) // 2, -1)
    )
    draw_band(panel, across, (low, middle, high), colour, name, marker=".", ms=3, lw=1)
    panel.set_yscale("log")
    number_plainly(panel.yaxis)
