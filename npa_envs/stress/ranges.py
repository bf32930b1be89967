"""How far every shipped rule may leave what it was trained at before it stops working."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from npa_envs.stress.checks import Check, Finding, Session
from npa_envs.stress.habitats import Habitat, LongRun, habitat, rule_names

WORKS = 2.0
"""A rule works where its metric is at most this many times the trained one, and all is finite."""

QUICK_RULES = ("digits", "dots", "heart")
"""Rules of a quick run."""

WORLDS, QUICK_WORLDS = 4, 1
"""Worlds whose mean metric is taken."""


@dataclass(frozen=True)
class Axis:
    """Something that is varied, everything else as trained."""

    name: str
    """What it is called."""
    summary: str
    """What its values are, for a sentence."""
    values: tuple[float, ...]
    """Values, increasing."""
    quick: tuple[float, ...]
    """Those of a quick run."""

    def trained(self, home: Habitat) -> float:
        """Return its value at which a rule was trained."""
        return {"update_prob": home.task.update_prob, "noise": 0.0}.get(self.name, 1.0)

    def options(self, home: Habitat, value: float) -> dict[str, Any]:
        """Return options of `rollout` at a value."""
        changed = {
            "update_prob": {"update_prob": value},
            "dt": {"dt": value},
            "eps": {"eps": value * home.task.eps},
            "noise": {"position_noise": value * home.task.eps},
        }
        return home.options(**changed.get(self.name, {}))


AXES = (
    Axis(
        "update_prob",
        "probability of each particle's update, for as many updates in all",
        (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0),
        (0.2, 0.5, 1.0),
    ),
    Axis(
        "dt",
        "time step, for as much time in all",
        (0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
        (0.5, 1.0, 2.0),
    ),
    Axis(
        "eps",
        "perception radius over the trained one; what grows freely is measured at its trained size",
        (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0),
        (0.7, 1.0, 1.4),
    ),
    Axis(
        "particles",
        "particles over the trained number",
        (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0, 16.0),
        (0.5, 1.0, 2.0),
    ),
    Axis(
        "noise",
        "noise of every position in each step, over the perception radius",
        (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0),
        (0.0, 1e-2, 0.1),
    ),
)
"""Everything that is varied."""


def ranges_checks(*, quick: bool) -> list[Check]:
    """Return the checks of the group `ranges`.

    Args:
        quick: Only of some rules.
    """
    names = QUICK_RULES if quick else rule_names()
    return [
        Check(
            f"ranges/{axis.name}/{name}",
            f"where the rule works ({axis.summary}): its metric at most {WORKS:g} times the "
            "trained one, all finite; as trained it is finite",
            partial(_run, axis, name),
        )
        for axis in AXES
        for name in names
    ]


def label(value: float) -> str:
    """Return a value as figures name it."""
    return f"{value:.3g}"


def working_range(values: Sequence[float], ratios: Sequence[float], trained: float) -> str:
    """Return the values around the trained one at which a rule works, in words.

    Args:
        values: Values tried, increasing, the trained one among them.
        ratios: The metric at each over that as trained.
        trained: The value that the rule was trained at.
    """
    works = [ratio <= WORKS for ratio in ratios]
    low = high = min(range(len(values)), key=lambda k: abs(values[k] - trained))
    while low > 0 and works[low - 1]:
        low -= 1
    while high + 1 < len(values) and works[high + 1]:
        high += 1
    text = f"{label(values[low])} … {label(values[high])}"
    apart = [label(v) for k, v in enumerate(values) if works[k] and not low <= k <= high]
    return f"{text}, and {', '.join(apart)}" if apart else text


def _run(axis: Axis, name: str, session: Session) -> Finding:
    values = axis.quick if session.quick else axis.values
    home = habitat(session, name, world_count=_world_count(session))
    base = session.once(
        ("trained", name), lambda: _metric(home, session, home.horizon, home.options())
    )
    metrics = [_metric_at(axis, name, session, value) for value in values]
    ratios = [metric / base for metric in metrics]
    figures = {"trained": base} | {
        label(value): ratio for value, ratio in zip(values, ratios, strict=True)
    }
    broken = [label(v) for v, metric in zip(values, metrics, strict=True) if math.isnan(metric)]
    return Finding(
        figures,
        {"trained": sys.float_info.max},
        holds=working_range(values, ratios, axis.trained(home)),
        note=f"not finite at {', '.join(broken)}" if broken else "",
    )


def _world_count(session: Session) -> int:
    return QUICK_WORLDS if session.quick else WORLDS


def _metric_at(axis: Axis, name: str, session: Session, value: float) -> float:
    """Return the metric of a rule at a value; NaN where something is not finite."""
    share = value if axis.name == "particles" else 1.0
    home = habitat(session, name, world_count=_world_count(session), particles=share)
    # As many updates, or as much time, as trained.
    pace = {"update_prob": value / home.task.update_prob, "dt": value}.get(axis.name, 1.0)
    steps = max(1, round(home.horizon / pace))
    return _metric(home, session, steps, axis.options(home, value))


def _metric(home: Habitat, session: Session, steps: int, options: dict[str, Any]) -> float:
    run = LongRun(home, session.generator(1), options)
    run.advance(steps)
    finite = bool(run.x.isfinite().all()) and bool(run.s.isfinite().all())
    metric = home.metric(home.at_trained_size(run.x, run.eps), run.s) if finite else math.nan
    return metric if math.isfinite(metric) else math.nan
