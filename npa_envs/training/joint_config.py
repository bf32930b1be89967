"""What a run that trains several rules together can be told besides."""

from __future__ import annotations

from dataclasses import dataclass

from npa_envs.errors import NPAError
from npa_envs.tasks.checks import is_whole
from npa_envs.training.config import TaskConfigT, TrainConfig


@dataclass(frozen=True, kw_only=True)
class JointTrainConfig(TrainConfig[TaskConfigT]):
    """A training run of several rules in one world: what they start from, and which ones learn.

    `initial_rule` of a run of one rule stays empty.
    """

    initial_rules: tuple[str, ...] = ()
    """Start from these rules, shipped ones' names or files, one for each species."""

    frozen: tuple[int, ...] = ()
    """Numbers of the species, from 0, whose initial rules stay as they are."""

    def __post_init__(self) -> None:
        """Check every field; how many species there are is the task's to know.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        super().__post_init__()
        if self.initial_rule:
            raise NPAError(
                f"initial_rule is for one rule, got {self.initial_rule!r}: give initial_rules, one "
                "for each species"
            )
        rules = self.initial_rules
        if not isinstance(rules, tuple) or not all(isinstance(r, str) and r for r in rules):
            raise NPAError(
                f"initial_rules must be a tuple of names or files, got {rules!r}: "
                "for example initial_rules=('gecko', 'heart')"
            )
        frozen = self.frozen
        if not isinstance(frozen, tuple) or not all(is_whole(n) and n >= 0 for n in frozen):
            raise NPAError(f"frozen must be a tuple of species' numbers from 0, got {frozen!r}")
