"""A check that a call raises `NPAError` with a certain message."""

from collections.abc import Callable
from typing import Any

import pytest

from npa_envs.errors import NPAError


def refused(message: str, call: Callable[..., Any], *given: Any, **named: Any) -> None:
    """Check that a call raises `NPAError` with words that match."""
    with pytest.raises(NPAError, match=message):
        call(*given, **named)
