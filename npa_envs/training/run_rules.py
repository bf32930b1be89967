"""The rules of a run: how they start, and the files that they are saved to."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from npa_envs.errors import NPAError, shown
from npa_envs.rule.files import load_rule, preset_rules, save_rule
from npa_envs.rule.rule import NPARule, dividing, with_codes
from npa_envs.tasks.base import Task, differing_fields, untrained_rule
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.iteration import Rollout
from npa_envs.training.run_folder import RunFolder
from npa_envs.training.task_table import config_to_dict
from npa_envs.world.species import rollout_species

JOINT_TASK_NAME = "co_morphogenesis2d"
"""Name of the task of several rules in checkpoints."""

LEFT_OUT = ("out", "device", "initial_rule", "initial_rules", "frozen")
"""Fields that rule files do not have, as these are shared with others: paths and the device."""


class JointRules(nn.Module):
    """The rules of one world, one for each species, as a module that the trainer trains."""

    def __init__(self, rules: Sequence[NPARule]) -> None:
        super().__init__()
        self.rules = nn.ModuleList(rules)

    def __iter__(self) -> Any:
        return iter(self.rules)

    def hyper_parameters(self) -> dict[str, Any]:
        """Return the hyper-parameters of all rules, for checkpoints."""
        return {"rules": [dict(rule.hyper_parameters()) for rule in self]}


def first_rule(
    task: Task,
    config: TrainConfig[Any],
    generator: torch.Generator,
    saved: dict[str, Any] | None,
    rules: Sequence[NPARule] | None,
) -> NPARule:
    """Return the rule that a run starts from, for a task of several species a `JointRules`.

    It has the hyper-parameters `saved` in a checkpoint, if any. Without, and without `rules`, it is
    what the configuration names, or untrained; then its weights are drawn from `generator`.
    """
    if hasattr(task, "make_rules"):
        untrained = task.make_rules(generator)
        # The trainer uses its rule only as a module with hyper-parameters.
        return cast(NPARule, JointRules(_species_rules(config, untrained, saved, rules)))
    untrained_one = task.make_rule(generator)
    return initial_rule(config, untrained_one) if saved is None else rule_like(saved)


def joint_rollout(counts: Sequence[int]) -> Rollout:
    """Return the rollout of `JointRules` for species with these numbers of particles."""

    def rollout(
        rules: JointRules, x: Tensor, s: Tensor, steps: int, /, **options: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        return rollout_species(
            list(rules), x, s, steps, counts=counts, density_counts=counts, **options
        )

    return rollout


def write_rules(
    rule: NPARule, folder: RunFolder, config: TrainConfig[Any], task_name: str, iteration: int
) -> None:
    """Write the rule of a run, or each of a `JointRules`, with its task and configuration."""
    fields = {k: v for k, v in config_to_dict(config).items() if k not in LEFT_OUT}
    if not isinstance(rule, JointRules):
        metadata = {"task": task_name, "config": json.dumps(fields), "iteration": str(iteration)}
        save_rule(rule, folder.rule, metadata=metadata)
        return
    for number, (one, species) in enumerate(zip(rule, fields["task"]["species"], strict=True)):
        metadata = {"task": "morphogenesis2d", "config": json.dumps(fields | {"task": species})}
        metadata |= {"iteration": str(iteration), "trained_in": JOINT_TASK_NAME}
        save_rule(one, folder.rule_of(number), metadata=metadata)


def rule_like(saved: dict[str, Any]) -> NPARule:
    """Return a rule with a checkpoint's hyper-parameters, on the CPU, with random weights."""
    try:
        return untrained_rule(torch.Generator(), **saved)
    except (TypeError, RuntimeError, OverflowError) as error:
        raise NPAError(
            f"no rule has the hyper-parameters {shown(saved)} of the checkpoint: it is damaged, or "
            "of another version"
        ) from error


def take_options(rule: NPARule, config: TrainConfig[Any]) -> None:
    """Set an untrained rule's `moment_inverse` and `dead_zone` from the configuration."""
    rule.moment_inverse = config.moment_inverse
    rule.dead_zone = 0.0 if rule.equivariant else config.dead_zone


def initial_rule(config: TrainConfig[Any], untrained: NPARule) -> NPARule:
    """Return the rule that a run starts from, in the form of the task's untrained one.

    A rule without division or codes may initialise one with them. An equivariant rule has no dead
    zone, and starts from random weights where the configuration names one of `preset_rules`, which
    are not equivariant.
    """
    take_options(untrained, config)
    source = config.initial_rule
    if not source or (untrained.equivariant and source in preset_rules()):
        return untrained
    rule = load_rule(source)
    if untrained.code_dim and not rule.code_dim:
        rule = with_codes(rule, untrained)
    if rule.moment_inverse == "threshold":
        rule.moment_inverse = config.moment_inverse
    rule.dead_zone = untrained.dead_zone
    if untrained.divides and not rule.divides:
        rule = dividing(rule)
    if rule.codes is not None and untrained.codes is not None:
        names, expected = rule.codes.names, untrained.codes.names
        if names != expected:
            raise NPAError(
                f"initial_rule must have codes of the run's targets, in their order, but "
                f"{shown(source)} has those of {shown(', '.join(names))}, not of "
                f"{shown(', '.join(expected))}: give these targets, or start from a rule without "
                "codes, or from random weights (initial_rule='')"
            )
    theirs, ours = rule.hyper_parameters(), untrained.hyper_parameters()
    differences = [
        f"{'eps0, the eps it learned at' if name == 'eps0' else name} "
        f"({shown(theirs.get(name))}, here {shown(ours.get(name))})"
        for name in differing_fields(rule, untrained)
    ]
    if differences:
        raise NPAError(
            f"initial_rule must be a rule of the task's shape, but {shown(source)} differs in "
            f"{', '.join(differences)}: change those fields, start from another rule, or from "
            "random weights (initial_rule='')"
        )
    return rule


def _species_rules(
    config: TrainConfig[Any],
    untrained: list[NPARule],
    saved: dict[str, Any] | None,
    rules: Sequence[NPARule] | None,
) -> list[NPARule]:
    """Return a rule for each species, in the form of the `untrained` ones."""
    if config.initial_rule:
        raise NPAError(
            f"initial_rule is for one rule, got {shown(config.initial_rule)}: give one for each "
            "species as rules"
        )
    for rule in untrained:
        take_options(rule, config)
    sources: tuple[str, ...] = getattr(config, "initial_rules", ())
    frozen: tuple[int, ...] = getattr(config, "frozen", ())
    if saved is not None:
        rules = [rule_like(one) for one in saved.get("rules", ())]
    elif rules is None and sources:
        rules = [load_rule(source) for source in sources]
    if rules is None:
        if frozen:
            raise NPAError(
                f"frozen must name rules that were trained before, got {frozen} without "
                "initial_rules: give one for each species"
            )
        return untrained
    rules = copy.deepcopy(list(rules))
    if len(rules) != len(untrained):
        raise NPAError(f"rules must be one for each of {len(untrained)} species, got {len(rules)}")
    for number, (rule, expected) in enumerate(zip(rules, untrained, strict=True)):
        if rule.moment_inverse == "threshold":
            rule.moment_inverse = config.moment_inverse
        expected.dead_zone = rule.dead_zone
        differences = differing_fields(rule, expected)
        if differences:
            raise NPAError(
                f"rules must have the shape of their species, but rule {number} differs in "
                f"{', '.join(differences)}: change those fields of species {number}"
            )
    if frozen and max(frozen) >= len(rules):
        raise NPAError(
            f"frozen must name species from 0 to {len(rules) - 1}, got {shown(max(frozen))}"
        )
    for number in frozen:
        rules[number].requires_grad_(False)
    if not any(p.requires_grad for rule in rules for p in rule.parameters()):
        raise NPAError("frozen must leave a rule that learns, got all of them: leave one out")
    return rules
