"""What happened in training: sums on the device until the log asks, and what diverged."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from npa_envs.errors import DivergedError, shown
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.training.iteration import EagerIteration

NONE_YET = -1
"""Marks that no loss was infinite or NaN so far."""


@dataclass(frozen=True)
class Interval:
    """What happened between two log lines."""

    means: dict[str, float]
    """The mean terms by name, the mean `steps`, and how many `replaced_worlds` there were."""

    bad_iteration: int | None
    """The first iteration of the run whose loss was not finite, or None."""


class LossMeter:
    """Sums of the loss terms, and a snapshot of the first iteration whose loss is not finite.

    `begin`, `observe` and `send` launch kernels and wait for nothing. `observe` can be captured
    in a CUDA graph: the same tensors are read and written in each iteration.
    """

    def __init__(self, iteration: EagerIteration) -> None:
        self._iteration = iteration
        device = iteration.terms.device
        # In one tensor, so that one copy brings all to the host. In float64, because a float32 sum
        # over a long interval would lose digits of the mean; whole numbers are exact in it.
        numbers = torch.zeros(len(iteration.terms) + 3, dtype=torch.float64, device=device)
        self._numbers = numbers
        self._sums, self._replaced, self._bad = numbers[:-3], numbers[-3], numbers[-2:]
        self._bad[0] = NONE_YET
        self._now = torch.zeros_like(self._bad)
        self._snapshot = {name: value.clone() for name, value in self._observed().items()}
        self._count = 0
        self._step_sum = 0
        on_cuda = device.type == "cuda"
        self._sent = torch.zeros(
            numbers.shape, dtype=numbers.dtype, device="cpu", pin_memory=on_cuda
        )
        self._sent_counts = (0, 0)
        self._arrival = torch.cuda.Event() if on_cuda else None  # type: ignore[no-untyped-call]

    def begin(self, number: int, steps: int) -> None:
        """Say which iteration is observed next."""
        self._now[0].fill_(number)
        self._now[1].fill_(steps)
        self._count += 1
        self._step_sum += steps

    def observe(self, replaced: Tensor) -> None:
        """Take note of an iteration, before the optimiser changes the parameters."""
        terms = self._iteration.terms
        self._sums += terms
        self._replaced += replaced.sum()
        # A comparison with NaN is false: one reduction finds both NaN and infinity.
        finite = torch.linalg.vector_norm(terms, math.inf) < math.inf
        first = ~finite & (self._bad[0] == NONE_YET)
        torch.where(first, self._now, self._bad, out=self._bad)
        for name, value in self._observed().items():
            torch.where(first, value, self._snapshot[name], out=self._snapshot[name])

    def send(self) -> None:
        """Let the interval's numbers go to the host, and start the next interval."""
        self._sent.copy_(self._numbers, non_blocking=True)
        if self._arrival is not None:
            self._arrival.record(torch.cuda.current_stream(self._numbers.device))
        self._sent_counts = self._count, self._step_sum
        self._numbers[:-2].zero_()
        self._count = 0
        self._step_sum = 0

    def receive(self) -> Interval:
        """Return what `send` sent last; waits for that, and not for what was launched since."""
        if self._arrival is not None:
            self._arrival.synchronize()
        count, step_sum = self._sent_counts
        count = max(count, 1)
        means = (self._sent[:-3] / count).tolist()
        replaced, bad_iteration, _ = map(int, self._sent[-3:].tolist())
        result = dict(zip(self._iteration.term_names, means, strict=True))
        result |= {"steps": step_sum / count, "replaced_worlds": replaced}
        return Interval(result, None if bad_iteration == NONE_YET else bad_iteration)

    def bad_iteration(self) -> int | None:
        """Return the first iteration whose loss was not finite, or None; waits for the device."""
        number = int(self._bad[0].item())
        return None if number == NONE_YET else number

    def snapshot(self) -> dict[str, Any]:
        """Return what the first iteration with a bad loss saw, on the CPU.

        Returns:
            `iteration`, `steps`, `terms` (by name), `x0`, `s0` (before the rollout), `x`, `s`
            (after it), `parameters` (one flat vector), and `goal` where the task has goals.
        """
        kept = {name: value.cpu() for name, value in self._snapshot.items()}
        terms = kept.pop("terms").tolist()
        iteration, steps = map(int, self._bad.tolist())
        return {
            "iteration": iteration,
            "steps": steps,
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
        (x0, s0, _, goal), (x, s, *_) = iteration.start, iteration.end
        seen = {"terms": iteration.terms, "x0": x0, "s0": s0, "x": x, "s": s}
        flat = torch.nn.utils.parameters_to_vector(iteration.parameters).detach()
        goals = {} if goal is None else {"goal": goal}
        return goals | seen | {"parameters": flat}


def divergence_error(
    task: Task, rule: NPARule, snapshot: dict[str, Any], diagnosis: Path
) -> DivergedError:
    """Return the error that ends a run whose loss is not finite."""
    terms = [name for name, value in snapshot["terms"].items() if not math.isfinite(value)]
    visible = [name for name in terms if name != "loss"] or terms
    worlds = bad_worlds(task, rule, snapshot)
    where = f"world{'s' * (len(worlds) > 1)} {', '.join(map(str, worlds))}" if worlds else "no one"
    return DivergedError(
        f"the loss must stay finite, but {' and '.join(visible)} was not in iteration "
        f"{snapshot['iteration']} ({snapshot['steps']} steps, {where} of the batch): lower "
        "learning_rate, or use fewer steps; the worlds and the rule are in "
        f"{shown(str(diagnosis))}, the last good checkpoint is untouched"
    )


def bad_worlds(task: Task, rule: NPARule, snapshot: dict[str, Any]) -> list[int]:
    """Return which worlds of the batch alone give a loss that is not finite."""
    rule = copy.deepcopy(rule).cpu()
    trained = [parameter for parameter in rule.parameters() if parameter.requires_grad]
    nn.utils.vector_to_parameters(snapshot["parameters"], trained)
    task = task.for_rule(rule)
    x, s, goal = snapshot["x"], snapshot["s"], snapshot.get("goal")
    found = []
    for world in range(len(x)):
        one = slice(world, world + 1)
        finite = bool(torch.isfinite(x[one]).all() and torch.isfinite(s[one]).all())
        if finite:
            with torch.no_grad():
                aimed = task.toward(None if goal is None else goal[one])
                total, parts = aimed.loss(x[one], s[one], torch.zeros_like(x[one][..., 0]))
            finite = all(bool(torch.isfinite(v).all()) for v in (total, *parts.values()))
        if not finite:
            found.append(world)
    return found
