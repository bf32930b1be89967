"""What the rule of a run is before its first iteration."""

from __future__ import annotations

from typing import Any

from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import differing_fields
from npa_envs.tasks.train_config import TrainConfig


def initial_rule(config: TrainConfig[Any], untrained: NPARule) -> NPARule:
    """Return the rule that a run starts from, with the configuration's `moment_inverse`.

    Args:
        config: The run's configuration.
        untrained: The task's own rule, whose shape the rule must have.

    Raises:
        NPAError: The configuration's rule cannot be loaded, has another shape, or was trained with
            another `moment_inverse` than the paper's and the configuration's.
    """
    untrained.moment_inverse = config.moment_inverse
    if not config.initial_rule:
        return untrained
    source = config.initial_rule
    rule = load_rule(source)
    wrong = differing_fields(rule, untrained)
    if wrong:
        raise NPAError(
            f"initial_rule must be a rule of the task's shape, but {source!r} differs in "
            f"{', '.join(wrong)}: change those fields, or start from another rule"
        )
    rule.moment_inverse = config.moment_inverse
    return rule
