"""The tasks that can be trained, by name, and their presets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from npa_envs.errors import NPAError, shown, suggest
from npa_envs.tasks.base import Task
from npa_envs.tasks.co_morphogenesis2d import CO_MORPHOGENESIS2D_PRESETS, CoMorphogenesis2D
from npa_envs.tasks.many_pictures import ManyPictures
from npa_envs.tasks.morphogenesis2d import MORPHOGENESIS2D_PRESETS, Morphogenesis2D
from npa_envs.tasks.morphogenesis3d import MORPHOGENESIS3D_PRESETS, Morphogenesis3D
from npa_envs.tasks.point_classification import POINT_CLASSIFICATION_PRESETS, PointClassification
from npa_envs.tasks.targets.meshes import builtin_meshes
from npa_envs.tasks.targets.points import builtin_targets
from npa_envs.tasks.targets.textures import builtin_textures
from npa_envs.tasks.texture import TEXTURE_PRESETS, Texture
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.overrides import override


@dataclass(frozen=True)
class TaskEntry:
    """A task that can be trained."""

    summary: str
    """One line for lists."""

    presets: Mapping[str, TrainConfig[Any]]
    """Configurations by name: `paper`, `fast`, `tiny`, and `best` where a recipe was searched."""

    make: Callable[[Any, torch.device], Task]
    """Builds the task from its own configuration, on a device."""

    targets: Callable[[], tuple[str, ...]]
    """Returns the names of its built-in targets; none where `--target` is no field of its."""

    fast_seconds: float
    """How long the preset `fast` takes on one thread of a CPU [s]."""

    paired_time: float = 0.8
    """Time of two processes as a share of one's, where batches are small."""

    space_dim: int = 2
    """Space dimension D of its worlds."""

    joint: bool = False
    """Whether several rules are trained, one for each species, by `train_together`."""

    def expected_seconds(self, config: TrainConfig[Any]) -> float | None:
        """Return about how long a run takes on a CPU [s]: as its particle-steps to those of `fast`.

        None on other devices, where particle-steps say little.
        """
        if config.device != "cpu":
            return None
        return self.fast_seconds * _particle_steps(config) / _particle_steps(self.presets["fast"])


def _particle_steps(config: TrainConfig[Any]) -> int:
    species = getattr(config.task, "species", (config.task,))
    particles: int = sum(own.particle_count for own in species)
    return config.total_iterations * config.world_count * particles * sum(config.steps)


TASKS: Mapping[str, TaskEntry] = {
    "morphogenesis2d": TaskEntry(
        summary="grow a picture from a disk of blank particles",
        presets=MORPHOGENESIS2D_PRESETS,
        make=lambda config, device: (ManyPictures if config.targets else Morphogenesis2D)(
            config, device=device
        ),
        targets=builtin_targets,
        fast_seconds=220.0,
    ),
    "co_morphogenesis2d": TaskEntry(
        summary="grow pictures in one world, each by a rule of its own",
        presets=CO_MORPHOGENESIS2D_PRESETS,
        # Films and the evaluation take its rules one by one, as rules of their own task.
        make=lambda config, device: CoMorphogenesis2D(config, device=device),
        targets=tuple,
        fast_seconds=340.0,
        joint=True,
    ),
    "morphogenesis3d": TaskEntry(
        summary="grow a thing seen from all sides from a ball of blank particles",
        presets=MORPHOGENESIS3D_PRESETS,
        make=lambda config, device: Morphogenesis3D(config, device=device),
        targets=builtin_meshes,
        fast_seconds=290.0,
        space_dim=3,
    ),
    "texture": TaskEntry(
        summary="arrange particles all over a periodic box to a texture",
        presets=TEXTURE_PRESETS,
        make=lambda config, device: Texture(config, device=device),
        targets=builtin_textures,
        fast_seconds=285.0,
        # Each world's loss is most of the work, and each process has one.
        paired_time=0.55,
    ),
    "point_classification": TaskEntry(
        summary="particles that stay where they are agree on which digit they form",
        presets=POINT_CLASSIFICATION_PRESETS,
        make=lambda config, device: PointClassification(config, device=device),
        targets=tuple,
        fast_seconds=200.0,
    ),
}
"""Every task that can be trained, by its name on the command line and in checkpoints."""


def task_entry(task_name: str) -> TaskEntry:
    """Return the entry of a task.

    Args:
        task_name: For example `morphogenesis2d`.

    Raises:
        NPAError: There is no such task.
    """
    if not isinstance(task_name, str) or task_name not in TASKS:
        raise NPAError(f"unknown task {shown(task_name)}: {suggest(task_name, TASKS)}")
    return TASKS[task_name]


def preset(name: str, task_name: str = "morphogenesis2d", /, **fields: Any) -> TrainConfig[Any]:
    """Return a preset with fields changed by plain name.

    Args:
        name: `paper`, `fast`, `tiny`, or `best` where the task has it.
        task_name: The task it is for.
        fields: New values by field name, the run's and the task's alike.

    Raises:
        NPAError: The task, the preset or a field is unknown, or a value is not allowed.
    """
    presets = task_entry(task_name).presets
    if not isinstance(name, str) or name not in presets:
        raise NPAError(f"unknown preset {shown(name)} of {task_name}: {suggest(name, presets)}")
    return override(presets[name], **fields)
