"""A trained update rule as a policy."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from npa_envs.agents.policy import Interface, Policy, interface_of, unwrapped
from npa_envs.errors import NPAError
from npa_envs.rule import NPARule
from npa_envs.tasks.checks import is_real


class RulePolicy(Policy):
    """An update rule as a policy: a_x = δ / (1 + |δ|) and a_s = Δs / state_scale.

    With it an episode is `npa_envs.rollout` of the rule, up to rounding, as long as nothing that
    the environment clips gets that far: state steps at `state_scale`, observations at
    `observation_limit`. Actions are computed on the rule's device.

    Args:
        rule: The rule; the policy follows when it is trained on.
        env: The environment that it is to act in, checked to fit; None: trust the caller.
        state_scale: The environment's, where `env` is not given (dimensionless).

    Raises:
        NPAError: The rule perceives what no environment offers, or does not fit `env`.
    """

    def __init__(self, rule: NPARule, env: Any = None, state_scale: float = 1.0) -> None:
        if not isinstance(rule, NPARule):
            raise NPAError(
                f"rule must be an NPARule, got {type(rule).__name__}: npa_envs.load_rule('gecko')"
            )
        if not rule.moment_correction:
            raise NPAError(
                "rule must perceive gradients with moment_correction=True, as environments offer "
                "them, got moment_correction=False: train it with the correction"
            )
        if not (is_real(state_scale) and state_scale > 0.0):
            raise NPAError(
                f"state_scale must be positive and finite, got {state_scale!r}: give the "
                "environment's, or env"
            )
        if env is not None:
            _check_fit(rule, env)
            state_scale = interface_of(env).state_scale
        super().__init__(Interface(rule.space_dim, rule.state_dim, not rule.static, state_scale))
        self.rule = rule
        self._columns = _perceived_columns(rule)

    def act(self, observation: Tensor) -> Tensor:
        """Return the rule's bounded update of every particle."""
        rule, weight = self.rule, self.rule.hidden.weight
        rows = observation.flatten(0, 1).to(weight.device, weight.dtype)
        if self._columns is not None:
            rows = rows[:, self._columns.to(rows.device)]
        if rule.is_plain():
            # The very products of a rollout: a rule amplifies rounding from step to step.
            folded = rule.folded()
            padded = rows.new_zeros(len(rows), folded.row_width)
            padded[:, : rule.perception_dim] = rows
            padded[:, rule.perception_dim] = 1.0
            update = folded(padded)[:, : rule.update_dim]
        else:
            update = rule(rows)
        moved = 0 if rule.static else rule.space_dim
        delta, state_step = update[:, :moved], update[:, moved:]
        bounded = delta / (1.0 + delta.norm(dim=1, keepdim=True))
        return self.interface.action(bounded, state_step).float()


def _perceived_columns(rule: NPARule) -> Tensor | None:
    """Return which columns of an observation the rule reads, or None for all of them."""
    if rule.state_gradient and rule.density_gradient:
        return None
    whole = Interface(rule.space_dim, rule.state_dim, not rule.static, 1.0).perception_dim
    gradients = 2 * rule.state_dim
    density = whole - rule.space_dim
    groups = [torch.arange(gradients)]
    if rule.state_gradient:
        groups.append(torch.arange(gradients, density))
    if rule.density_gradient:
        groups.append(torch.arange(density, whole))
    return torch.cat(groups)


def _check_fit(rule: NPARule, env: Any) -> None:
    spaces = [
        getattr(e, "single_observation_space", None) or e.observation_space
        for e in (env, unwrapped(env))
    ]
    if spaces[0] != spaces[1]:
        raise NPAError(
            "a rule must see observations as the environment makes them, and a wrapper changes "
            f"them from {spaces[1]} to {spaces[0]}: give RulePolicy the environment without it"
        )
    physics, config = unwrapped(env).worlds.physics, unwrapped(env).config
    if rule.space_dim != physics.space_dim:
        raise NPAError(
            f"rule must have the environment's space_dim, {physics.space_dim}, got "
            f"{rule.space_dim}: choose another environment or another rule"
        )
    if rule.state_dim != physics.state_dim:
        raise NPAError(
            f"rule must have the environment's state_dim, {physics.state_dim}, got "
            f"{rule.state_dim}: make the environment with state_dim={rule.state_dim}"
        )
    if rule.static == physics.moving:
        kind, other = ("static", "moving") if rule.static else ("moving", "static")
        raise NPAError(
            f"rule must be one of {other} particles like the environment's, got one of {kind} "
            f"particles (static={rule.static}): choose another environment or another rule"
        )
    if rule.moment_inverse != physics.moment_inverse:
        raise NPAError(
            f"rule must have the environment's moment_inverse, {physics.moment_inverse!r}, got "
            f"{rule.moment_inverse!r}: make the environment with "
            f"moment_inverse={rule.moment_inverse!r}"
        )
    for name in ("eps0",) if rule.static else ("eps0", "alpha"):
        own, theirs = getattr(rule, name), getattr(config, name)
        if not math.isclose(own, theirs, rel_tol=1e-6):
            raise NPAError(
                f"rule must have the environment's {name}, {theirs:g}, got {own:g}: make the "
                f"environment with {name}={own:g}"
            )
