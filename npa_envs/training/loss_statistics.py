"""Loss statistics between two log lines, and the report of a loss that is not finite."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from npa_envs.errors import DivergedError, shown
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.training.iteration import EagerIteration
from npa_envs.world.particles import Particles

NO_ITERATION = -1
"""Stands for the number of the first iteration with a bad loss, while all are finite."""


class LossStatistics:
    """Sums of the loss terms, and a snapshot of the first iteration whose loss is not finite.

    `begin`, `add` and `send` launch kernels and do not synchronise. `add` can be captured in a CUDA
    graph: it reads and writes the same tensors in each iteration.
    """

    def __init__(self, batch: EagerIteration) -> None:
        self._batch = batch
        device = batch.terms.device
        # One tensor, so that one copy transfers all of them; float64, in which long sums keep their
        # digits and integers are exact.
        totals = torch.zeros(len(batch.terms) + 3, dtype=torch.float64, device=device)
        self._totals = totals
        self._sums, self._replaced, self._bad = totals[:-3], totals[-3], totals[-2:]
        self._bad[0] = NO_ITERATION
        self._now = torch.zeros_like(self._bad)
        self._snapshot = {name: value.clone() for name, value in self._iteration_state().items()}
        self._count = 0
        self._step_sum = 0
        on_cuda = device.type == "cuda"
        self._sent = torch.zeros(totals.shape, dtype=totals.dtype, device="cpu", pin_memory=on_cuda)
        self._sent_counts = (0, 0)
        self._arrival = torch.cuda.Event() if on_cuda else None  # type: ignore[no-untyped-call]

    def begin(self, number: int, steps: int) -> None:
        """Set the number, from 1 on, and the steps of the iteration that `add` adds next."""
        self._now[0].fill_(number)
        self._now[1].fill_(steps)
        self._count += 1
        self._step_sum += steps

    def add(self, replaced: Tensor) -> None:
        """Add an iteration's loss terms and `replaced` worlds, before the optimiser's step."""
        terms = self._batch.terms
        self._sums += terms
        self._replaced += replaced.sum()
        # A comparison with NaN is false: one reduction finds both NaN and infinity.
        finite = torch.linalg.vector_norm(terms, math.inf) < math.inf
        first = ~finite & (self._bad[0] == NO_ITERATION)
        torch.where(first, self._now, self._bad, out=self._bad)
        for name, value in self._iteration_state().items():
            torch.where(first, value, self._snapshot[name], out=self._snapshot[name])

    def send(self) -> None:
        """Start to copy the sums since the last `send` to the CPU, and set them to 0."""
        self._sent.copy_(self._totals, non_blocking=True)
        if self._arrival is not None:
            self._arrival.record(torch.cuda.current_stream(self._totals.device))
        self._sent_counts = self._count, self._step_sum
        self._totals[:-2].zero_()
        self._count = 0
        self._step_sum = 0

    def receive(self) -> tuple[dict[str, float], bool]:
        """Return the statistics of the last `send`, and whether every loss of the run was finite.

        Statistics are mean loss terms by name, mean `steps`, and the number of `replaced_worlds`.
        Only the copy of `send` is waited for.
        """
        if self._arrival is not None:
            self._arrival.synchronize()
        count, step_sum = self._sent_counts
        count = max(count, 1)
        means = (self._sent[:-3] / count).tolist()
        replaced, bad_iteration, _ = map(int, self._sent[-3:].tolist())
        statistics = dict(zip(self._batch.term_names, means, strict=True))
        statistics |= {"steps": step_sum / count, "replaced_worlds": replaced}
        return statistics, bad_iteration == NO_ITERATION

    def all_finite(self) -> bool:
        """Return whether every loss of the run was finite; waits for the device."""
        return int(self._bad[0].item()) == NO_ITERATION

    def snapshot(self) -> dict[str, Any]:
        """Return the state of the first iteration whose loss was not finite, on the CPU.

        Its keys are `iteration`, `steps`, `terms` (by name), `x0`, `s0` (before the rollout), `x`,
        `s` (after it), `parameters` (one flat vector), and `goal` where the task has goals.
        """
        values = {name: value.cpu() for name, value in self._snapshot.items()}
        terms = values.pop("terms").tolist()
        iteration, steps = map(int, self._bad.tolist())
        return {
            "iteration": iteration,
            "steps": steps,
            "terms": dict(zip(self._batch.term_names, terms, strict=True)),
            **values,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the sums of losses and counts since the last `send`, for a checkpoint."""
        sums = self._totals[:-2]
        return {"sums": sums, "count": self._count, "step_sum": self._step_sum}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the sums since the last `send`, as `state_dict` returned them."""
        self._totals[:-2].copy_(state["sums"])
        self._count = state["count"]
        self._step_sum = state["step_sum"]

    def _iteration_state(self) -> dict[str, Tensor]:
        start, end = self._batch.start, self._batch.end
        goals = {} if start.goal is None else {"goal": start.goal}
        worlds = {"x0": start.x, "s0": start.s, "x": end.x, "s": end.s}
        flat = nn.utils.parameters_to_vector(self._batch.parameters).detach()
        return goals | {"terms": self._batch.terms} | worlds | {"parameters": flat}


def divergence_error(
    task: Task, rule: nn.Module, snapshot: dict[str, Any], diagnosis: Path
) -> DivergedError:
    """Return the error that ends a run whose loss is not finite; it names the file `diagnosis`."""
    terms = [name for name, value in snapshot["terms"].items() if not math.isfinite(value)]
    named_terms = [name for name in terms if name != "loss"] or terms
    worlds = diverged_worlds(task, rule, snapshot)
    where = f"world{'s' * (len(worlds) > 1)} {', '.join(map(str, worlds))}" if worlds else "no one"
    return DivergedError(
        f"the loss must stay finite, but {' and '.join(named_terms)} was not in iteration "
        f"{snapshot['iteration']} ({snapshot['steps']} steps, {where} of the batch): lower "
        "learning_rate, or use fewer steps; the worlds and the rule are in "
        f"{shown(str(diagnosis))}, the last good checkpoint is untouched"
    )


@torch.no_grad()
def diverged_worlds(task: Task, rule: nn.Module, snapshot: dict[str, Any]) -> list[int]:
    """Return the indices of the snapshot's worlds for which the loss of a world is not finite."""
    rule = copy.deepcopy(rule).cpu()
    trained = [parameter for parameter in rule.parameters() if parameter.requires_grad]
    nn.utils.vector_to_parameters(snapshot["parameters"], trained)
    if isinstance(rule, NPARule):
        task = task.for_rule(rule)
    worlds = Particles(snapshot["x"], snapshot["s"], goal=snapshot.get("goal"))
    diverged = []
    for index in range(len(worlds.x)):
        world = worlds.take(torch.tensor([index]))
        values = list(world.tensors())
        if all(bool(value.isfinite().all()) for value in values):
            total, parts = task.with_goal(world.goal).loss(world.with_zero_paths())
            values = [total, *parts.values()]
        if not all(bool(value.isfinite().all()) for value in values):
            diverged.append(index)
    return diverged
