"""Options of learners as dataclasses: each with its default, its meaning and its checks once."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from npa_envs.errors import NPAError, suggest

Result = TypeVar("Result")


def takes_fields_of(
    settings_type: type[Any],
) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Return a decorator: keyword arguments named as a dataclass's fields arrive as `settings`.

    The function that comes out has them in its signature, where `method_options` finds them.

    Args:
        settings_type: The dataclass, all of whose fields have defaults.

    Raises:
        NPAError: When the function is called: a name is unknown, or a value wrong.
    """
    own = {field.name: field.default for field in fields(settings_type)}

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        before = inspect.signature(function)
        kept = [p for name, p in before.parameters.items() if name != "settings"]
        added = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default)
            for name, default in own.items()
        ]

        @functools.wraps(function)
        def called(*positional: Any, **keywords: Any) -> Result:
            chosen = {name: keywords.pop(name) for name in own if name in keywords}
            for name in keywords.keys() - {p.name for p in kept}:
                raise NPAError(f"unknown option {name!r}: {suggest(name, own)}")
            return function(*positional, settings=settings_type(**chosen), **keywords)

        called.__signature__ = before.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        return called

    return decorate
