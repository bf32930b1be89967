"""Checks of `npa-envs stress`: hard cases for accuracy and stability, each with an expectation."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

# These two modules register their checks.
from npa_envs.measure.accuracy import trained_rule_checks  # noqa: F401
from npa_envs.measure.accuracy.check_runner import CHECKS, GROUPS, RULE_CHECKS, Check
from npa_envs.measure.accuracy.hard_cases import scene_checks
from npa_envs.rule.files import shipped_rules


def all_checks(*, quick: bool = False, rules: Mapping[str, str] | None = None) -> list[Check]:
    """Return all checks, sorted by `GROUPS`; with `rules`, only the checks of these rules.

    `rules` maps names to shipped rules or files. `quick` checks fewer shipped rules.
    """
    # Gradients are checked for one rule of each task.
    few = ("gecko", "dots") if quick else ("gecko", "dots", "digits", "duck")
    of_rules = [
        Check(f"{one.name}/{name}", one.expected, partial(one.run, source), source)
        for group, names in {"time": list(shipped_rules()), "gradients": few}.items()
        for name, source in (rules or dict(zip(names, names, strict=True))).items()
        for one in RULE_CHECKS
        if one.group == group
    ]
    if rules:
        return of_rules
    by_dimension = sorted(CHECKS, key=lambda one: ("/2d" not in one.name, "/3d" not in one.name))
    groups = list(GROUPS)
    checks = [*scene_checks(), *of_rules, *by_dimension]
    return sorted(checks, key=lambda one: groups.index(one.group))
