"""Training several rules together, in one world that they share."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from typing import Any, Unpack, cast

import torch
from torch import Tensor, nn

from npa_envs.devices import check_device
from npa_envs.errors import NPAError, shown
from npa_envs.rule.files import load_rule, save_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import differing_fields
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2D, CoMorphogenesis2DConfig
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.iteration import TrainingOptions
from npa_envs.training.trainer import Trainer, TrainResult, rule_like, take_options
from npa_envs.world.species import rollout_species

TASK_NAME = "co_morphogenesis2d"
"""What checkpoints call it."""


class JointRules(nn.Module):
    """The rules of one world, one for each species: what the trainer takes for its rule.

    Args:
        rules: The rules, species by species.
    """

    def __init__(self, rules: Sequence[NPARule]) -> None:
        super().__init__()
        self.rules = nn.ModuleList(rules)

    def __iter__(self) -> Any:
        return iter(self.rules)

    def hyper_parameters(self) -> dict[str, Any]:
        """Return all that the rules are made with, for checkpoints."""
        return {"rules": [dict(rule.hyper_parameters()) for rule in self]}


class _JointTrainer(Trainer):
    """`Trainer` of several rules, each of which leaves a file as if it had been trained alone."""

    def __init__(
        self,
        task: CoMorphogenesis2D,
        config: TrainConfig[CoMorphogenesis2DConfig],
        rules: Sequence[NPARule] | None,
        *,
        resume: bool,
        overwrite: bool,
    ) -> None:
        self._species = task
        self._given = rules
        self._frozen: tuple[int, ...] = getattr(config, "frozen", ())
        begin_with: tuple[str, ...] = getattr(config, "initial_rules", ())
        if rules is None and begin_with and not resume:
            self._given = [load_rule(source) for source in begin_with]
        super().__init__(
            task,
            config,
            task_name=TASK_NAME,
            resume=resume,
            overwrite=overwrite,
            rollout=self._rollout_together,
        )

    def _rollout_together(
        self, rule: NPARule, x: Tensor, s: Tensor, steps: int, /, **options: Unpack[TrainingOptions]
    ) -> tuple[Tensor, Tensor, Tensor]:
        counts = self._species.config.counts
        rules = list(cast(JointRules, rule))
        return rollout_species(rules, x, s, steps, counts=counts, density_counts=counts, **options)

    def _make_rule(self, generator: torch.Generator, held: dict[str, Any] | None) -> NPARule:
        # The trainer asks of its rule what any module has, and for its hyper-parameters.
        made = self._species.make_rules(generator)
        for rule in made:
            take_options(rule, self.config)
        if held is not None:
            self._given = [rule_like(own) for own in held["rules"]]
        if self._given is None:
            if self._frozen:
                raise NPAError(
                    f"frozen must name rules that were trained before, got {self._frozen} without "
                    "initial_rules: give one for each species"
                )
            return cast(NPARule, JointRules(made))
        if len(self._given) != len(made):
            raise NPAError(
                f"rules must be one for each of {len(made)} species, got {len(self._given)}"
            )
        for number, (rule, own) in enumerate(zip(self._given, made, strict=True)):
            if rule.moment_inverse == "threshold":
                own.moment_inverse = "threshold"
            own.dead_zone = rule.dead_zone
            wrong = differing_fields(rule, own)
            if wrong:
                raise NPAError(
                    f"rules must have the shape of their species, but rule {number} differs in "
                    f"{', '.join(wrong)}: change those fields of species {number}"
                )
        rules = copy.deepcopy(list(self._given))
        for rule in rules:
            rule.moment_inverse = self.config.moment_inverse
        for number in self._frozen:
            if number >= len(rules):
                raise NPAError(
                    f"frozen must name species from 0 to {len(rules) - 1}, got {shown(number)}"
                )
            rules[number].requires_grad_(False)
        if not any(p.requires_grad for rule in rules for p in rule.parameters()):
            raise NPAError("frozen must leave a rule that learns, got all of them: leave one out")
        return cast(NPARule, JointRules(rules))

    def _save_rule(self, rule: NPARule, told: dict[str, Any]) -> None:
        for number, one in enumerate(cast(JointRules, rule)):
            own = {name: told[name] for name in told if name not in ("initial_rules", "frozen")}
            own["task"] = told["task"]["species"][number]
            metadata = {"task": "morphogenesis2d", "config": json.dumps(own)}
            metadata |= {"iteration": str(self.iteration), "trained_in": TASK_NAME}
            save_rule(one, self.folder.rule_of(number), metadata=metadata)


def train_together(
    config: TrainConfig[CoMorphogenesis2DConfig],
    rules: Sequence[NPARule] | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    max_seconds: float | None = None,
    begun: Callable[[], None] = lambda: None,
) -> TrainResult:
    """Train one rule for each species of a world that all of them share.

    Each rule sees densities divided by its own particles, as it would alone. A rule whose
    parameters do not require gradients stays as it is: the others learn to live beside it.

    Args:
        config: The run's configuration, for example `preset("fast", "co_morphogenesis2d")` or
            `TrainConfig(task=CoMorphogenesis2DConfig())`.
        rules: What to start from, one rule for each species; copied. None: the configuration's
            `initial_rules`, or untrained ones.
        resume: Go on from the checkpoint in `config.out`; give the same `rules` again.
        overwrite: Start anew although `config.out` holds a run; its files are removed.
        progress: Show a progress bar.
        max_seconds: Stop after this time [s]; the run can be resumed.
        begun: Called once when nothing is left to be refused, before the first iteration.

    Returns:
        What the run came to; its `rule` holds the rules, in the order of the species. Their files
        are `rule-0.safetensors`, `rule-1.safetensors`, ... in `config.out`.

    Raises:
        NPAError: Rules do not fit the species, a target cannot be loaded, or as for `Trainer`.
        DivergedError: The loss is not finite.
    """
    if config.initial_rule:
        raise NPAError(
            f"initial_rule is for one rule, got {shown(config.initial_rule)}: give one for each "
            "species as rules"
        )
    task = CoMorphogenesis2D(config.task, device=check_device(config.device))
    trainer = _JointTrainer(task, config, rules, resume=resume, overwrite=overwrite)
    begun()
    return trainer.run(progress=progress, max_seconds=max_seconds)
