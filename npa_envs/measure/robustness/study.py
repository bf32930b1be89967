"""The study of rules: what each bears and heals, as a record; tables and curves of many."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import torch

from npa_envs.measure.accuracy.endurance import WORKS
from npa_envs.measure.plots import draw_band, legend_of, mark_decades, new_figure, png
from npa_envs.measure.record import number, read_record, write_record
from npa_envs.measure.robustness.plans import CONDITIONS, trained_value
from npa_envs.measure.robustness.recovery import (
    CONTROL,
    DAMAGES,
    RECOVERED,
    LossCurve,
    healing,
    ratio,
)
from npa_envs.measure.robustness.trials import RuleTrial, TaskTrial, loss_curves
from npa_envs.measure.tables import NONE, markdown_table, short
from npa_envs.world.randomness import StreamId

MOST_PARTICLES = {"cpu": 1 << 17, "cuda": 1 << 21}
"""Particles of all worlds together; where there would be more, a value is left out."""


@dataclass(frozen=True)
class Response:
    """The losses of all seeds under one condition."""

    condition: str
    value: float | str
    steps: int
    """Steps from the seed."""
    losses: tuple[float, ...]
    """Loss of each seed, NaN where a world is not finite; none where it was left out."""
    note: str = ""
    """Why it was left out."""

    def mean(self) -> float:
        """Return the mean loss of the seeds; NaN where one is not finite, or there are none."""
        return math.fsum(self.losses) / len(self.losses) if self.losses else math.nan


@dataclass(frozen=True)
class RuleRecord:
    """What was measured of one rule."""

    rule: str
    task: str
    metric: str
    """What losses are."""
    update_prob: float
    """Probability of an update as trained."""
    facts: Mapping[str, Any]
    """What the figures follow from: the rule's weights, device, machine, size, seeds, commit,
    versions."""
    loss_curves: tuple[LossCurve, ...]
    """After each damage, the control first."""
    responses: tuple[Response, ...]
    """Under each condition."""
    done: bool = True
    """Whether that is all; else a run goes on with the next value."""
    seconds: float = 0.0
    """How long it took [s]."""
    command: str = ""
    date: str = ""

    @classmethod
    def read(cls, path: Path, facts: Mapping[str, Any]) -> RuleRecord | None:
        """Return the record that a run left, None where there is none.

        Raises:
            NPAError: As for `read_record`.
        """

        def numbers(values: list[float | None]) -> tuple[float, ...]:
            return tuple(map(number, values))

        def course(row: dict[str, Any]) -> LossCurve:
            losses, twins = (tuple(map(numbers, row[name])) for name in ("losses", "twins"))
            return LossCurve(row["damage"], tuple(row["steps"]), losses, twins)

        def made(held: dict[str, Any]) -> RuleRecord:
            held["courses"] = tuple(map(course, held["courses"]))
            held["responses"] = tuple(
                Response(**row | {"losses": numbers(row["losses"])}) for row in held["responses"]
            )
            return cls(**held)

        return read_record(path, facts, made, command="robustness")

    def write(self, path: Path) -> None:
        """Write everything as JSON; what is not finite becomes null.

        Raises:
            NPAError: It cannot be written.
        """
        content = asdict(self)
        for course, row in zip(self.loss_curves, content["courses"], strict=True):
            row["recovery_steps"] = course.recovery_steps()
        write_record(path, content)

    def trained(self) -> Response:
        """Return what comes of worlds as trained."""
        return next(r for r in self.responses if (r.condition, r.value) == ("eps", 1.0))


def measure_rule(
    name: str,
    ground: RuleTrial,
    most_particles: int,
    *,
    facts: Mapping[str, Any],
    command: str = "",
    before: RuleRecord | None = None,
    path: Path | None = None,
    enough: Callable[[], bool] = lambda: False,
) -> RuleRecord:
    """Return what a rule bears and heals; conditions of more than `most_particles` are left out.

    What an earlier run has measured `before` is not measured again. The file is written after the
    damages and after each value. Before each value it is asked whether that is `enough`: then the
    record is not done.
    """
    begin = time.perf_counter() - (0.0 if before is None else before.seconds)
    home, trained = grow(ground)
    record = before or RuleRecord(
        rule=name,
        task=ground.task_name,
        metric=ground.metric_name,
        update_prob=float(ground.task.update_prob),
        facts=facts,
        loss_curves=tuple(healing(ground, home)),
        responses=(),
        done=False,
        command=command,
        date=date.today().isoformat(),
    )

    def keep() -> None:
        if path is not None:
            record.write(path)

    keep()
    rest = responses(ground, trained, most_particles, done=len(record.responses))
    while not enough():
        response = next(rest, None)
        record = replace(record, seconds=round(time.perf_counter() - begin, 2))
        if response is None:
            record = replace(record, done=True)
            keep()
            break
        record = replace(record, responses=(*record.responses, response))
        keep()
    return record


def grow(
    ground: RuleTrial, condition: str = "", value: float | str = 1.0
) -> tuple[TaskTrial, Response]:
    """Grow worlds from their seeds under a condition, none by default, and take their losses.

    Returns:
        The worlds as they are then, and what came of them.
    """
    home = ground.home(
        share=float(value) if condition == "particles" else 1.0,
        shape=str(value) if condition == "shape" else "trained",
    )
    changed: dict[str, Any] = {}
    pace = 1.0
    if condition in ("update_prob", "dt"):
        changed[condition] = value
        # As many updates, or as much time, as trained.
        pace = float(value) / (ground.task.update_prob if condition == "update_prob" else 1.0)
    elif condition in ("eps", "noise"):
        name = "eps" if condition == "eps" else "position_noise"
        changed[name] = float(value) * ground.task.eps
    # In whole chunks: what is left over would refuse worlds that are not finite any more.
    chunk = ground.plan.chunk
    steps = chunk * max(1, round(ground.plan.grow_steps / pace / chunk))
    run = ground.run(home, ground.random(StreamId.GROWTH), **changed)
    losses = ground.by_seed(loss_curves(home, run, (steps,))[0]).tolist()
    return home.with_worlds(run.x, run.s), Response(condition, value, steps, tuple(losses))


@torch.no_grad()
def responses(
    ground: RuleTrial, trained: Response, most_particles: int, *, done: int = 0
) -> Iterator[Response]:
    """Yield what comes of each value of each condition but for the first `done`.

    Worlds as trained are not measured again; a value of more than `most_particles` is left out.
    """
    every = [(name, value) for name, values in ground.plan.values.items() for value in values]
    for condition, value in every[done:]:
        if value == trained_value(condition, ground.task.update_prob):
            yield Response(condition, value, trained.steps, trained.losses)
            continue
        share = float(value) if condition == "particles" else 1.0
        total = ground.world_count * ground.particles(share)
        if total > max(most_particles, ground.world_count * ground.particle_count):
            yield Response(condition, value, 0, (), note=f"{total} particles in all")
            continue
        try:
            yield grow(ground, condition, value)[1]
        except torch.OutOfMemoryError:
            yield Response(condition, value, 0, (), note=f"no memory for {total} particles")


# Where rules work, in words


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
    loss_curves = [c for record in records for c in record.loss_curves if c.damage in damages]
    recovered = sum(course.recovered() for course in loss_curves)
    at_end = sum(course.within_at_end() for course in loss_curves)
    return recovered, at_end, sum(len(course.losses) for course in loss_curves)


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


def _time(course: LossCurve) -> str:
    step = course.median_step()
    told = f"{course.recovered()}/{len(course.losses)}"
    return told if step is None else f"{told}, {step:g}"


def _size(course: LossCurve) -> str:
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


def _by_damage(records: Sequence[RuleRecord], cell: Callable[[LossCurve], str]) -> str:
    done = {course.damage for record in records for course in record.loss_curves}
    names = [name for name in (CONTROL, *DAMAGES) if name in done]
    rows = []
    for record in records:
        found = {course.damage: course for course in record.loss_curves}
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
    for place, course in enumerate(record.loss_curves):
        colour = "0.5" if course.damage == CONTROL else f"C{place}"
        columns = [course.ratios(k) for k in range(len(course.steps))]
        _draw_seeds(panel, course.steps, columns, colour, course.damage)
    panel.axhline(RECOVERED, color="black", lw=0.7, ls=":")
    steps = record.loss_curves[0].steps
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
