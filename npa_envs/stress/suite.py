"""Every check of `npa-envs stress`, in the order that it runs them in."""

from __future__ import annotations

from npa_envs.stress.checks import Check
from npa_envs.stress.endurance import endurance_checks
from npa_envs.stress.geometry import geometry_checks
from npa_envs.stress.gradients import gradients_checks
from npa_envs.stress.precision import precision_checks
from npa_envs.stress.values import values_checks


def all_checks(*, quick: bool = False, seed: int = 0) -> list[Check]:
    """Return every check, by group.

    Args:
        quick: Only of some of the rules, where there is a check for each rule.
        seed: What random places are drawn from.
    """
    return [
        *geometry_checks(seed),
        *values_checks(),
        *endurance_checks(),
        *gradients_checks(quick=quick),
        *precision_checks(quick=quick),
    ]
