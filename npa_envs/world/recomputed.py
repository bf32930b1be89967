"""Recomputed steps: what they read must be, at the backward pass, what it was at the forward pass.

Steps that the backward pass runs again read the rule and the first worlds where they are. Gradients
would be wrong without a word if these had changed meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.rule.rule import NPARule


class RecomputedSteps:
    """Steps of a rollout that its backward pass runs again.

    Args:
        advance: Returns the worlds after one step.
        rules: The rules that it runs.
        worlds: The worlds at the beginning, by name.
    """

    def __init__(
        self, advance: Callable[..., Any], rules: Sequence[NPARule], worlds: dict[str, Tensor]
    ) -> None:
        self._advance = advance
        self._worlds = worlds
        # Plain rules are run by copies of their weights, except for those of the fates.
        self._rules = [(rule, rule.divides or not rule.is_plain()) for rule in rules]
        self._read: dict[str, Any] | None = None
        """What has been read, by name, from the end of the forward pass on."""

    def __call__(self, *arguments: Any) -> Any:
        """Run one step, forward or again.

        Raises:
            NPAError: It is run again, and what it reads has changed.
        """
        if self._read is None:
            return self._advance(*arguments)
        self._check(self._read)
        try:
            return self._advance(*arguments)
        finally:
            # A module may change its own buffers, as those of normalisation.
            self.end_forward()

    def end_forward(self) -> None:
        """Note what has been read."""
        self._read = dict(self._readings())

    def _check(self, before: dict[str, Any]) -> None:
        for name, value in self._readings():
            if name not in before or before[name] != value:
                raise NPAError(
                    f"{name} must stay as it is between a rollout that recomputes steps and its "
                    "backward pass, got another: call backward() before it changes, or take "
                    "memory='store'"
                )

    def _readings(self) -> Iterator[tuple[str, Any]]:
        """Yield what steps read, by name, as something that can be compared."""
        for name, world in self._worlds.items():
            yield name, _Reading(world)
        for number, (rule, with_weights) in enumerate(self._rules):
            of_rule = "the rule" if len(self._rules) == 1 else f"rule {number}"
            for name, value in rule.hyper_parameters().items():
                yield f"{name} of {of_rule}", value
            for path, module in rule.named_modules() if with_weights else ():
                place = f"{path}." if path else ""
                own = {**vars(module), **module._parameters, **module._buffers}
                for name, value in own.items():
                    if isinstance(value, Tensor):
                        yield f"{place}{name} of {of_rule}", _Reading(value)
                    elif isinstance(value, bool | int | float | str):
                        yield f"{place}{name} of {of_rule}", value


class _Reading:
    """A tensor as it was read: equal to another reading if nothing was written in between."""

    def __init__(self, tensor: Tensor) -> None:
        # Held, so that no other tensor gets the same memory.
        self._held = tensor.detach()
        self._where = tensor.data_ptr()
        self._version = None if tensor.is_inference() else tensor._version

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, _Reading)
            and self._where == other._where
            and self._version == other._version
        )

    __hash__ = None  # type: ignore[assignment]
