"""Measures one rule after the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import date
from typing import Any

from npa_envs.measure.robustness.conditions import grow, responses
from npa_envs.measure.robustness.grounds import Ground
from npa_envs.measure.robustness.record import RuleRecord
from npa_envs.measure.robustness.recovery import healing


def measure_rule(
    name: str,
    ground: Ground,
    most_particles: int,
    *,
    facts: Mapping[str, Any],
    command: str = "",
    before: RuleRecord | None = None,
    keep: Callable[[RuleRecord], None] = lambda record: None,
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
        keep: Called with what is measured so far, after the damages and after each value.
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
    keep(record)
    rest = responses(ground, trained, most_particles, done=len(record.responses))
    while not enough():
        response = next(rest, None)
        seconds = round(time.perf_counter() - begin, 2)
        if response is None:
            record = replace(record, done=True, seconds=seconds)
            keep(record)
            break
        record = replace(record, responses=(*record.responses, response), seconds=seconds)
        keep(record)
    return record
