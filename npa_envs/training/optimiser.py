"""From gradients to new weights: normalised gradients, AdamW, the running mean of the weights."""

from __future__ import annotations

import copy
import itertools
import math
import operator
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from npa_envs.rule.rule import NPARule
from npa_envs.tasks.train_config import TrainConfig

NORM_FLOOR = 1e-8
"""Added to a gradient's norm before it is divided by it: a zero gradient stays zero."""


def normalise_gradients(gradients: Sequence[Tensor]) -> None:
    """Divide each gradient by its own norm, in place; one that is not finite becomes 0."""
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
    """AdamW on prepared gradients, with a learning rate that is a function of the iteration.

    Args:
        parameters: The rule's parameters; their `.grad` is set before `prepare_gradients`.
        config: Learning rates, weight decay, gradient normalisation.
        fates: Which of `parameters` learn at the share `fate_rate` of the learning rate.
    """

    def __init__(
        self,
        parameters: Sequence[nn.Parameter],
        config: TrainConfig[Any],
        fates: Sequence[nn.Parameter] = (),
    ) -> None:
        self._parameters = list(parameters)
        self._config = config
        slow = set(map(id, fates))
        self._shares = [config.fate_rate if id(p) in slow else 1.0 for p in self._parameters]
        self._adamw = self._fresh()

    def prepare_gradients(self) -> None:
        """Normalise the gradients, where that is asked for; what is not finite becomes 0."""
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        if self._config.normalise_gradients:
            normalise_gradients(gradients)
            return
        for gradient in gradients:
            clear_non_finite(gradient)

    def step(self, iteration: int, share: float = 0.0) -> None:
        """Take a step along the prepared gradients; at a repeat's start, with fresh moments.

        Args:
            iteration: Iterations done so far in the run.
            share: As for `TrainConfig.learning_rate_at`.
        """
        if iteration > 0 and iteration % self._config.iterations == 0:
            self._adamw = self._fresh()
        rate = self._config.learning_rate_at(iteration, share)
        for group in self._adamw.param_groups:
            group["lr"] = rate * group["rate_share"]
        self._adamw.step()

    def state_dict(self) -> dict[str, Any]:
        """Return AdamW's moments and step counts, for a checkpoint."""
        return self._adamw.state_dict()

    def moments_like(self) -> dict[int, dict[str, Tensor]]:
        """Return moments and step counts as a first step makes them, by parameter; all are 0."""
        twins = [nn.Parameter(torch.zeros_like(p)) for p in self._parameters]
        for twin in twins:
            twin.grad = torch.zeros_like(twin)
        adamw = torch.optim.AdamW(twins)
        adamw.step()
        moments: dict[int, dict[str, Tensor]] = adamw.state_dict()["state"]
        return moments

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the `state` of what `state_dict` returned; all else is the configuration's."""
        groups = self._adamw.state_dict()["param_groups"]
        self._adamw.load_state_dict({"state": state["state"], "param_groups": groups})

    def _fresh(self) -> torch.optim.AdamW:
        runs = itertools.groupby(
            zip(self._shares, self._parameters, strict=True), operator.itemgetter(0)
        )
        groups = [{"rate_share": share, "params": [p for _, p in run]} for share, run in runs]
        return torch.optim.AdamW(
            groups,
            lr=self._config.learning_rate,
            weight_decay=self._config.weight_decay,
            # One kernel for all parameters; the CPU's own loop is as fast there.
            fused=self._parameters[0].is_cuda,
        )


class WeightAverage:
    """A running mean of parameters: recent ones weigh more, exponentially.

    Args:
        parameters: What is averaged.
        decay: Share of itself that the mean keeps in an iteration, in [0, 1); 0: there is none.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], decay: float) -> None:
        self._parameters: list[Tensor] = list(parameters)
        self._decay = decay
        self._means = [p.detach().clone() for p in parameters] if decay > 0.0 else []

    @torch.no_grad()
    def update(self, iteration: int) -> None:
        """Take the parameters after an iteration, counted from 0, into the mean."""
        if self._means:
            # What untrained weights have to say is soon forgotten.
            keep = min(self._decay, (1 + iteration) / (10 + iteration))
            torch._foreach_lerp_(self._means, self._parameters, 1.0 - keep)

    @torch.no_grad()
    def rule(self, rule: NPARule) -> NPARule:
        """Return a copy of the rule that has the parameters with their means; itself without."""
        if not self._means:
            return rule
        averaged = copy.deepcopy(rule)
        trained = [parameter for parameter in averaged.parameters() if parameter.requires_grad]
        for parameter, mean in zip(trained, self._means, strict=True):
            parameter.copy_(mean)
        return averaged

    def state_dict(self) -> dict[str, Any]:
        """Return the means as the entry `average` of a checkpoint, or nothing."""
        means = {str(number): mean for number, mean in enumerate(self._means)}
        return {"average": means} if means else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint with the entries of `state_dict`."""
        for number, mean in enumerate(self._means):
            mean.copy_(state["average"][str(number)])
