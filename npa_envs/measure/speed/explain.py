"""Kernels of a step: time of each (suite `kernels`), reasons for their choice (`--explain`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.autograd import DeviceType  # type: ignore[attr-defined]
from torch.profiler import ProfilerActivity, profile

from npa_envs.measure.benchmark_records import aligned
from npa_envs.measure.speed.timing import TimingSession, Workload, rollout_call
from npa_envs.ops.backend import describe
from npa_envs.ops.launch import noted_launches
from npa_envs.ops.physics import make_physics
from npa_envs.ops.sort import plan_kernels
from npa_envs.rule.rule import NPARule
from npa_envs.world.rollout import step
from npa_envs.world.steps import row_capacity


@dataclass(frozen=True)
class KernelRow:
    """One kernel in a step of one workload: the time of all its launches [µs], and their number."""

    workload: str
    us: float
    launches: float
    kernel: str


def kernel_rows(session: TimingSession, workloads: Sequence[Workload]) -> list[KernelRow]:
    """Return rows of the kernels of inference and of training on CUDA, the slowest first.

    Kernels that take less than 0.5 % of a step have no row; on a CPU there are none.
    """
    if not session.cuda:
        session.left_out["kernels"] = "CUDA only"
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
            kernels = [
                KernelRow(
                    name,
                    round(entry.self_device_time_total / workload.steps, 2),
                    round(entry.count / workload.steps, 1),
                    entry.key[:72],
                )
                for entry in profiler.key_averages()
                if entry.device_type == DeviceType.CUDA
            ]
            kernels.sort(key=lambda row: -row.us)
            least = 0.005 * sum(row.us for row in kernels)
            rows += [row for row in kernels if row.us >= least]
            session.progress(1)
    return rows


Gradients = Literal["none", "weights", "positions"]
"""Which gradients a step computes: none, of weights and states, or also of positions."""


def explain(
    workload: Workload,
    device: torch.device,
    dtype: torch.dtype,
    *,
    periodic: bool = False,
    gradients: Gradients = "weights",
) -> str:
    """Run a step, in a box if `periodic`; return which kernels it launched, and why, as text."""
    box = 2.0 * workload.half_width if periodic else None
    x, s = (tensor.to(dtype) for tensor in workload.worlds(device))
    rule = workload.rule(device).to(dtype)
    needed = gradients != "none"
    x.requires_grad_(gradients == "positions")
    s.requires_grad_(needed)
    with torch.set_grad_enabled(needed), noted_launches() as forward:
        new_x, new_s = step(
            rule,
            x,
            s,
            eps=workload.eps,
            box=box,
            update_prob=workload.update_prob,
            detach_positions=gradients != "positions",
            generator=torch.Generator(device).manual_seed(0),
        )
    with noted_launches() as backward:
        if needed:
            torch.autograd.backward(new_x.sum() + new_s.sum())
    lines = _reasons(workload, x, rule, box, gradients)
    for name, launches in (("forward", forward), ("backward", backward)):
        if launches:
            lines += ["", f"{name}:", *(f"  {line}" for line in aligned(launches, left=True))]
    return "\n".join([*lines, "", "Torch's own operations are not listed."])


def _reasons(
    workload: Workload, x: Tensor, rule: NPARule, box: float | None, gradients: Gradients
) -> list[str]:
    prob, total, masked = workload.update_prob, x.shape[0] * x.shape[1], workload.update_prob < 1.0
    plan = plan_kernels(
        torch.empty(0, dtype=x.dtype, device=x.device),
        (workload.world_count, workload.particle_count, workload.space_dim),
        workload.state_dim,
        row_capacity(total, prob) if masked else total,
        masked,
        make_physics(workload.space_dim, workload.state_dim, x.dtype, eps=workload.eps, box=box),
    )
    hidden, output = rule.folded()[:2]
    request = plan.request._replace(
        row_width=hidden.shape[1],
        update_width=output.shape[0],
        hidden_dim=hidden.shape[0],
        rollout=gradients == "none",
        boundary="open" if box is None else "periodic",
        state_dim=workload.state_dim,
    )
    neighbours = "searched for in each pass"
    if plan.lists_neighbours:
        layout = plan.list_layout
        neighbours = (
            "listed by the density pass for the perception pass, "
            f"{layout.lanes} threads per particle, with room for {layout.capacity} each: "
            "longer lists are searched for again"
        )
    rows = "every particle is perceived and updated"
    if masked and x.device.type == "cpu":
        rows = f"p {prob:g}: the particles drawn are counted, only they are perceived"
    elif masked:
        rows = (
            f"p {prob:g}: only drawn particles are perceived; {plan.row_capacity} rows of {total} "
            "hold them with probability 1 - 1e-15, and no count is read back"
        )
    number = str(x.dtype).removeprefix("torch.")
    return [
        f"One step of {workload.world_count} x {workload.particle_count} particles in "
        f"{workload.space_dim}D, C {workload.state_dim}, {number} on {x.device}, "
        f"{'open space' if box is None else 'a periodic box'}, gradients: {gradients}",
        f"  cells       {plan.domain.cell_count} per world, eps / {plan.domain.cells_per_eps} "
        "wide: a neighbourhood is a few ranges of sorted particles",
        f"  channels    {plan.group_count} group(s) of {plan.width}, "
        f"{workload.state_dim} used: a kernel is compiled for a group's width",
        f"  neighbours  {neighbours}",
        f"  rows        {rows}",
        "",
        "implementations:",
        *(f"  {line}" for line in describe(request)),
    ]
