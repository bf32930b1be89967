"""Where rules work: the values of a condition at which the loss stays near that as trained."""

from __future__ import annotations

from collections.abc import Sequence

from npa_envs.robustness.conditions import Response
from npa_envs.robustness.plans import trained_value
from npa_envs.robustness.record import RuleRecord
from npa_envs.robustness.recovery import ratio
from npa_envs.stress.habitats import WORKS


def where_it_works(record: RuleRecord, condition: str) -> str:
    """Return the values of a condition at which a rule works, in words; "" where there are none.

    It works where all seeds are finite and the mean loss is at most `WORKS` times that as trained.

    Args:
        record: The rule's.
        condition: One of `CONDITIONS`.
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


def short(value: float | str) -> str:
    """Return a number with three digits, a word as it is."""
    return value if isinstance(value, str) else f"{value:.3g}"


def working_range(values: Sequence[float], ratios: Sequence[float], trained: float) -> str:
    """Return the values around the trained one at which a rule works, in words.

    Args:
        values: Values tried, increasing.
        ratios: The loss at each over that as trained; NaN where a seed is not finite.
        trained: The value that the rule was trained at.
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
