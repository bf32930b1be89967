"""Ways to compute perception: the library's own, and what it is measured against."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs import reference
from npa_envs.errors import NPAError, suggest
from npa_envs.measure.speed.hash_grid import grid_fields
from npa_envs.ops import perceive, perception_fields

NEIGHBOUR_CAP = 32
"""Neighbours, the particle included, that the capped strategy sums over."""

MOST_PAIRS = {
    "dense": {"cpu": 2**22, "cuda": 2**24},
    "neighbour_cap": {"cpu": 2**26, "cuda": 2**30},
}
"""Pairs B N² that quadratic strategies are given; one takes dense torch about a kilobyte."""

SEARCH_BLOCK = 1024
"""Particles whose distances to all others are held at a time."""


@dataclass(frozen=True)
class Strategy:
    """One way to compute what every particle perceives, at eps0 = eps in open space."""

    name: str
    """What the command line calls it."""
    summary: str
    """What it does, in a few words."""
    perceive: Callable[[Tensor, Tensor, float], Tensor]
    """Takes x [B, N, D], s [B, N, C] and eps; returns z, shape [B, N, P]."""
    density: Callable[[Tensor, Tensor, float], Tensor]
    """Takes the same; returns rho, shape [B, N]."""
    differentiable: bool
    """Whether gradients flow from z to s."""
    capturable: bool
    """Whether a CUDA graph can hold it."""

    def obstacle(self, x: Tensor) -> str | None:
        """Return why it has nothing to measure on worlds like `x`; None where it has."""
        pairs = x.shape[0] * x.shape[1] ** 2
        if self.name == "plain" and not x.is_cuda:
            return "on a CPU the library runs these very kernels"
        if self.name == "plain" and x.dtype == torch.float64:
            return "in float64 the library runs these very kernels"
        if self.name in MOST_PAIRS and pairs > MOST_PAIRS[self.name][x.device.type]:
            return f"{pairs} pairs take too much memory or time"
        return None


def assemble(s: Tensor, blur: Tensor, gradient: Tensor, drho: Tensor) -> Tensor:
    """Return perception vectors from unscaled fields at eps0 = eps.

    Args:
        s: States, dimensionless, shape [B, N, C].
        blur: Smoothed states, dimensionless, shape [B, N, C].
        gradient: State gradients [1 / length], shape [B, N, C, D].
        drho: Density gradients [1 / length^(D+1)], shape [B, N, D].
    """
    slopes = reference.log_scale(gradient).flatten(2)
    return torch.cat((s, blur, slopes, reference.log_scale(drho / s.shape[1])), dim=-1)


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


def capped_density(x: Tensor, s: Tensor, eps: float, index: Tensor | None = None) -> Tensor:
    """Return the density that the nearest neighbours alone give, shape [B, N]."""
    index = nearest(x, NEIGHBOUR_CAP) if index is None else index
    r = _taken(x, index) - x[:, :, None]
    return reference.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[2]).sum(dim=2)


def capped_perceive(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return perception vectors summed over the nearest neighbours alone, shape [B, N, P]."""
    index = nearest(x, NEIGHBOUR_CAP)
    r = _taken(x, index) - x[:, :, None]
    weight = reference.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[2])
    kernel = reference.spiky_gradient(r, eps)
    volume = _taken(1.0 / weight.sum(dim=2), index)
    states = _taken(s, index)
    blur = torch.einsum("bik,bikc->bic", weight * volume, states)
    grad0 = torch.einsum("bik,bikc,bikd->bicd", volume, states - s[:, :, None], kernel)
    moment = torch.einsum("bik,bikd,bike->bide", volume, r, kernel)
    invertible = torch.linalg.det(moment).abs() >= reference.MOMENT_THRESHOLD
    unit = torch.eye(x.shape[2], dtype=x.dtype, device=x.device).expand_as(moment)
    inverse = torch.linalg.inv(torch.where(invertible[..., None, None], moment, unit))
    gradient = grad0 + (grad0 @ inverse - grad0).detach()
    return assemble(s, blur, gradient, kernel.sum(dim=2))


def plain_perceive(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return perception vectors by way of the plain kernels' fields, shape [B, N, P]."""
    fields = perception_fields(x, s, eps)
    return assemble(s, fields.blur, fields.grad1, fields.drho)


def grid_perceive(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return perception vectors summed over a hash grid's neighbours, shape [B, N, P]."""
    fields = grid_fields(x, s, eps)
    return assemble(s, fields.blur, fields.grad1, fields.drho)


def dense_density(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return densities from all pairs, shape [B, N]."""
    r = reference.differences(x)
    return reference.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[2]).sum(dim=2)


STRATEGIES = {
    strategy.name: strategy
    for strategy in (
        Strategy(
            "library",
            "npa_envs.perceive: sorted cells, one fused pass; neighbours listed on CUDA",
            lambda x, s, eps: perceive(x, s, eps),
            lambda x, s, eps: perception_fields(x, s, eps).rho,
            differentiable=True,
            capturable=True,
        ),
        Strategy(
            "plain",
            "the library's plain kernels: no neighbour lists, the scaling in torch",
            plain_perceive,
            lambda x, s, eps: perception_fields(x, s, eps).rho,
            differentiable=False,
            capturable=True,
        ),
        Strategy(
            "hash_grid",
            "two plain Warp kernels over the neighbours of wp.HashGrid",
            grid_perceive,
            lambda x, s, eps: grid_fields(x, s, eps).rho,
            differentiable=False,
            capturable=False,
        ),
        Strategy(
            "dense",
            "torch over all pairs of particles (npa_envs.reference)",
            lambda x, s, eps: reference.perceive(x, s, eps, eps),
            dense_density,
            differentiable=True,
            capturable=False,
        ),
        Strategy(
            "neighbour_cap",
            f"torch over the {NEIGHBOUR_CAP} nearest particles only",
            capped_perceive,
            capped_density,
            differentiable=True,
            capturable=False,
        ),
    )
}
"""Every strategy by its name."""


def chosen_strategies(names: Sequence[str]) -> list[Strategy]:
    """Return the strategies of these names, all where there are none.

    Raises:
        NPAError: There is none of that name.
    """
    for name in names:
        if name not in STRATEGIES:
            raise NPAError(f"unknown strategy {name!r}: {suggest(name, STRATEGIES)}")
    return [STRATEGIES[name] for name in names or STRATEGIES]
