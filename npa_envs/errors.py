"""Errors of the public API: each names the argument, the rule, what came, and the cure."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class NPAError(ValueError):
    """A mistake in what the caller gave; the message says how to mend it."""


class DivergedError(NPAError):
    """Numbers became infinite or NaN; the message says when, which, and in which worlds."""


class MissingDependencyError(NPAError, ImportError):
    """An optional dependency is not installed; the message holds the command that installs it."""


def suggest(name: str, known: Iterable[str]) -> str:
    """Return the tail of an error about an unknown name: the nearest known one, then all of them.

    Args:
        name: What was asked for.
        known: Every name that would have been accepted.
    """
    names = sorted(known)
    nearest = difflib.get_close_matches(name, names, n=1) if isinstance(name, str) else []
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    return f"{hint}known: {', '.join(names)}"
