"""What `npa-envs stress` checks: hard cases, what is expected of each, and where things break."""

from __future__ import annotations

from collections.abc import Mapping

from npa_envs.measure.accuracy.endurance import endurance_checks
from npa_envs.measure.accuracy.hard_cases import VALUES, geometry_checks
from npa_envs.measure.accuracy.numerics import PRECISION, gradients_checks
from npa_envs.measure.accuracy.suite import Check, by_dimension


def all_checks(
    *, quick: bool = False, seed: int = 0, rules: Mapping[str, str] | None = None
) -> list[Check]:
    """Return every check in its order; of `rules`, name -> source, the checks of a rule alone.

    When quick only some shipped rules are checked. Random places are drawn from the seed.
    """
    return [
        *(() if rules else (*geometry_checks(seed), *by_dimension(VALUES))),
        *endurance_checks(rules),
        *gradients_checks(quick=quick, rules=rules),
        *(() if rules else by_dimension(PRECISION)),
    ]
