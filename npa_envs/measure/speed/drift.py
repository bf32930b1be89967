"""How far float32 has drifted from float64 at the end of the paper's rollouts.

Worlds are chaotic: two that differ in the last bit drift apart, and after enough steps distances
say how long they have run, not how well each was computed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from npa_envs.measure.speed.timing import TimingSession, relative_error
from npa_envs.measure.speed.workloads import Workload
from npa_envs.world.rollout import rollout


@dataclass(frozen=True)
class DriftRow:
    """Relative errors of float32 after all steps of a workload, with float64's update masks.

    Gradients are those of a random linear functional by the states at the start and the weights.
    Their errors come from few particles: where the input of a hidden unit is nearly 0, the unit is
    on in one precision and off in the other, and its gradient is there or is not.
    `state_gradient_median` is the median over the particles, each relative to its own.
    """

    workload: str
    positions: float
    states: float
    state_gradient: float
    state_gradient_median: float
    weight_gradient: float


def drift_rows(session: TimingSession, workloads: Iterable[Workload]) -> list[DriftRow]:
    """Return a row for each workload."""
    rows: list[DriftRow] = []
    for workload in workloads:
        what = f"drift of {workload.name}"
        for exact in session.attempt(what, partial(_outcome, workload, session, torch.float64)):
            rows += session.attempt(what, partial(_drift_row, workload, session, exact))
    return rows


def _drift_row(workload: Workload, session: TimingSession, exact: list[Tensor]) -> DriftRow:
    found = _outcome(workload, session, torch.float32)
    positions, states, by_states, by_weights = (
        relative_error(a, b) for a, b in zip(found, exact, strict=True)
    )
    distance = (found[2].double() - exact[2]).norm(dim=-1)
    median = float((distance / exact[2].norm(dim=-1)).median())
    return DriftRow(workload.name, positions, states, by_states, median, by_weights)


def _outcome(workload: Workload, session: TimingSession, dtype: torch.dtype) -> list[Tensor]:
    """Return positions and states at the end, and gradients by states and by weights."""
    device = session.device
    rule = workload.rule(device).to(dtype)
    start, states = (tensor.to(dtype) for tensor in workload.worlds(device))
    states.requires_grad_()
    generator = torch.Generator(device).manual_seed(1)
    x, s = rollout(
        rule,
        start,
        states,
        workload.steps,
        eps=workload.eps,
        update_prob=workload.update_prob,
        generator=generator,
        memory="recompute",
    )
    loss = (x * drawn_like(x)).sum() + (s * drawn_like(s)).sum()
    by_states, *by_weights = torch.autograd.grad(loss, [states, *rule.parameters()])
    weights = torch.cat([gradient.flatten() for gradient in by_weights])
    return [tensor.detach() for tensor in (x, s, by_states, weights)]


def drawn_like(like: Tensor) -> Tensor:
    """Return the weights of a random linear functional, the same numbers in every dtype."""
    generator = torch.Generator(like.device).manual_seed(2)
    return torch.randn(like.shape, generator=generator, device=like.device).to(like.dtype)
