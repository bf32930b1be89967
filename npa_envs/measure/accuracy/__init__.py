"""The list of all checks of `npa-envs stress`: hard cases of accuracy and stability."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

# These two modules register their checks.
from npa_envs.measure.accuracy import trained_rule_checks  # noqa: F401
from npa_envs.measure.accuracy.check_runner import CHECKS, GROUPS, RULE_CHECKS, Check
from npa_envs.measure.accuracy.hard_cases import scene_checks
from npa_envs.rule.files import shipped_rules


def all_checks(*, quick: bool = False, rules: Mapping[str, str] | None = None) -> list[Check]:
    """Return all checks in the order of `GROUPS`, or only those of the given `rules`.

    `rules` maps the name that a check shows to a shipped rule's name or a file. A quick list has
    gradient checks of two shipped rules instead of four.
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
