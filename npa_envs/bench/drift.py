"""How far float32 has drifted from float64 at the end of the paper's rollouts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from npa_envs.bench.perception import functional_weights
from npa_envs.bench.session import Session, relative_error
from npa_envs.bench.workloads import Workload
from npa_envs.dynamics import rollout


@dataclass(frozen=True)
class DriftRow:
    """Relative errors of float32 after all steps of a workload, with float64's update masks.

    Those of gradients come from few particles: where the input of a hidden unit is nearly 0, the
    unit is on in one precision and off in the other, and its gradient is there or is not.
    """

    workload: str
    positions: float
    """Of the positions."""
    states: float
    """Of the states."""
    state_gradient: float
    """Of the gradient of a random linear functional by the states at the start."""
    state_gradient_median: float
    """Median over the particles of the error of that gradient, each relative to its own."""
    weight_gradient: float
    """Of its gradient by the rule's weights."""


def drift_rows(session: Session, workloads: Iterable[Workload]) -> list[DriftRow]:
    """Return a row for each workload."""
    rows: list[DriftRow] = []
    for workload in workloads:
        what = f"drift of {workload.name}"
        rows += session.attempt(what, partial(_row, workload, session.device))
    return rows


def _row(workload: Workload, device: torch.device) -> DriftRow:
    found = _outcome(workload, device, torch.float32)
    exact = _outcome(workload, device, torch.float64)
    positions, states, by_states, by_weights = (
        relative_error(a, b) for a, b in zip(found, exact, strict=True)
    )
    distance = (found[2].double() - exact[2]).norm(dim=-1)
    median = float((distance / exact[2].norm(dim=-1)).median())
    return DriftRow(workload.name, positions, states, by_states, median, by_weights)


def _outcome(workload: Workload, device: torch.device, dtype: torch.dtype) -> list[Tensor]:
    """Return positions and states at the end, and gradients by states and by weights."""
    rule = workload.rule(device).to(dtype)
    start, states = (tensor.to(dtype) for tensor in workload.worlds(device))
    states.requires_grad_()
    x, s = rollout(
        rule,
        start,
        states,
        workload.steps,
        eps=workload.eps,
        update_prob=workload.update_prob,
        generator=torch.Generator(device).manual_seed(1),
        memory="recompute",
    )
    loss = (x * functional_weights(x)).sum() + (s * functional_weights(s)).sum()
    by_states, *by_weights = torch.autograd.grad(loss, [states, *rule.parameters()])
    weights = torch.cat([gradient.flatten() for gradient in by_weights])
    return [tensor.detach() for tensor in (x, s, by_states, weights)]
