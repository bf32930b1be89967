"""Worlds in which the JavaScript engine of exported pages is compared with float64 Python."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from npa_envs import reference
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.world.rollout import rollout

TOLERANCE = 1e-4
"""Largest difference of a step from Python's in float64; the worst measured is 2e-6."""

Box = tuple[float, ...] | None


def packed(tensor: Tensor) -> str:
    return base64.b64encode(tensor.float().contiguous().numpy().tobytes()).decode()


def unpacked(text: str, shape: Sequence[int]) -> Tensor:
    return torch.frombuffer(bytearray(base64.b64decode(text)), dtype=torch.float32).view(*shape)


def described(rule: NPARule) -> dict[str, Any]:
    weights = {name: packed(tensor.detach()) for name, tensor in rule.state_dict().items()}
    return {**rule.hyper_parameters(), "weights": weights}


def scattered(count: int, dimension: int, channels: int, box: Box) -> tuple[Tensor, Tensor]:
    """A world of which each particle has a score of neighbours and a state of its own."""
    generator = torch.Generator().manual_seed(3)
    sides = torch.tensor(box or (0.5,) * dimension)
    x = sides * (torch.rand(1, count, dimension, generator=generator) - 0.5)
    return x, 0.5 * torch.randn(1, count, channels, generator=generator)


def grown(name: str, count: int, box: Box) -> tuple[Tensor, Tensor]:
    rule = load_rule(name)
    x, s = scattered(count, rule.space_dim, rule.state_dim, box)
    with torch.no_grad():
        return rollout(rule, x, 0.0 * s, 12, box=box, generator=torch.Generator().manual_seed(5))


def lively(rule: NPARule) -> NPARule:
    """The rule with weights that are large enough to see each of them."""
    torch.manual_seed(1)
    for parameter in rule.parameters():
        parameter.data.normal_(0.0, 0.3)
    return rule


def stepped(
    rule: NPARule, x: Tensor, s: Tensor, mask: Tensor, *, eps: float, box: Box
) -> tuple[Tensor, Tensor]:
    """One step in float64 by `npa_envs.reference`."""
    rule, x, s = rule.double(), x.double(), s.double()
    z = reference.perceive(x, s, eps, rule.eps0, box, moment_inverse=rule.moment_inverse)
    with torch.no_grad():
        update = rule(z)
    moved = torch.zeros_like(x)
    if not rule.static:
        moved, update = update.split([rule.space_dim, rule.state_dim], dim=-1)
        moved = rule.alpha * eps * moved / (1.0 + moved.norm(dim=-1, keepdim=True))
    x, s = x + mask[..., None] * moved, s + mask[..., None] * update
    if box is not None:
        sides = torch.tensor(box, dtype=x.dtype)
        x = x - sides * torch.floor(x / sides + 0.5)
    return x, s


WORLDS: dict[str, tuple[str | Callable[[], NPARule], int, Box, float]] = {
    "gecko": ("gecko", 300, None, 0.1),
    "gecko at another radius": ("gecko", 300, None, 0.13),
    "cells in their box": ("cells", 400, (1.1, 0.9), 0.2),
    "cells in the smallest box": ("cells", 200, (0.4, 0.4), 0.2),
    "duck": ("duck", 300, None, 0.126),
    "duck in a box": ("duck", 300, (0.5, 0.4, 0.3), 0.1),
    "digits, which stay": ("digits", 300, None, 0.1),
    "dead zone": (lambda: NPARule(2, 5, 9, dead_zone=0.2), 200, None, 0.1),
    "smooth inverse": (lambda: NPARule(2, 5, 9, moment_inverse="smooth"), 200, None, 0.1),
}


def world_of(kind: str) -> tuple[list[NPARule], Tensor, Tensor, float, Box]:
    """The rule, the positions, the states, the radius and the box of one of `WORLDS`."""
    source, count, box, eps = WORLDS[kind]
    if isinstance(source, str):
        rule = load_rule(source)
        if not rule.static:
            return [rule], *grown(source, count, box), eps, box
    else:
        rule = lively(source())
    return [rule], *scattered(count, rule.space_dim, rule.state_dim, box), eps, box
