"""Strategies to compute perception, the library's own and others, and precisions of a rollout."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from npa_envs import reference
from npa_envs.measure.speed.hash_grid import grid_fields
from npa_envs.ops import perceive, perception_fields
from npa_envs.ops.equivariance import invariants, steered
from npa_envs.rule.network import without_small
from npa_envs.rule.rule import NPARule

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
    """Return perception vectors from unscaled fields of `PerceptionFields` at eps0 = eps."""
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


def capped_density(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return the density that the nearest neighbours alone give, shape [B, N]."""
    r = _taken(x, nearest(x, NEIGHBOUR_CAP)) - x[:, :, None]
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
        # Two plain Warp kernels over the neighbours of wp.HashGrid.
        Strategy(
            "hash_grid",
            lambda x, s, eps: from_fields(grid_fields, x, s, eps),
            lambda x, s, eps: grid_fields(x, s, eps).rho,
            differentiable=False,
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


# Precisions: of the worlds' arithmetic, of the rule's products, of what is kept.


class TorchRule(NPARule):
    """A rule whose products torch takes, so that torch's switch for TF32 reaches them."""

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors, shape [..., P], to raw updates, shape [..., A]."""
        return super().forward(perception)


class MixedRule(NPARule):
    """A rule whose two products are taken in bfloat16, summed and returned in float32."""

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors, shape [..., P], to raw updates, shape [..., A]."""
        if not self.equivariant:
            return without_small(self._outputs(perception, self.update_weight), self.dead_zone)
        mixed, inputs = invariants(perception, self.mixing, self.vector_form)
        output = self._outputs(inputs, self.output.weight)
        return output if self.static else steered(output, mixed, self.steering, self.vector_form)

    def _outputs(self, inputs: Tensor, weight: Tensor) -> Tensor:
        short = torch.bfloat16
        hidden_weight, bias = self.hidden.weight.to(short), self.hidden.bias.to(short)
        hidden = torch.relu(functional.linear(inputs.to(short), hidden_weight, bias))
        return functional.linear(hidden, weight.to(short)).to(inputs.dtype)


@dataclass(frozen=True)
class Precision:
    """How numbers are kept and multiplied."""

    name: str
    """What the command line calls it."""
    summary: str
    """What it does, in a few words."""
    dtype: torch.dtype
    """Dtype of positions, states and sums over neighbours."""
    short_states: bool = False
    """States are rounded to bfloat16 after every step."""
    short_products: bool = False
    """The rule's products are taken in bfloat16."""
    tensor_float: bool = False
    """The rule's products are taken in TF32."""

    @property
    def reaches_perception(self) -> bool:
        """Whether perception itself differs from float32's, or is float32's."""
        return not (self.short_products or self.tensor_float)

    def obstacle(self, device: torch.device) -> str | None:
        """Return why it has nothing to measure on a device; None where it has."""
        if self.tensor_float and device.type != "cuda":
            return "TF32 products exist on CUDA devices only"
        return None

    def rule(self, rule: NPARule) -> NPARule:
        """Return a copy of a rule that computes in this precision."""
        kind = MixedRule if self.short_products else TorchRule if self.tensor_float else NPARule
        own = kind(**rule.hyper_parameters()).to(rule.hidden.weight)
        own.load_state_dict(rule.state_dict())
        return own.to(self.dtype)

    def kept(self, states: Tensor) -> Tensor:
        """Return states as they are kept from one step to the next, in their own dtype."""
        return states.to(torch.bfloat16).to(states.dtype) if self.short_states else states

    @contextlib.contextmanager
    def active(self) -> Iterator[None]:
        """Set torch's switch for TF32 while a block runs."""
        before = torch.backends.cuda.matmul.allow_tf32
        torch.backends.cuda.matmul.allow_tf32 = self.tensor_float
        try:
            yield
        finally:
            torch.backends.cuda.matmul.allow_tf32 = before


PRECISIONS = {
    precision.name: precision
    for precision in (
        Precision("float64", "everything in float64", torch.float64),
        Precision("float32", "everything in float32", torch.float32),
        Precision("tf32", "the rule's products in TF32", torch.float32, tensor_float=True),
        Precision(
            "bf16_storage", "states rounded to bfloat16 each step", torch.float32, short_states=True
        ),
        Precision("mixed", "the rule's products in bfloat16", torch.float32, short_products=True),
    )
}
"""Every precision by its name."""
