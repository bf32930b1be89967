"""How far float32 has drifted from float64 at the end of the paper's rollouts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from npa_envs.measure.speed.perception import functional_weights
from npa_envs.measure.speed.rollouts import composed_step, drawn_mask
from npa_envs.measure.speed.session import Session, relative_error
from npa_envs.measure.speed.strategies import STRATEGIES, Strategy
from npa_envs.measure.speed.workloads import Workload
from npa_envs.world.rollout import rollout

PEER = STRATEGIES["dense"]
"""What any float32 errs by: no approximation, one torch operator after the other."""


@dataclass(frozen=True)
class DriftRow:
    """Relative errors of float32 after all steps of a workload, with float64's update masks.

    Those of gradients come from few particles: where the input of a hidden unit is nearly 0, the
    unit is on in one precision and off in the other, and its gradient is there or is not.
    """

    workload: str
    strategy: str
    """`library`, or `dense` where all pairs of its particles fit."""
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
    """Return a row for each workload, and one of dense torch where it can be."""
    rows: list[DriftRow] = []
    for workload in workloads:
        what = f"drift of {workload.name}"
        for exact in session.attempt(what, partial(_outcome, workload, session, torch.float64)):
            rows += session.attempt(what, partial(_row, workload, session, exact))
            why = PEER.obstacle(workload.worlds(session.device)[0])
            if session.small or why is not None:
                session.leave_out(f"{what}, dense", why or "its steps take too long")
            else:
                rows += session.attempt(what, partial(_row, workload, session, exact, PEER))
    return rows


def _row(
    workload: Workload, session: Session, exact: list[Tensor], peer: Strategy | None = None
) -> DriftRow:
    found = _outcome(workload, session, torch.float32, peer)
    positions, states, by_states, by_weights = (
        relative_error(a, b) for a, b in zip(found, exact, strict=True)
    )
    distance = (found[2].double() - exact[2]).norm(dim=-1)
    median = float((distance / exact[2].norm(dim=-1)).median())
    name = "library" if peer is None else peer.name
    return DriftRow(workload.name, name, positions, states, by_states, median, by_weights)


def _outcome(
    workload: Workload, session: Session, dtype: torch.dtype, peer: Strategy | None = None
) -> list[Tensor]:
    """Return positions and states at the end, and gradients by states and by weights."""
    device = session.device
    rule = workload.rule(device).to(dtype)
    start, states = (tensor.to(dtype) for tensor in workload.worlds(device))
    states.requires_grad_()
    generator = torch.Generator(device).manual_seed(1)
    if peer is None:
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
    else:
        x, s = start, states
        for _ in range(workload.steps):
            mask = drawn_mask(x, workload.update_prob, generator)
            x, s = checkpoint(composed_step, peer, rule, x, s, mask, use_reentrant=False)
    loss = (x * functional_weights(x)).sum() + (s * functional_weights(s)).sum()
    by_states, *by_weights = torch.autograd.grad(loss, [states, *rule.parameters()])
    weights = torch.cat([gradient.flatten() for gradient in by_weights])
    return [tensor.detach() for tensor in (x, s, by_states, weights)]
