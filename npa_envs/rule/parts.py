"""Rules taken apart: what every format of files is read into."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError, shown


@dataclass(frozen=True)
class RuleParts:
    """A rule taken apart: what `NPARule` is made with, and its weights by its own names."""

    hyper_parameters: dict[str, Any]
    weights: dict[str, Tensor]
    header: dict[str, str] | None = None
    """Metadata of a file in our format."""
    has_checksum: bool = False
    """Whether the file has one, by which damage of it is told."""


def check_precision(weights: Mapping[str, Tensor]) -> None:
    """Check that all weights are float32, or all float64.

    Args:
        weights: Weights by name.
    """
    dtypes = {tensor.dtype for tensor in weights.values()}
    if len(dtypes) != 1 or not dtypes <= {torch.float32, torch.float64}:
        raise NPAError(
            "the weights must be all float32 or all float64, got "
            f"{sorted(str(dtype) for dtype in dtypes)}: convert them, as rule.float() does, and "
            "save the rule again"
        )


def check_finite(weights: Mapping[str, Tensor]) -> None:
    """Check that every weight is finite.

    Args:
        weights: Weights by name.
    """
    for name, tensor in weights.items():
        bad = int((~torch.isfinite(tensor)).sum())
        if bad:
            raise NPAError(
                f"the weights must be finite, got {bad} of {tensor.numel()} numbers in "
                f"{shown(name)} NaN or infinite: take an earlier checkpoint, or train with a lower "
                "learning rate"
            )
