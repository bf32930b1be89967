"""Suite `kernels`: which CUDA kernels a step of a rollout takes, and how long each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch.autograd import DeviceType  # type: ignore[attr-defined]
from torch.profiler import ProfilerActivity, profile

from npa_envs.bench.session import Session
from npa_envs.bench.workloads import Workload
from npa_envs.dynamics import rollout

LEAST_SHARE = 0.005
"""Kernels that take less of a step are left out."""

LONGEST_NAME = 72
"""Letters of a kernel's name."""


@dataclass(frozen=True)
class KernelRow:
    """One kernel in one workload."""

    workload: str
    """Dimension and (worlds B, particles N, steps T), and whether it trains."""
    us: float
    """Its time in a step, all launches together [µs]."""
    launches: float
    """Its launches in a step."""
    kernel: str
    """Its name."""


def kernel_rows(session: Session, workloads: Sequence[Workload]) -> list[KernelRow]:
    """Return the kernels of inference and of training; none on a CPU."""
    if not session.cuda:
        session.leave_out("kernels", "CUDA only")
        return []
    rows: list[KernelRow] = []
    for workload in workloads:
        for train in (False, True):
            run = _rollout(workload, session.device, train)
            run()
            torch.cuda.synchronize(session.device)
            with profile(activities=[ProfilerActivity.CUDA]) as profiler:
                run()
                torch.cuda.synchronize(session.device)
            name = f"{workload.name} {'training' if train else 'inference'}"
            rows += _rows(name, profiler, workload.steps)
            session.progress(1)
    return rows


def _rollout(workload: Workload, device: torch.device, train: bool) -> Callable[[], None]:
    rule, (x, s) = workload.rule(device), workload.worlds(device)
    generator = torch.Generator(device).manual_seed(1)

    def run() -> None:
        with torch.set_grad_enabled(train):
            new_x, new_s = rollout(
                rule,
                x,
                s,
                workload.steps,
                eps=workload.eps,
                update_prob=workload.update_prob,
                generator=generator,
            )
            if train:
                torch.autograd.grad(new_x.sum() + new_s.sum(), list(rule.parameters()))

    return run


def _rows(workload: str, profiler: profile, steps: int) -> list[KernelRow]:
    rows = [
        KernelRow(
            workload,
            round(entry.self_device_time_total / steps, 2),
            round(entry.count / steps, 1),
            entry.key[:LONGEST_NAME],
        )
        for entry in profiler.key_averages()
        if entry.device_type == DeviceType.CUDA
    ]
    rows.sort(key=lambda row: -row.us)
    least = LEAST_SHARE * sum(row.us for row in rows)
    return [row for row in rows if row.us >= least]
