"""One perception of every particle: run time against error, by strategy and precision.

Errors are against the library in float64 on the same device; `dense` in float64 is an independent
implementation and shows how far that can be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from npa_envs.measure.speed.session import Session, relative_error
from npa_envs.measure.speed.strategies import STRATEGIES, Strategy
from npa_envs.measure.speed.timing import Timing
from npa_envs.measure.speed.workloads import Workload


@dataclass(frozen=True)
class PerceptionRow:
    """One perception of every particle; errors are relative, in the Euclidean norm."""

    strategy: str
    precision: str
    space_dim: int
    worlds: int
    particles: int
    forward_us: Timing
    """Time of the perception [µs]."""
    gradient_us: Timing | None
    """Time of the perception and the gradient of a functional of it [µs]."""
    peak_mib: float | None
    """Peak memory of the perception, and of its gradient where there is one [MiB]."""
    density: float
    """Error of the density."""
    smoothed: float
    """Error of the smoothed states."""
    state_gradient: float
    """Error of the state gradient as it is perceived, on a logarithmic scale."""
    density_gradient: float
    """Error of the density gradient as it is perceived, on a logarithmic scale."""
    perception: float
    """Error of the perception vectors z."""
    cotangent: float | None
    """Error of the gradient of a random linear functional of z by the states."""


@dataclass(frozen=True)
class Perceived:
    """What a strategy makes of worlds."""

    density: Tensor
    """Densities [1 / length^D], shape [B, N]."""
    perception: Tensor
    """Perception vectors z, dimensionless, shape [B, N, P]."""
    cotangent: Tensor | None
    """Gradient of a random linear functional of z by the states, shape [B, N, C]."""


def perception_rows(session: Session, workload: Workload) -> list[PerceptionRow]:
    """Return a row for each strategy and for each precision that perception knows of."""
    x, s = workload.worlds(session.device)
    exact = perceived(STRATEGIES["library"], x.double(), s.double(), workload.eps)
    rows: list[PerceptionRow] = []
    for precision in session.usable_precisions():
        if not precision.reaches_perception:
            session.leave_out(f"perception in {precision.name}", "only the rule's products differ")
            continue
        places, states = x.to(precision.dtype), precision.kept(s.to(precision.dtype))
        for strategy in session.usable_strategies(places):
            name = precision.name
            rows += session.attempt(
                f"{strategy.name} in {name}, {workload.name}",
                partial(_row, session, workload, strategy, name, places, states, exact=exact),
            )
    return rows


def perceived(strategy: Strategy, x: Tensor, s: Tensor, eps: float) -> Perceived:
    """Return what a strategy makes of worlds x [B, N, D] and s [B, N, C]."""
    z = strategy.perceive(x, s, eps)
    cotangent = None
    if strategy.differentiable:
        cotangent = _cotangent(strategy, x, s, eps, functional_weights(z))
    return Perceived(strategy.density(x, s, eps), z, cotangent)


def functional_weights(like: Tensor) -> Tensor:
    """Return the weights of a random linear functional, the same numbers in every dtype."""
    generator = torch.Generator(like.device).manual_seed(2)
    return torch.randn(like.shape, generator=generator, device=like.device).to(like.dtype)


def _cotangent(strategy: Strategy, x: Tensor, s: Tensor, eps: float, weights: Tensor) -> Tensor:
    states = s.detach().requires_grad_()
    loss = (strategy.perceive(x, states, eps) * weights).sum()
    return torch.autograd.grad(loss, states)[0]


def _row(
    session: Session,
    workload: Workload,
    strategy: Strategy,
    precision: str,
    x: Tensor,
    s: Tensor,
    *,
    exact: Perceived,
) -> PerceptionRow:
    eps = workload.eps
    found = perceived(strategy, x, s, eps)
    graph = strategy.capturable
    costs = [session.cost(lambda: strategy.perceive(x, s, eps), graph=graph)]
    if strategy.differentiable:
        weights = functional_weights(found.perception)
        costs.append(session.cost(lambda: _cotangent(strategy, x, s, eps, weights), graph=graph))
    peaks = [cost.peak_mib for cost in costs if cost.peak_mib is not None]
    _, smoothed, state_gradient, density_gradient = group_errors(
        found.perception, exact.perception, workload.space_dim, workload.state_dim
    )
    return PerceptionRow(
        strategy=strategy.name,
        precision=precision,
        space_dim=workload.space_dim,
        worlds=workload.world_count,
        particles=workload.particle_count,
        forward_us=costs[0].time,
        gradient_us=costs[1].time if strategy.differentiable else None,
        peak_mib=max(peaks, default=None),
        density=relative_error(found.density, exact.density),
        smoothed=smoothed,
        state_gradient=state_gradient,
        density_gradient=density_gradient,
        perception=relative_error(found.perception, exact.perception),
        cotangent=None
        if found.cotangent is None or exact.cotangent is None
        else relative_error(found.cotangent, exact.cotangent),
    )


def group_errors(z: Tensor, exact: Tensor, space_dim: int, state_dim: int) -> list[float]:
    """Return the relative errors of the four groups of perception vectors, [B, N, P].

    They are states, smoothed states, state gradients and the density gradient.
    """
    widths = [state_dim, state_dim, state_dim * space_dim, space_dim]
    pairs = zip(torch.split(z, widths, -1), torch.split(exact, widths, -1), strict=True)
    return [relative_error(group, expected) for group, expected in pairs]
