"""Worlds in which the JavaScript engine of exported pages is compared with float64 Python."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.world.rollout import rollout
from npa_envs.world.species import rollout_species

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
    "no correction": (lambda: NPARule(2, 6, 5, moment_correction=False), 200, None, 0.1),
    "no slopes of states": (lambda: NPARule(2, 6, 5, state_gradient=False), 200, None, 0.1),
    "no slope of density": (lambda: NPARule(2, 6, 5, density_gradient=False), 200, None, 0.1),
}


SPECIES: dict[str, Sequence[int] | None] = {
    "two species": None,
    "two species, each divided by its own number": (200, 100),
}
"""Worlds of a gecko and another rule: the numbers by which densities are divided."""


class Example(NamedTuple):
    """A step for engines of pages."""

    fields: dict[str, Any]
    """Arguments of `step` in run_engine.mjs, as JSON."""
    s: Tensor
    """States before the step."""
    mask: Tensor
    """1 where a particle is updated, shape [1, N]."""
    after: tuple[Tensor, Tensor]
    """Positions and states after the step by Python in float64."""


def example(kind: str) -> Example:
    """Return a step of one of `WORLDS` or `SPECIES`."""
    source, count, box, eps = WORLDS.get(kind, WORLDS["gecko"])
    rule = load_rule(source) if isinstance(source, str) else lively(source())
    if isinstance(source, str) and not rule.static:
        x, s = grown(source, count, box)
    else:
        x, s = scattered(count, rule.space_dim, rule.state_dim, box)
    rules, species, density_counts = [rule], [0] * count, None
    mask = (torch.rand(1, count, generator=torch.Generator().manual_seed(9)) < 0.5).double()
    if kind in SPECIES:
        rules.append(lively(NPARule(2, 16, 24, alpha=0.3)))
        density_counts, species = SPECIES[kind], [0] * 200 + [1] * 100
        mask = torch.ones(1, count)
    fields = {
        "rules": [described(rule) for rule in rules], "x": packed(x), "s": packed(s),
        "species": species, "mask": mask[0].int().tolist(), "eps": eps, "box": box,
        "densityCounts": density_counts,
    }  # fmt: skip
    exact = [rule.double() for rule in rules]
    run = partial(rollout_species, exact, counts=(200, 100), density_counts=density_counts)
    if kind not in SPECIES:
        run = partial(rollout, exact[0])
    with torch.no_grad():
        stepped = run(x=x.double(), s=s.double(), steps=1, eps=eps, box=box, update_prob=1.0)
    before, updated = (x.double(), s.double()), mask[..., None] == 1
    after = tuple(torch.where(updated, *pair) for pair in zip(stepped, before, strict=True))
    return Example(fields, s, mask, after)
