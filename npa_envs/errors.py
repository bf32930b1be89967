"""Errors of the public API: each names the argument, the rule, the value, and a correction."""

from __future__ import annotations

import contextlib
import difflib
import math
import reprlib
from collections.abc import Collection, Iterable, Iterator
from typing import Any

SHOWN_LENGTH = 200
"""Maximum number of characters of a value in an error, about."""

KNOWN_LENGTH = 40
"""Maximum number of known names in an error."""

SHOWN_NUMBERS = 4
"""Maximum number of a tensor's or an array's numbers in an error; of larger ones the shape is."""


class _Brief(reprlib.Repr):
    """Python's own short texts, with the shape in place of a tensor's numbers."""

    def repr1(self, x: Any, level: int) -> str:
        shape = getattr(x, "shape", None)
        if not isinstance(shape, tuple) or not hasattr(x, "dtype") or isinstance(x, type):
            sides = _sides(x)
            many = len(sides) > 1 and math.prod(sides) > SHOWN_NUMBERS
            return f"{' x '.join(map(str, sides))} numbers" if many else super().repr1(x, level)
        if math.prod(shape) <= SHOWN_NUMBERS and not getattr(x, "is_meta", False):
            return " ".join(super().repr1(x, level).split())
        kind = "array" if type(x).__module__ == "numpy" else type(x).__name__.lower()
        return f"a {str(x.dtype).removeprefix('torch.')} {kind} of shape {tuple(shape)}"


def _sides(value: Any) -> list[int]:
    """Return the lengths of nested lists or tuples of numbers, outermost first; [] for others."""
    sides: list[int] = []
    while isinstance(value, list | tuple) and value and len(sides) < 8:
        sides.append(len(value))
        value = value[0]
    return sides if isinstance(value, int | float) else []


_brief = _Brief()
_brief.maxlevel = 3
_brief.maxlist = _brief.maxtuple = _brief.maxdict = _brief.maxset = _brief.maxfrozenset = 16
_brief.maxdeque = _brief.maxarray = 16
_brief.maxstring = _brief.maxlong = _brief.maxother = SHOWN_LENGTH


class NPAError(ValueError):
    """A wrong argument or file; the message says how to correct it."""


class LostProcessError(NPAError):
    """Another process of a run has ended or cannot be reached; its own output says why."""


class DivergedError(NPAError):
    """Numbers became infinite or NaN; the message says when, which, and in which worlds."""


class UnknownKeywordError(NPAError, TypeError):
    """An environment has no such keyword; type and message are those of Python's own error.

    Libraries recognise that error and leave the keyword out.
    """

    def __init__(self, message: str) -> None:
        # Gymnasium makes the error again with these words at its end.
        super().__init__(message.replace(" was raised from the env", ".\nRaised from the env"))


class MissingDependencyError(NPAError, ImportError):
    """An optional dependency is not installed; the message has the command that installs it."""


@contextlib.contextmanager
def importing(library: str, purpose: str, hint: str) -> Iterator[None]:
    """Raise MissingDependencyError with a hint if an import of a library in the block fails."""
    try:
        yield
    except ImportError as error:
        raise MissingDependencyError(f"{purpose} needs {library} ({error}): {hint}") from error


def shown(value: object) -> str:
    """Return a value as text of about 200 characters at most, for an error.

    The time is limited too, for deeply nested values, long numbers and whole files.
    """
    if type(value) is str and value.isalnum() and len(value) <= KNOWN_LENGTH:
        return repr(value)  # checks that pass call this too, in each step
    try:
        brief = str(value) if isinstance(value, BaseException) else _brief.repr(value)
    except Exception:
        # Python refuses to write whole numbers of thousands of digits.
        brief = f"<{type(value).__name__}>"
    if isinstance(value, BaseException):
        brief = " ".join(brief.split()) or type(value).__name__
    half = SHOWN_LENGTH // 2
    return brief if len(brief) <= SHOWN_LENGTH else f"{brief[:half]} ... {brief[-half:]}"


def suggest(name: object, known: Iterable[str]) -> str:
    """Return the end of an error about an unknown name: the nearest known name, then all.

    Of names that are equally near it is the first in the alphabet.
    """
    names = sorted(known)
    nearest = max(names, key=lambda one: _likeness(name, one), default="")
    hint = f"did you mean {shown(nearest)}? " if _likeness(name, nearest) >= 0.65 else ""
    more = f" and {len(names) - KNOWN_LENGTH} more" if len(names) > KNOWN_LENGTH else ""
    return f"{hint}known: {', '.join(names[:KNOWN_LENGTH])}{more}"


def check_known(begin: str, name: object, known: Collection[str], where: str = "") -> None:
    """Raise NPAError unless a name is known; its message has `begin`, the name and `where`."""
    if not isinstance(name, str) or name not in known:
        raise NPAError(f"{begin} {shown(name)}{where}: {suggest(name, known)}")


def _likeness(name: object, known: str) -> float:
    """Return how alike two names are by their letters, 1 if they are equal; more by a shared part.

    A part of four letters or more counts by its share of `name`.
    """
    if not isinstance(name, str) or not name:
        return 0.0
    matcher = difflib.SequenceMatcher(None, known.casefold(), name[:SHOWN_LENGTH].casefold())
    part = matcher.find_longest_match().size
    return matcher.ratio() + (0.5 * part / len(name) if part >= 4 else 0.0)
