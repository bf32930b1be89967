"""Weights of rules as one vector, for searches without gradients."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from npa_envs.errors import NPAError
from npa_envs.rule.network import without_small
from npa_envs.rule.rule import NPARule

MOST_HIDDEN = 2**27
"""Numbers of hidden layers that are held at once, at most: 512 MiB of float32."""


class RuleWeights:
    """Plain rules, changed in place, whose weights are one vector: W1, b1, W2, rule after rule.

    Read-outs are not changed.
    """

    def __init__(self, rules: Iterable[NPARule]) -> None:
        self._each = list(rules)
        self._parts = [part for rule in self._each for part in layers_of(rule)]
        for rule in self._each:
            if not rule.is_plain():
                raise NPAError(
                    "rules must be plain NPARules, whose networks are their two layers, got one "
                    "that overrides its network: evolve it by its own code"
                )

    def vector(self) -> NDArray[np.float64]:
        """Return the weights of the rules as they are, shape [W]."""
        with torch.no_grad():
            return nn.utils.parameters_to_vector(self._parts).double().cpu().numpy()

    def put(self, vector: NDArray[np.float64]) -> None:
        """Give the rules these weights, shape [W]."""
        first = self._parts[0]
        with torch.no_grad():
            nn.utils.vector_to_parameters(
                torch.as_tensor(vector, dtype=first.dtype, device=first.device), self._parts
            )

    def scales(self) -> NDArray[np.float64]:
        """Return the standard deviation of each weight by Xavier at a gain of 1; biases as W1."""
        sizes = []
        for rule in self._each:
            hidden, bias, output = layers_of(rule)
            first = math.sqrt(2.0 / sum(hidden.shape))
            sizes += [np.full(hidden.numel() + bias.numel(), first)]
            sizes += [np.full(output.numel(), math.sqrt(2.0 / sum(output.shape)))]
        return np.concatenate(sizes)


def layers_of(rule: NPARule) -> tuple[Tensor, Tensor, Tensor]:
    """Return W1 [H, P], b1 [H] and W2 [A, H]."""
    return rule.hidden.weight, rule.hidden.bias, rule.output.weight


def updates_of(rule: NPARule, weights: Tensor, rows: Tensor) -> Tensor:
    """Return raw updates, [K, R, A], of K candidates' weights for their own rows, [K, R, P]."""
    shapes = [tuple(part.shape) for part in layers_of(rule)]
    sizes = [math.prod(shape) for shape in shapes]
    first, bias, second = (
        part.reshape(-1, *shape)
        for part, shape in zip(torch.split(weights, sizes, dim=1), shapes, strict=True)
    )
    at_once = max(1, MOST_HIDDEN // (rows.shape[1] * rule.hidden_dim))
    updates = []
    for k in range(0, len(weights), at_once):
        some = slice(k, k + at_once)
        hidden = torch.baddbmm(bias[some, None], rows[some], first[some].mT).relu_()
        updates.append(torch.bmm(hidden, second[some].mT))
    return without_small(torch.cat(updates), rule.dead_zone)
