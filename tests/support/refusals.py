"""Calls that raise `NPAError`, and a check of the message."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from npa_envs.errors import NPAError


def refused(message: str, call: Callable[..., Any], *given: Any, **named: Any) -> None:
    """Check that a call raises `NPAError` with words that match."""
    with pytest.raises(NPAError, match=message):
        call(*given, **named)


def calls(function: Callable[..., Any], *args: Any, **defaults: Any) -> Callable[..., Any]:
    """Return a function that makes calls of a function with some arguments, changed by keywords."""
    return lambda **options: lambda: function(*args, **defaults | options)


class Trap:
    """Unpickling it would leave a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)
