"""Checks that the configuration dataclasses share: each error names field, rule, value, cure."""

from __future__ import annotations

import sys
from typing import Any, TypeGuard

from npa_envs.errors import NPAError, shown


def check_positive(
    config: object, kind: type, *names: str, at_least: int = 1, at_most: int = sys.maxsize
) -> None:
    """Check that fields are whole numbers >= `at_least` (`kind` int) or finite and > 0 (float).

    Args:
        config: The dataclass that holds the fields.
        kind: `int` or `float`.
        names: The fields to check.
        at_least: Smallest whole number allowed; ignored for floats.
        at_most: Largest one.

    Raises:
        NPAError: A field breaks the rule.
    """
    for name in names:
        value = getattr(config, name)
        if kind is int:
            ok = is_whole(value) and value >= at_least
            _require(ok, config, name, f"be a whole number of at least {at_least}", at_least)
            _require(value <= at_most, config, name, f"be at most {at_most}", at_least)
        else:
            ok = is_real(value) and value > 0
            _require(ok, config, name, "be a finite number greater than 0", 1.0)


def check_non_negative(config: object, *names: str) -> None:
    """Check that fields are finite numbers of at least 0.

    Raises:
        NPAError: A field breaks the rule.
    """
    for name in names:
        value = getattr(config, name)
        ok = is_real(value) and value >= 0
        _require(ok, config, name, "be a finite number of at least 0", 0.0)


def check_fraction(config: object, *names: str) -> None:
    """Check that fields are numbers in (0, 1].

    Raises:
        NPAError: A field breaks the rule.
    """
    for name in names:
        value = getattr(config, name)
        _require(is_real(value) and 0 < value <= 1, config, name, "lie in (0, 1]", 0.5)


def check_flag(config: object, *names: str) -> None:
    """Check that fields are True or False.

    Raises:
        NPAError: A field is neither.
    """
    for name in names:
        value = getattr(config, name)
        _require(isinstance(value, bool), config, name, "be True or False", False)


def check_text(config: object, name: str, what: str) -> None:
    """Check that a field is text and not empty.

    Args:
        config: The dataclass that holds the field.
        name: The field.
        what: What the text may be, for the error.

    Raises:
        NPAError: It is not.
    """
    value = getattr(config, name)
    _require(isinstance(value, str) and value != "", config, name, f"be {what}", "name")


def check_seed(config: object, name: str, *, bits: int = 63) -> None:
    """Check that a field can seed a random generator: a whole number in [0, 2**bits).

    Args:
        config: The dataclass that holds the field.
        name: The field.
        bits: Bits that the generator takes.

    Raises:
        NPAError: It cannot.
    """
    value = getattr(config, name)
    ok = is_whole(value) and 0 <= value < 2**bits
    _require(ok, config, name, f"be a whole number of at least 0 and below 2**{bits}", 0)


def is_whole(value: Any) -> TypeGuard[int]:
    """Return whether `value` is an int (a bool is not)."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_real(value: Any) -> bool:
    """Return whether `value` is a finite int or float (a bool is not)."""
    # Compared, not converted: an int may be too large for a float.
    real = isinstance(value, int | float) and not isinstance(value, bool)
    return real and -sys.float_info.max <= value <= sys.float_info.max


def _require(ok: bool, config: object, name: str, rule: str, otherwise: object) -> None:
    """Raise an error that shows the field's default, or `otherwise`, for example."""
    if not ok:
        example = getattr(type(config), name, otherwise)
        raise NPAError(
            f"{name} must {rule}, got {shown(getattr(config, name))}: for example "
            f"{name}={example!r}"
        )


def check_count(name: str, value: object, cure: str = "", *, at_most: int = sys.maxsize) -> None:
    """Check that an argument is a whole number of at least 1, and at most `at_most`.

    Raises:
        NPAError: It is not.
    """
    if not is_whole(value) or value < 1:
        raise NPAError(f"{name} must be an integer of at least 1, got {shown(value)}{cure}")
    if value > at_most:
        raise NPAError(f"{name} must be at most {at_most}, got {shown(value)}{cure}")
