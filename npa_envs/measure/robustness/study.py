"""The study of one rule: what it bears under other conditions and heals, as a record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import torch

from npa_envs.measure.record import number, read_record, write_record
from npa_envs.measure.robustness.grounds import Ground, Home, courses
from npa_envs.measure.robustness.plans import trained_value
from npa_envs.measure.robustness.recovery import Course, healing
from npa_envs.world.randomness import Purpose

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
    """What the figures follow from: device, machine, size, seeds, commit, versions."""
    courses: tuple[Course, ...]
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

        def course(row: dict[str, Any]) -> Course:
            losses, twins = (tuple(map(numbers, row[name])) for name in ("losses", "twins"))
            return Course(row["damage"], tuple(row["steps"]), losses, twins)

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
        for course, row in zip(self.courses, content["courses"], strict=True):
            row["recovery_steps"] = course.recovery_steps()
        write_record(path, content)

    def trained(self) -> Response:
        """Return what comes of worlds as trained."""
        return next(r for r in self.responses if (r.condition, r.value) == ("eps", 1.0))


def measure_rule(
    name: str,
    ground: Ground,
    most_particles: int,
    *,
    facts: Mapping[str, Any],
    command: str = "",
    before: RuleRecord | None = None,
    path: Path | None = None,
    enough: Callable[[], bool] = lambda: False,
) -> RuleRecord:
    """Return what a rule bears and heals.

    Args:
        name: The rule's name.
        ground: The rule, and what is measured.
        most_particles: Particles of all worlds; conditions with more are left out.
        facts: What the figures follow from.
        command: The command line, for the record.
        before: What an earlier run has measured: it is not measured again.
        path: File that is written after the damages and after each value; None: none.
        enough: Asked before each value: whether to stop there, with a record that is not done.
    """
    begin = time.perf_counter() - (0.0 if before is None else before.seconds)
    home, trained = grow(ground)
    record = before or RuleRecord(
        rule=name,
        task=ground.task_name,
        metric=ground.metric_name,
        update_prob=float(ground.task.update_prob),
        facts=facts,
        courses=tuple(healing(ground, home)),
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


def grow(ground: Ground, condition: str = "", value: float | str = 1.0) -> tuple[Home, Response]:
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
    run = ground.run(home, ground.random(Purpose.GROWTH), **changed)
    losses = ground.by_seed(courses(home, run, (steps,))[0]).tolist()
    return home.with_worlds(run.x, run.s), Response(condition, value, steps, tuple(losses))


@torch.no_grad()
def responses(
    ground: Ground, trained: Response, most_particles: int, *, done: int = 0
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
