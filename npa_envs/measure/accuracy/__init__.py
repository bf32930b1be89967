"""Checks of `npa-envs stress`: hard cases for accuracy and stability, each with an expectation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial

from npa_envs.measure.accuracy.endurance import ENDURANCE, rule_names
from npa_envs.measure.accuracy.hard_cases import VALUES, geometry_checks
from npa_envs.measure.accuracy.numerics import DIFFERENCES, GRADIENTS, PRECISION
from npa_envs.measure.accuracy.suite import Check, by_dimension


def all_checks(
    *, quick: bool = False, seed: int = 0, rules: Mapping[str, str] | None = None
) -> list[Check]:
    """Return every check in order; with `rules`, name -> source, only the checks of these rules.

    `quick` checks fewer shipped rules. The seed is that of random positions.
    """
    # One rule of each task.
    few = ("gecko", "dots") if quick else ("gecko", "dots", "digits", "duck")
    of_rules = [*_of(ENDURANCE, rules or rule_names()), *_of(GRADIENTS, rules or few)]
    if rules:
        return of_rules
    differences = [
        Check(f"{one.name}/{where}", one.expected, partial(one.run, periodic=where == "periodic"))
        for one in DIFFERENCES
        for where in ("open", "periodic")
    ]
    hard = [*geometry_checks(seed), *by_dimension(VALUES)]
    return [*hard, *of_rules, *differences, *by_dimension(PRECISION)]


def _of(checks: Iterable[Check], rules: Mapping[str, str] | Iterable[str]) -> list[Check]:
    """Return the checks for each rule, named NAME/RULE; rules: name -> source, or shipped ones."""
    sources = rules if isinstance(rules, Mapping) else {name: name for name in rules}
    return [
        Check(f"{one.name}/{name}", one.expected, partial(one.run, source), source)
        for name, source in sources.items()
        for one in checks
    ]
