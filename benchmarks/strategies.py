"""Strategies to compute perception: the library's own and others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from hash_grid import grid_fields
from torch import Tensor

from npa_envs import reference
from npa_envs.ops import perceive, perception_fields

NEIGHBOUR_CAP = 32
"""Neighbours, the particle included, that the capped strategy sums over."""

MAX_PAIRS = {
    "dense": {"cpu": 2**22, "cuda": 2**24},
    "neighbour_cap": {"cpu": 2**26, "cuda": 2**30},
}
"""Pairs B N² that quadratic strategies are given; one takes dense torch about a kilobyte."""

SEARCH_BLOCK = 1024
"""Particles whose distances to all others are in memory at a time."""


@dataclass(frozen=True)
class Strategy:
    """One way to compute the perception of all particles, with eps0 = eps in open space."""

    name: str
    """What the command line calls it."""
    perceive: Callable[[Tensor, Tensor, float], Tensor]
    """Takes x [B, N, D], s [B, N, C] and eps; returns z, shape [B, N, P]."""
    density: Callable[[Tensor, Tensor, float], Tensor]
    """Takes the same; returns rho, shape [B, N]."""
    differentiable: bool
    """Whether gradients flow from z to s."""
    capturable: bool
    """Whether a CUDA graph can record it."""

    def obstacle(self, x: Tensor) -> str | None:
        """Return why it cannot be measured on worlds like `x`; None if it can."""
        pairs = x.shape[0] * x.shape[1] ** 2
        if self.name == "plain" and not x.is_cuda:
            return "on a CPU the library runs these very kernels"
        if self.name == "plain" and x.dtype == torch.float64:
            return "in float64 the library runs these very kernels"
        if self.name in MAX_PAIRS and pairs > MAX_PAIRS[self.name][x.device.type]:
            return f"{pairs} pairs take too much memory or time"
        return None


def assemble(s: Tensor, blur: Tensor, gradient: Tensor, drho: Tensor) -> Tensor:
    """Return perception vectors from unscaled fields of `PerceptionFields` at eps0 = eps."""
    slopes = reference.log_scale(gradient).flatten(2)
    return torch.cat((s, blur, slopes, reference.log_scale(drho / s.shape[1])), dim=-1)


def corrected(gradient: Tensor, moment: Tensor) -> Tensor:
    """Return state gradients times M^-1 where the library inverts M; not differentiated."""
    with torch.no_grad():
        if moment.shape[-1] == 2:
            adjugate = reference.adjugate(moment)
        else:
            a, b, c = moment.unbind(dim=-2)
            pairs = ((b, c), (c, a), (a, b))
            adjugate = torch.stack([torch.linalg.cross(*pair) for pair in pairs], dim=-1)
        determinant = (moment[..., 0, :] * adjugate[..., :, 0]).sum(dim=-1)[..., None, None]
        inverted = gradient @ (adjugate / determinant)
        change = torch.where(
            determinant.abs() >= reference.MOMENT_THRESHOLD, inverted - gradient, 0.0
        )
    return gradient + change


def nearest(x: Tensor, count: int) -> Tensor:
    """Return the indices of the nearest particles of each, itself included, shape [B, N, K]."""
    found = []
    for block in torch.split(x.detach(), SEARCH_BLOCK, dim=1):
        distance = torch.cdist(block, x, compute_mode="donot_use_mm_for_euclid_dist")
        found.append(distance.topk(min(count, x.shape[1]), largest=False).indices)
    return torch.cat(found, dim=1)


def _taken(values: Tensor, index: Tensor) -> Tensor:
    """Return the values of each particle's neighbours: [B, N, ...] to [B, N, K, ...]."""
    world = torch.arange(len(values), device=values.device)[:, None, None]
    return values[world, index]


def capped_density(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return the density as a sum over the nearest neighbours only, shape [B, N]."""
    r = _taken(x, nearest(x, NEIGHBOUR_CAP)) - x[:, :, None]
    return reference.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[2]).sum(dim=2)


def capped_perceive(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return perception vectors as sums over the nearest neighbours only, shape [B, N, P]."""
    index = nearest(x, NEIGHBOUR_CAP)
    r = _taken(x, index) - x[:, :, None]
    weight = reference.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[2])
    kernel = reference.spiky_gradient(r, eps)
    volume = _taken(1.0 / weight.sum(dim=2), index)
    states = _taken(s, index)
    blur = torch.einsum("bik,bikc->bic", weight * volume, states)
    grad0 = torch.einsum("bik,bikc,bikd->bicd", volume, states - s[:, :, None], kernel)
    moment = torch.einsum("bik,bikd,bike->bide", volume, r, kernel)
    return assemble(s, blur, corrected(grad0, moment), kernel.sum(dim=2))


def from_fields(
    fields_of: Callable[[Tensor, Tensor, float], Any], x: Tensor, s: Tensor, eps: float
) -> Tensor:
    """Return perception vectors by way of a function's fields, shape [B, N, P]."""
    fields = fields_of(x, s, eps)
    return assemble(s, fields.blur, fields.grad1, fields.drho)


STRATEGIES = {
    strategy.name: strategy
    for strategy in (
        # Sorted cells, one fused pass; neighbours listed on CUDA.
        Strategy(
            "library",
            lambda x, s, eps: perceive(x, s, eps),
            lambda x, s, eps: perception_fields(x, s, eps).rho,
            differentiable=True,
            capturable=True,
        ),
        # The library's plain kernels: no neighbour lists, the scaling in torch.
        Strategy(
            "plain",
            lambda x, s, eps: from_fields(perception_fields, x, s, eps),
            lambda x, s, eps: perception_fields(x, s, eps).rho,
            differentiable=False,
            capturable=True,
        ),
        # Plain Warp kernels over the neighbours of wp.HashGrid; their adjoint by wp.Tape.
        Strategy(
            "hash_grid",
            lambda x, s, eps: from_fields(grid_fields, x, s, eps),
            lambda x, s, eps: grid_fields(x, s, eps).rho,
            differentiable=True,
            capturable=False,
        ),
        # Torch over all pairs of particles.
        Strategy(
            "dense",
            lambda x, s, eps: reference.perceive(x, s, eps, eps),
            lambda x, s, eps: reference.fields(x, s, eps).rho,
            differentiable=True,
            capturable=False,
        ),
        # Torch over the nearest particles only.
        Strategy(
            "neighbour_cap",
            capped_perceive,
            capped_density,
            differentiable=True,
            capturable=False,
        ),
    )
}
"""Every strategy by its name."""
