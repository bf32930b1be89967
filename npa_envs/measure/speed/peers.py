"""Other libraries on the same particles: density, interpolation and gradient, time and error.

A peer that is not installed, or breaks, is left out with the reason. Every time includes the search
for neighbours. Errors are against `npa_envs.reference` in float64.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from npa_envs import reference
from npa_envs.measure.speed.hash_grid import grid_fields
from npa_envs.measure.speed.timing import Session, Timing, relative_error
from npa_envs.measure.speed.workloads import Workload
from npa_envs.ops import perception_fields
from npa_envs.runtime import quiet_warp, start_warp

OPERATIONS = ("density", "interpolation", "gradient")
"""rho, smoothed states, and state gradients without correction."""

Fields = dict[str, Tensor]
"""Results of operations by their names: [N], [N, C], [N, C, D]."""


@dataclass(frozen=True)
class PeerRow:
    """One or all of `OPERATIONS` of one library on one world, search for neighbours included.

    The error is relative, the largest where several operations are one call.
    """

    peer: str
    operation: str
    space_dim: int
    particles: int
    time_us: Timing
    error: float


@dataclass(frozen=True)
class Call:
    """A call that computes some operations; `capturable` where a CUDA graph can hold it."""

    operation: str
    run: Callable[[], Fields]
    capturable: bool = False


def peer_rows(session: Session, workload: Workload) -> list[PeerRow]:
    """Return rows of every peer that is there, on the first world of a workload."""
    x, s = (tensor[0] for tensor in workload.worlds(session.device))
    exact = _reference_fields(x.double(), s.double(), workload.eps)
    rows: list[PeerRow] = []
    for name, make in PEERS.items():
        try:
            with quiet_warp():
                calls = make(x, s, workload.eps)
                rows += [_row(session, name, call, x, exact) for call in calls]
        except Exception as error:  # Whatever another library raises is a finding, not ours.
            session.leave_out(name, f"{type(error).__name__}: {error}")
        session.progress(1)
    return rows


def _row(session: Session, name: str, call: Call, x: Tensor, exact: Fields) -> PeerRow:
    errors = [relative_error(value, exact[field]) for field, value in call.run().items()]
    cost = session.cost(call.run, graph=call.capturable)
    return PeerRow(name, call.operation, x.shape[1], x.shape[0], cost.time, max(errors))


def _reference_fields(x: Tensor, s: Tensor, eps: float) -> Fields:
    return _named(reference.fields(x[None], s[None], eps))


def _named(fields: Any) -> Fields:
    return dict(zip(OPERATIONS, (fields.rho[0], fields.blur[0], fields.grad0[0]), strict=True))


def _library(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    run = partial(perception_fields, x[None], s[None], eps)
    return [Call("all", lambda: _named(run()), capturable=True)]


def _hash_grid(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    # Its gradient is corrected by the moment matrix, which the peers' is not.
    def run() -> Fields:
        fields = grid_fields(x[None], s[None], eps)
        return {"density": fields.rho[0], "interpolation": fields.blur[0]}

    return [Call("all", run)]


def _dense(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    return [Call("all", lambda: _reference_fields(x, s, eps))]


def _scipy(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    """Pairs from scipy's k-d tree, sums by torch's index_add; the search is on the CPU."""
    spatial = importlib.import_module("scipy.spatial")

    def pairs() -> tuple[Tensor, Tensor]:
        points = x.cpu().numpy()
        found = spatial.cKDTree(points).query_pairs(eps, output_type="ndarray")
        one, other = torch.from_numpy(found).to(x.device).unbind(dim=1)
        itself = torch.arange(len(x), device=x.device)
        return torch.cat((one, other, itself)), torch.cat((other, one, itself))

    def run() -> Fields:
        i, j = pairs()
        r = x[j] - x[i]
        weight = reference.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[1])
        rho = torch.zeros_like(x[:, 0]).index_add(0, i, weight)
        volume = 1.0 / rho[j]
        blur = torch.zeros_like(s).index_add(0, i, (volume * weight)[:, None] * s[j])
        kernel = volume[:, None] * reference.spiky_gradient(r, eps)
        slopes = (s[j] - s[i])[:, :, None] * kernel[:, None, :]
        gradient = s.new_zeros(*s.shape, x.shape[1]).index_add(0, i, slopes)
        return dict(zip(OPERATIONS, (rho, blur, gradient), strict=True))

    return [Call("all", run)]


def _warp_sph_core(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    """warpSPHCore (fluids.dev): one call for each operation, each with a search of its own."""
    start_warp()
    sph = importlib.import_module("warpSPHCore")
    space_dim = x.shape[1]
    open_space = torch.zeros(space_dim, dtype=torch.bool, device=x.device)
    domain = sph.DomainDescription(x.amin(0) - eps, x.amax(0) + eps, open_space, space_dim)
    radii, masses = torch.full_like(x[:, 0], eps), torch.ones_like(x[:, 0])
    kinds = torch.zeros(len(x), dtype=torch.int32, device=x.device)

    def call(operation: str, kernel: str, density: Tensor | None, **values: Tensor) -> Tensor:
        properties = sph.OperationProperties(
            kernel=sph.KernelFunctions[kernel],
            operation=sph.WarpOperation[operation],
            supportMode=sph.SupportScheme.Gather,
            operationMode=sph.OperationDirection.AllToAll,
            gradientMode=sph.GradientScheme.Difference,
        )
        particles = sph.ParticleState(x, radii, masses, kinds, density)
        result: Tensor = sph.warpOperation(particles, properties, domain, **values)
        return result

    def gradient() -> Tensor:
        found = call("Gradient", "Spiky", rho, **states)
        # Version 0.6.0 labels 3D gradients [N, C, D] and lays them out as [N, D, C].
        return found.reshape(len(x), space_dim, -1).mT if space_dim == 3 else found

    rho = call("Density", "Poly6", None)
    states = {"queryValues": s, "referenceValues": s}
    return [
        Call("density", lambda: {"density": call("Density", "Poly6", None)}),
        Call(
            "interpolation",
            lambda: {"interpolation": call("Interpolate", "Poly6", rho, **states)},
        ),
        Call("gradient", lambda: {"gradient": gradient()}),
    ]


PEERS = {
    "npa-envs": _library,
    "wp.HashGrid": _hash_grid,
    "dense torch": _dense,
    "scipy cKDTree + index_add": _scipy,
    "warpSPHCore": _warp_sph_core,
}
"""Every peer, and what makes its calls from x [N, D], s [N, C] and eps."""
