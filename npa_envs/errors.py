"""Errors of the public API: each names the argument, the rule, the value, and a correction."""

from __future__ import annotations

import contextlib
import difflib
import reprlib
from collections.abc import Iterable, Iterator

SHOWN_LENGTH = 200
"""Maximum number of characters of a value in an error, about."""

_brief = reprlib.Repr()
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
    """Return the end of an error about an unknown name: the nearest known name, then all."""
    names = sorted(known)
    nearest = difflib.get_close_matches(name, names, n=1) if isinstance(name, str) else []
    hint = f"did you mean {shown(nearest[0])}? " if nearest else ""
    return f"{hint}known: {', '.join(names)}"
