"""Running means and variances, in float64 and on the device of what they describe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from npa_envs.errors import NPAError, suggest

PRIOR_COUNT = 1e-4
"""Samples that the initial mean 0 and variance 1 count for, as in Gymnasium."""


class RunningMoments:
    """Mean and variance of everything seen so far, without waiting for the device.

    Args:
        shape: Shape of a sample.

    Attributes:
        mean: Float64, of the given shape.
        var: Float64, of the given shape.
        count: Samples seen, and a little more at the beginning.
    """

    def __init__(self, *shape: int) -> None:
        self.mean = torch.zeros(shape, dtype=torch.float64)
        self.var = torch.ones(shape, dtype=torch.float64)
        self.count = PRIOR_COUNT

    def update(self, mean: Tensor, var: Tensor, count: int) -> None:
        """Take in a batch of samples; from then on the moments are on its device.

        Args:
            mean: The batch's mean, of the shape of a sample.
            var: The batch's variance about it (divided by `count`, not by one less), likewise.
            count: Samples in the batch.
        """
        old_mean, old_var = self.mean.to(mean.device), self.var.to(mean.device)
        total = self.count + count
        delta = mean.double() - old_mean
        self.mean = old_mean + delta * (count / total)
        spread = old_var * self.count + var.double() * count
        self.var = (spread + delta.square() * (self.count * count / total)) / total
        self.count = total

    def state_dict(self) -> dict[str, Tensor]:
        """Return mean, variance and count, float64, on the CPU."""
        count = torch.tensor(self.count, dtype=torch.float64)
        return {"mean": self.mean.cpu().clone(), "var": self.var.cpu().clone(), "count": count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take over what `state_dict` returned.

        Args:
            state: Mean, variance and count.

        Raises:
            NPAError: A name is missing, unknown, or belongs to samples of another shape.
        """
        wanted = {"mean": self.mean.shape, "var": self.var.shape, "count": torch.Size()}
        for name in state.keys() ^ wanted.keys():
            fault = "unknown" if name in state else "missing"
            raise NPAError(f"{fault} statistic {name!r}: {suggest(name, wanted)}")
        given = {name: torch.as_tensor(state[name], dtype=torch.float64) for name in wanted}
        for name, shape in wanted.items():
            if given[name].shape != shape:
                raise NPAError(
                    f"{name} must have shape {tuple(shape)}, got {tuple(given[name].shape)}: "
                    "load the statistics of an environment with the same observations"
                )
        self.mean, self.var = given["mean"].clone(), given["var"].clone()
        self.count = float(given["count"])


def as_tensor(values: Any) -> Tensor:
    """Return an array or tensor as a tensor, without a copy."""
    return values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values))


def like(result: Tensor, values: Any) -> Any:
    """Return a tensor as what `values` is: an array or a tensor."""
    return result if isinstance(values, Tensor) else result.numpy()
