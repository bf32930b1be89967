"""Float32 against float64 over whole rollouts: relative errors of worlds and of gradients.

python benchmarks/drift.py --device cuda
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import torch
from scripts import script_parser
from torch import Tensor

from npa_envs.checks import check_device
from npa_envs.measure.benchmark_records import table_text
from npa_envs.measure.speed.suites import PROFILED
from npa_envs.measure.speed.timing import TimingSession, Workload
from npa_envs.world.rollout import rollout


@dataclass(frozen=True)
class DriftRow:
    """Relative errors of float32 after all steps of a workload, with float64's update masks.

    Worlds are chaotic: after enough steps errors show how long worlds ran. Gradients are those of a
    random linear functional by the states at the start and the weights; their errors come from few
    particles, whose hidden units are on in one precision alone. `state_gradient_median` is the
    median over the particles, each relative to its own.
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
    positions, states, by_states, by_weights = map(relative_error, found, exact)
    distance = (found[2].double() - exact[2]).norm(dim=-1)
    median = float((distance / exact[2].norm(dim=-1)).median())
    return DriftRow(workload.name, positions, states, by_states, median, by_weights)


def _outcome(workload: Workload, session: TimingSession, dtype: torch.dtype) -> list[Tensor]:
    """Return positions and states at the end, and gradients by states and by weights."""
    device = session.device
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
    loss = (x * drawn_like(x)).sum() + (s * drawn_like(s)).sum()
    by_states, *by_weights = torch.autograd.grad(loss, [states, *rule.parameters()])
    weights = torch.cat([gradient.flatten() for gradient in by_weights])
    return [tensor.detach() for tensor in (x, s, by_states, weights)]


def drawn_like(like: Tensor) -> Tensor:
    """Return the weights of a random linear functional, the same numbers in every dtype."""
    generator = torch.Generator(like.device).manual_seed(2)
    return torch.randn(like.shape, generator=generator, device=like.device).to(like.dtype)


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Return |value - expected| / |expected| in the Euclidean norm, taken in float64."""
    exact = expected.detach().double()
    return float((value.detach().double() - exact).norm() / exact.norm())


def main() -> None:
    """Print the drift of the authors' workloads, on a CPU of one of them."""
    arguments = script_parser(__doc__).parse_args()
    torch.set_num_threads(arguments.threads)
    device = check_device(arguments.device)
    workloads = PROFILED if device.type == "cuda" else PROFILED[1:2]
    print(table_text(drift_rows(TimingSession(device=device), workloads)))


if __name__ == "__main__":
    main()
