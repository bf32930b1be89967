"""Errors of the public API: each names the argument, the rule, what came, and the cure."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable

SHOWN_LENGTH = 200
"""Characters of what came that an error shows, about."""

_brief = reprlib.Repr()
_brief.maxlevel = 3
_brief.maxlist = _brief.maxtuple = _brief.maxdict = _brief.maxset = _brief.maxfrozenset = 16
_brief.maxdeque = _brief.maxarray = 16
_brief.maxstring = _brief.maxlong = _brief.maxother = SHOWN_LENGTH


class NPAError(ValueError):
    """A mistake in what the caller gave; the message says how to mend it."""


class LostProcessError(NPAError):
    """Another process of a run has ended or cannot be reached; it says why, or its launcher."""


class DivergedError(NPAError):
    """Numbers became infinite or NaN; the message says when, which, and in which worlds."""


class UnknownKeywordError(NPAError, TypeError):
    """A keyword that an environment does not have, worded as Python's own error.

    By that type and those words libraries know that they may leave a keyword out.
    """


class MissingDependencyError(NPAError, ImportError):
    """An optional dependency is not installed; the message holds the command that installs it."""


def shown(value: object) -> str:
    """Return what came as an error shows it: in about 200 characters, however large it is.

    Nested values that share parts, numbers of many digits and whole files cost no more than that.
    """
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
    """Return the tail of an error about an unknown name: the nearest known one, then all."""
    names = sorted(known)
    nearest = difflib.get_close_matches(name, names, n=1) if isinstance(name, str) else []
    hint = f"did you mean {shown(nearest[0])}? " if nearest else ""
    return f"{hint}known: {', '.join(names)}"
