"""Training: presets of configurations, the pool, the trainer, checkpoints and logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from npa_envs.checks import check_device
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import ParticleTask, PictureTask, Task
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DTrainConfig
from npa_envs.tasks.train_config import JointTrainConfig, TrainConfig
from npa_envs.training.run_folder import JsonlLog, RunFolder
from npa_envs.training.task_table import (
    TASKS,
    TaskEntry,
    config_to_dict,
    load_config,
    override,
    preset,
    task_entry,
)
from npa_envs.training.trainer import (
    JOINT_TASK_NAME,
    JointRules,
    Trainer,
    TrainResult,
    check_seconds,
)

__all__ = [
    "TASKS",
    "DivergedError",
    "JointRules",
    "JointTrainConfig",
    "JsonlLog",
    "Morphogenesis2DTrainConfig",
    "ParticleTask",
    "PictureTask",
    "RunFolder",
    "Task",
    "TaskEntry",
    "TrainConfig",
    "TrainResult",
    "Trainer",
    "check_device",
    "config_to_dict",
    "load_config",
    "override",
    "preset",
    "task_entry",
    "train",
    "train_together",
]


def train(
    config: TrainConfig[Any],
    task_name: str = "morphogenesis2d",
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    max_seconds: float | None = None,
    begun: Callable[[], None] = lambda: None,
    rules: Sequence[NPARule] | None = None,
) -> TrainResult:
    """Train a rule on a task of the table `TASKS`, or a rule for each species of a joint task.

    Args:
        config: The run's configuration, for example `preset("fast", target="heart")`.
        task_name: The task.
        resume: Continue from the checkpoint in `config.out`.
        overwrite: Remove the files of an earlier run in `config.out` and start a new one.
        progress: Show a progress bar.
        max_seconds: Stop after this time [s]; the run can be resumed. None: no limit.
        begun: Called once after all checks, before the first iteration.
        rules: For a joint task: see `train_together`.

    Raises:
        NPAError: The task is unknown, its target cannot be loaded, or as for `Trainer`.
        DivergedError: The loss is not finite.
    """
    entry = task_entry(task_name)
    cls = type(next(iter(entry.presets.values())).task)
    if not isinstance(config, TrainConfig) or not isinstance(config.task, cls):
        raise NPAError(
            f"config must be a TrainConfig of the task {task_name!r}, got {shown(config)}: "
            f"make it with preset('fast', {task_name!r})"
        )
    check_seconds(max_seconds)
    task = entry.make(config.task, check_device(config.device))
    # A task may change fields that depend on its target; rule and checkpoint store the result.
    config = replace(config, task=getattr(task, "config", config.task))
    trainer = Trainer(
        task, config, task_name=task_name, resume=resume, overwrite=overwrite, rules=rules
    )
    begun()
    return trainer.run(progress=progress, max_seconds=max_seconds)


def train_together(
    config: TrainConfig[CoMorphogenesis2DConfig],
    rules: Sequence[NPARule] | None = None,
    **options: Any,
) -> TrainResult:
    """Train one rule for each species of a common world.

    Each rule perceives densities divided by the number of its own particles, as in a world of one
    species. A rule whose parameters do not require gradients does not change.

    Args:
        config: The run's configuration, for example `preset("fast", "co_morphogenesis2d")` or
            `TrainConfig(task=CoMorphogenesis2DConfig())`.
        rules: Initial rules, one for each species; copied. None: the configuration's
            `initial_rules`, or untrained ones.
        options: Those of `train`; to resume, give the same `rules` again.

    Returns:
        The result; its `rule` is a `JointRules`, in the order of the species. Their files
        are `rule-0.safetensors`, `rule-1.safetensors`, ... in `config.out`.

    Raises:
        NPAError: Rules do not fit the species, a target cannot be loaded, or as for `Trainer`.
        DivergedError: The loss is not finite.
    """
    return train(config, JOINT_TASK_NAME, rules=rules, **options)
