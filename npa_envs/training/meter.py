"""What happened on the device between two log lines, kept there until it is asked for."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.training.graphs import EagerIteration

NONE_YET = -1
"""Marks that no loss was infinite or NaN so far."""


class LossMeter:
    """Sums of the loss terms, and a snapshot of the first iteration whose loss is not finite.

    `observe` only launches kernels; `read` waits for the device.

    Args:
        iteration: The iteration's buffers.
    """

    def __init__(self, iteration: EagerIteration) -> None:
        self._iteration = iteration
        device = iteration.terms.device
        # float64: a float32 sum over a long interval would lose digits of the mean.
        self._sums = torch.zeros(len(iteration.terms), dtype=torch.float64, device=device)
        self._replaced = torch.zeros((), dtype=torch.int64, device=device)
        self._bad_iteration = torch.full((), NONE_YET, dtype=torch.int64, device=device)
        self._bad_steps = torch.zeros((), dtype=torch.int64, device=device)
        self._count = 0
        self._step_sum = 0
        self._snapshot = {name: value.clone() for name, value in self._observed().items()}

    def observe(self, number: int, steps: int, replaced: Tensor) -> None:
        """Take note of an iteration, before the optimiser changes the parameters.

        Args:
            number: The iteration's number, counted from 1.
            steps: Steps of its rollout, T.
            replaced: Which of its worlds left the pool, shape [B], bool.
        """
        self._sums += self._iteration.terms
        self._replaced += replaced.sum()
        self._count += 1
        self._step_sum += steps
        first = ~torch.isfinite(self._iteration.terms).all() & (self._bad_iteration == NONE_YET)
        self._bad_iteration.masked_fill_(first, number)
        self._bad_steps.masked_fill_(first, steps)
        for name, value in self._observed().items():
            torch.where(first, value, self._snapshot[name], out=self._snapshot[name])

    def bad_iteration(self) -> int | None:
        """Return the first iteration whose loss was not finite, or None; waits for the device."""
        number = int(self._bad_iteration.item())
        return None if number == NONE_YET else number

    def read(self) -> dict[str, float]:
        """Return the mean terms, mean steps and worlds replaced since `clear`; waits."""
        count = max(self._count, 1)
        means = (self._sums / count).tolist()
        result = dict(zip(self._iteration.term_names, means, strict=True))
        result["steps"] = self._step_sum / count
        result["replaced_worlds"] = int(self._replaced.item())
        return result

    def clear(self) -> None:
        """Start the next interval."""
        self._sums.zero_()
        self._replaced.zero_()
        self._count = 0
        self._step_sum = 0

    def snapshot(self) -> dict[str, Any]:
        """Return what the first iteration with a bad loss saw, on the CPU.

        Returns:
            `iteration`, `steps`, `terms` (by name), `x0`, `s0` (before the rollout), `x`, `s`
            (after it) and `parameters` (one flat vector).
        """
        kept = {name: value.cpu() for name, value in self._snapshot.items()}
        terms = kept.pop("terms").tolist()
        return {
            "iteration": int(self._bad_iteration.item()),
            "steps": int(self._bad_steps.item()),
            "terms": dict(zip(self._iteration.term_names, terms, strict=True)),
            **kept,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the open interval, for a checkpoint."""
        return {
            "sums": self._sums,
            "replaced": self._replaced,
            "count": self._count,
            "step_sum": self._step_sum,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on with the interval that `state_dict` returned."""
        self._sums.copy_(state["sums"])
        self._replaced.copy_(state["replaced"])
        self._count = state["count"]
        self._step_sum = state["step_sum"]

    def _observed(self) -> dict[str, Tensor]:
        iteration = self._iteration
        return {
            "terms": iteration.terms,
            "x0": iteration.x0,
            "s0": iteration.s0,
            "x": iteration.x,
            "s": iteration.s,
            "parameters": torch.nn.utils.parameters_to_vector(iteration.parameters).detach(),
        }
