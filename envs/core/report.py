"""What a step says of each world besides the observation, and why episodes end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

SUCCESS, DIVERGED, TIME_LIMIT = 1, 2, 4
"""Bits of an ending: why an episode is over; none is set while it runs."""

FLAGS = ("success", "diverged")
"""Names of the first two endings in `info`."""


class Report(NamedTuple):
    """What a step says of each world, in one buffer: it is handed out by one copy, not twenty."""

    buffer: Tensor
    """All that follows, uint8."""
    numbers: Tensor
    """Reward; loss; its parts; their improvements in the last step; shape [2 + 2 K, B]."""
    endings: Tensor
    """Terminated; truncated; success; diverged; bool, shape [4, B]."""
    everyone: Tensor
    """True for every world, bool, shape [B]."""

    @classmethod
    def empty(cls, world_count: int, part_count: int, device: torch.device) -> Report:
        """Return the report of B worlds whose loss has K parts: zeros."""
        rows = 4 * (2 + 2 * part_count) + 3 + len(FLAGS)
        buffer = torch.zeros(rows * world_count, dtype=torch.uint8, device=device)
        report = cls.over(buffer, world_count)
        report.everyone.fill_(True)
        return report

    @classmethod
    def over(cls, buffer: Tensor, world_count: int) -> Report:
        """Return the report that a buffer holds."""
        flag_rows = 3 + len(FLAGS)
        rows = buffer.view(-1, world_count)
        numbers = buffer[: -flag_rows * world_count].view(torch.float32).view(-1, world_count)
        flags = rows[-flag_rows:].view(torch.bool)
        return cls(buffer, numbers, flags[:-1], flags[-1])

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Pickle the buffer alone: views that are pickled apart no longer share its memory."""
        return Report.over, (self.buffer, len(self.everyone))

    def copy(self) -> Report:
        """Return a copy that later steps leave alone."""
        return self.over(self.buffer.clone(), len(self.everyone))


def reason(ending: int) -> str | None:
    """Return why an episode ended, in words, or None where it has not."""
    words = {DIVERGED: "diverged", SUCCESS: "success", TIME_LIMIT: "time limit"}
    return next((word for bit, word in words.items() if ending & bit), None)
