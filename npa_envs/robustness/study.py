"""Measures one rule after the other."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import date
from typing import Any

from npa_envs.robustness.conditions import grow, responses
from npa_envs.robustness.grounds import Ground
from npa_envs.robustness.record import RuleRecord
from npa_envs.robustness.recovery import healing


def measure_rule(
    name: str, ground: Ground, most_particles: int, *, facts: Mapping[str, Any], command: str = ""
) -> RuleRecord:
    """Return what a rule bears and heals.

    Args:
        name: The rule's name.
        ground: The rule, and what is measured.
        most_particles: Particles of all worlds; conditions with more are left out.
        facts: What the figures follow from.
        command: The command line, for the record.
    """
    begin = time.perf_counter()
    home, trained = grow(ground)
    courses = tuple(healing(ground, home))
    found = tuple(responses(ground, trained, most_particles))
    seconds = time.perf_counter() - begin
    return RuleRecord(
        rule=name,
        task=ground.task_name,
        metric=ground.metric_name,
        update_prob=float(ground.task.update_prob),
        facts=facts,
        courses=courses,
        responses=found,
        seconds=round(seconds, 2),
        command=command,
        date=date.today().isoformat(),
    )
