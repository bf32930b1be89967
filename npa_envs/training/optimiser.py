"""The optimiser of rules, and the normalisation of gradients."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from npa_envs.rule.rule import NPARule, fate_parameters
from npa_envs.tasks.train_config import TrainConfig

FATE_RATE = 0.02
"""Learning rate of the weights of division and death, divided by that of all others."""

MUON_MOMENTUM = 0.9
"""Muon's momentum; the usual 0.95 trains less well."""

NORM_FLOOR = 1e-8
"""Added to a gradient's norm before dividing by it, so that a zero gradient stays zero."""


def normalise_gradients(gradients: Sequence[Tensor]) -> None:
    """Divide each gradient by its norm, in place; a gradient that is not finite becomes 0."""
    norms = torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients])
    # A norm is not finite if an entry is not.
    bad = ~(norms < math.inf)
    norms += NORM_FLOOR
    for gradient, norm, is_bad in zip(gradients, norms.unbind(), bad.unbind(), strict=True):
        gradient.div_(norm).masked_fill_(is_bad, 0.0)


def layer_weights(rules: nn.Module) -> list[Tensor]:
    """Return the weight matrices of all layers of a rule, or of several in a module.

    Biases, codes and the weights of division are left out.
    """
    fates = set(map(id, fate_parameters(rules)))
    weights: list[Tensor] = []
    for module in rules.modules():
        if isinstance(module, nn.Linear):
            weights.append(module.weight)
        elif isinstance(module, NPARule) and module.equivariant:
            weights.append(module.mixing)
    return [weight for weight in weights if id(weight) not in fates]


class RuleOptimiser:
    """AdamW, or with optimiser="muon" Muon for weight matrices and AdamW for all else.

    Muon's steps are orthogonalised momentum, computed in bfloat16 and scaled to the length of
    AdamW's steps (Jordan et al. 2024; Liu et al., arXiv 2502.16982).
    """

    def __init__(
        self, parameters: Sequence[nn.Parameter], config: TrainConfig[Any], rules: nn.Module
    ) -> None:
        self._indices = {id(parameter): index for index, parameter in enumerate(parameters)}
        """Index of each parameter by its `id`."""
        self._config = config
        fates, matrices = (set(map(id, of(rules))) for of in (fate_parameters, layer_weights))
        if config.optimiser != "muon":
            matrices = set()
        self._orthogonal = [p for p in parameters if id(p) in matrices]
        others = [p for p in parameters if id(p) not in matrices]
        self._groups: list[dict[str, Any]] = [
            {"rate_factor": factor, "params": list(group)}
            for factor, group in itertools.groupby(
                others, lambda p: FATE_RATE if id(p) in fates else 1.0
            )
        ]
        self._optimisers = self._new_optimisers()

    def step(self, iteration: int, least_progress: float = 0.0) -> None:
        """Update the parameters by their `grad`; where the schedule restarts, moments are 0 again.

        `iteration` counts from 0. `least_progress` is that of `TrainConfig.learning_rate_at`.
        """
        if iteration > 0 and iteration % self._config.iterations == 0:
            self._optimisers = self._new_optimisers()
        rate = self._config.learning_rate_at(iteration, least_progress)
        for optimiser in self._optimisers:
            for group in optimiser.param_groups:
                group["lr"] = rate * group.get("rate_factor", 1.0)
            optimiser.step()

    def state_dict(self) -> dict[str, Any]:
        """Return the moments and step count of each parameter, by its index, for a checkpoint."""
        states = [item for optimiser in self._optimisers for item in optimiser.state.items()]
        return {"state": {self._indices[id(parameter)]: state for parameter, state in states}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the moments and step counts that `state_dict` returned."""
        moments, indices = state["state"], self._indices
        for optimiser in self._optimisers:
            order = [indices[id(p)] for group in optimiser.param_groups for p in group["params"]]
            load_moments(optimiser, {k: moments[i] for k, i in enumerate(order) if i in moments})

    def _new_optimisers(self) -> list[Optimizer]:
        optimisers: list[Optimizer] = []
        decay = self._config.weight_decay
        if self._orthogonal:
            # Steps of AdamW's length, so that one learning rate serves both.
            optimisers.append(
                torch.optim.Muon(
                    self._orthogonal,
                    weight_decay=decay,
                    momentum=MUON_MOMENTUM,
                    adjust_lr_fn="match_rms_adamw",
                )
            )
        if self._groups:
            groups = [dict(group) for group in self._groups]
            # One kernel for all parameters; a loop is as fast on a CPU.
            fused = groups[0]["params"][0].is_cuda
            optimisers.append(torch.optim.AdamW(groups, weight_decay=decay, fused=fused))
        return optimisers


def load_moments(optimiser: Optimizer, state: dict[int, Any]) -> None:
    """Load the `state` of an optimiser's `state_dict`; its parameter groups do not change."""
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})
