"""AdamW on normalised gradients, with a learning rate that is a function of the iteration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from npa_envs.tasks.train_config import TrainConfig

NORM_FLOOR = 1e-8
"""Added to a gradient's norm before it is divided by it: a zero gradient stays zero."""


def normalise_gradients(gradients: Sequence[Tensor]) -> None:
    """Divide each gradient by its own norm, in place; one that is not finite becomes 0.

    Args:
        gradients: One tensor for each parameter, any shape.
    """
    norms = torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients])
    # A norm is not finite where an entry is not.
    bad = ~(norms < math.inf)
    norms += NORM_FLOOR
    for gradient, norm, is_bad in zip(gradients, norms.unbind(), bad.unbind(), strict=True):
        gradient.div_(norm).masked_fill_(is_bad, 0.0)


def clear_non_finite(gradient: Tensor) -> None:
    """Set a gradient to 0 in place where any of its entries is not finite."""
    largest = torch.linalg.vector_norm(gradient, math.inf)
    gradient.masked_fill_(~(largest < math.inf), 0.0)


class RuleOptimiser:
    """AdamW for a rule's parameters; nothing in it waits for the device.

    Args:
        parameters: The rule's parameters; their `.grad` is set before `prepare_gradients`.
        config: Learning rates, weight decay, gradient normalisation.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], config: TrainConfig[Any]) -> None:
        self._parameters = list(parameters)
        self._config = config
        self._adamw = self._fresh()

    def prepare_gradients(self) -> None:
        """Normalise the gradients, where that is asked for; what is not finite becomes 0."""
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        if self._config.normalise_gradients:
            normalise_gradients(gradients)
        else:
            for gradient in gradients:
                clear_non_finite(gradient)

    def step(self, iteration: int) -> None:
        """Take one step along the prepared gradients; at the start of a repeat, with fresh moments.

        Args:
            iteration: Iterations done so far in the run.
        """
        if iteration > 0 and iteration % self._config.iterations == 0:
            self._adamw = self._fresh()
        for group in self._adamw.param_groups:
            group["lr"] = self._config.learning_rate_at(iteration)
        self._adamw.step()

    def state_dict(self) -> dict[str, Any]:
        """Return AdamW's moments and step counts, for a checkpoint."""
        return self._adamw.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` returned."""
        self._adamw.load_state_dict(state)

    def _fresh(self) -> torch.optim.AdamW:
        return torch.optim.AdamW(
            self._parameters,
            lr=self._config.learning_rate,
            weight_decay=self._config.weight_decay,
            # One kernel for all parameters; the CPU's own loop is as fast there.
            fused=self._parameters[0].is_cuda,
        )
