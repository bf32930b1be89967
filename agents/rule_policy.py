"""A trained update rule as a policy."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from npa_envs.agents.policies import Interface, Policy, interface_of, unwrapped
from npa_envs.errors import NPAError
from npa_envs.rule.rule import NPARule
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
        _check_correction(rule)
        if not (is_real(state_scale) and state_scale > 0.0):
            raise NPAError(
                f"state_scale must be positive and finite, got {state_scale!r}: give the "
                "environment's, or env"
            )
        if env is not None:
            _check_fit(rule, env)
            state_scale = interface_of(env).state_scale
        super().__init__(rule_interface(rule, state_scale))
        self.rule = rule

    def act(self, observation: Tensor) -> Tensor:
        """Return the rule's bounded update of every particle."""
        return self.interface.action(*bounded_update(self.rule, observation.flatten(0, 1))).float()


def rule_interface(rule: NPARule, state_scale: float) -> Interface:
    """Return what observations and actions mean to a rule.

    Args:
        rule: The rule.
        state_scale: State step of an action of 1, dimensionless.
    """
    moving = not rule.static
    return Interface(rule.space_dim, rule.state_dim, moving, state_scale, rule.species_count)


def bounded_update(rule: NPARule, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Return what a rule does about what particles observe; differentiable.

    Args:
        rule: The rule; the update is computed on its device, in its precision.
        observation: What environments offer, shape [K, P].

    Returns:
        Displacements δ / (1 + |δ|) as fractions of α ε, shape [K, D], or [K, 0] where particles are
        static; and state steps Δs, dimensionless, not bounded, shape [K, C].
    """
    weight = rule.hidden.weight
    rows = perceived(rule, observation.to(weight.device, weight.dtype))
    if rule.is_plain():
        # The very products of a rollout: a rule amplifies rounding from step to step.
        folded = rule.folded()
        padded = rows.new_zeros(len(rows), folded.row_width)
        padded[:, : rule.perception_dim] = rows
        padded[:, rule.perception_dim] = 1.0
        update = folded(padded)[:, : rule.update_dim]
    else:
        update = rule(rows)
    return bounded(rule, update)


def bounded(rule: NPARule, update: Tensor) -> tuple[Tensor, Tensor]:
    """Return displacements and state steps of raw updates, as `bounded_update` does.

    Args:
        rule: Says whether particles move.
        update: What its network gives, shape [K, A].
    """
    moved = 0 if rule.static else rule.space_dim
    delta, state_step = update[:, :moved], update[:, moved:]
    return delta / (1.0 + delta.norm(dim=1, keepdim=True)), state_step


def perceived(rule: NPARule, rows: Tensor) -> Tensor:
    """Return what a rule reads of observations, in its order.

    Args:
        rule: The rule.
        rows: What environments offer, shape [K, P].
    """
    if rule.state_gradient and rule.density_gradient:
        return rows
    first, end = 2 * rule.state_dim, rule_interface(rule, 1.0).shared_dim
    density = end - rule.space_dim
    groups = [rows[:, :first]]
    if rule.state_gradient:
        groups.append(rows[:, first:density])
    if rule.density_gradient:
        groups.append(rows[:, density:end])
    # What is offered of each species is read by all rules that tell them apart.
    return torch.cat((*groups, rows[:, end:]), dim=1)


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
    check_rule_fits(rule, interface_of(env), unwrapped(env).config)


def check_rule_fits(rule: NPARule, wanted: Interface, config: Any) -> None:
    """Check that a rule can act in an environment as it does in a rollout.

    Args:
        rule: The rule.
        wanted: What the environment's observations and actions mean.
        config: The environment's configuration.

    Raises:
        NPAError: It cannot; the message says in what they differ.
    """
    _check_correction(rule)
    if rule.space_dim != wanted.space_dim:
        raise NPAError(
            f"rule must have the environment's space_dim, {wanted.space_dim}, got "
            f"{rule.space_dim}: choose another environment or another rule"
        )
    if rule.state_dim != wanted.state_dim:
        raise NPAError(
            f"rule must have the environment's state_dim, {wanted.state_dim}, got "
            f"{rule.state_dim}: make the environment with state_dim={rule.state_dim}"
        )
    if rule.static == wanted.moving:
        kind, other = ("static", "moving") if rule.static else ("moving", "static")
        raise NPAError(
            f"rule must be one of {other} particles like the environment's, got one of {kind} "
            f"particles (static={rule.static}): choose another environment or another rule"
        )
    if rule.species_count != wanted.species_count:
        raise NPAError(
            f"rule must tell as many species apart as the environment, {wanted.species_count}, got "
            f"{rule.species_count}: choose another rule, or another perception"
        )
    if rule.moment_inverse != config.moment_inverse:
        raise NPAError(
            f"rule must have the environment's moment_inverse, {config.moment_inverse!r}, got "
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


def _check_correction(rule: NPARule) -> None:
    if not rule.moment_correction:
        raise NPAError(
            "rule must perceive gradients with moment_correction=True, as environments offer "
            "them, got moment_correction=False: train it with the correction"
        )
