"""Suite `kernels`: which CUDA kernels a step of a rollout takes, and how long each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch.autograd import DeviceType  # type: ignore[attr-defined]
from torch.profiler import ProfilerActivity, profile

from npa_envs.bench.session import Session
from npa_envs.bench.workloads import Workload, rollout_call

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
        x, s = workload.worlds(session.device)
        for train in (False, True):
            run, _ = rollout_call(workload, x, s, train=train)
            run()
            torch.cuda.synchronize(session.device)
            with profile(activities=[ProfilerActivity.CUDA]) as profiler:
                run()
                torch.cuda.synchronize(session.device)
            name = f"{workload.name} {'training' if train else 'inference'}"
            rows += _kernel_rows(name, profiler, workload.steps)
            session.progress(1)
    return rows


def _kernel_rows(workload: str, profiler: profile, steps: int) -> list[KernelRow]:
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
