"""The tasks that can be trained, by name, and their presets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from npa_envs.errors import NPAError, suggest
from npa_envs.tasks.morphogenesis2d_config import Morphogenesis2DConfig
from npa_envs.tasks.morphogenesis3d_config import Morphogenesis3DConfig
from npa_envs.tasks.point_classification_config import PointClassificationConfig
from npa_envs.tasks.task import PictureTask
from npa_envs.tasks.texture_config import TextureConfig
from npa_envs.training.config import Morphogenesis2DTrainConfig, TrainConfig
from npa_envs.training.overrides import override
from npa_envs.training.presets3d import MORPHOGENESIS3D_PRESETS


@dataclass(frozen=True)
class TaskEntry:
    """A task that can be trained."""

    summary: str
    """One line for lists."""

    presets: Mapping[str, TrainConfig[Any]]
    """Configurations by name: `paper`, `fast`, `tiny`."""

    make: Callable[[Any, torch.device], PictureTask]
    """Builds the task from its own configuration, on a device."""

    targets: Callable[[], tuple[str, ...]]
    """Returns the names of its built-in targets; none where `--target` is no field of its."""

    space_dim: int = 2
    """Space dimension D of its worlds."""


def _make_morphogenesis2d(config: Morphogenesis2DConfig, device: torch.device) -> PictureTask:
    # Imported late: a task brings the kernels along, which a list of presets does not need.
    from npa_envs.tasks.morphogenesis2d import Morphogenesis2D

    return Morphogenesis2D(config, device=device)


def _morphogenesis2d_targets() -> tuple[str, ...]:
    from npa_envs.tasks.targets import builtin_targets

    return builtin_targets()


def _make_texture(config: TextureConfig, device: torch.device) -> PictureTask:
    from npa_envs.tasks.texture import Texture

    return Texture(config, device=device)


def _texture_targets() -> tuple[str, ...]:
    from npa_envs.tasks.textures import builtin_textures

    return builtin_textures()


def _make_point_classification(
    config: PointClassificationConfig, device: torch.device
) -> PictureTask:
    from npa_envs.tasks.point_classification import PointClassification

    return PointClassification(config, device=device)


def _make_morphogenesis3d(config: Morphogenesis3DConfig, device: torch.device) -> PictureTask:
    from npa_envs.tasks.morphogenesis3d import Morphogenesis3D

    return Morphogenesis3D(config, device=device)


def _morphogenesis3d_targets() -> tuple[str, ...]:
    from npa_envs.tasks.meshes import builtin_meshes

    return builtin_meshes()


_OUT = Path("runs/morphogenesis2d")
_TEXTURE_OUT = Path("runs/texture")
_POINTS_OUT = Path("runs/point_classification")

MORPHOGENESIS2D_PRESETS: Mapping[str, Morphogenesis2DTrainConfig] = {
    "paper": TrainConfig(task=Morphogenesis2DConfig(), out=_OUT),
    # A few particles that see far, in worlds that start from seeds often: a recognisable gecko
    # after about four minutes on one core (means of 4 worlds: splat loss 0.16 and PSNR 25 dB at
    # step 64, 0.22 and 23 dB at step 1024; with a seed in every sixth batch 0.21 and 0.43).
    "fast": TrainConfig(
        task=Morphogenesis2DConfig(
            target_point_count=512,
            particle_count=512,
            hidden_dim=64,
            eps=0.2,
            seed_radius=0.4,
            resolution=64,
        ),
        iterations=2400,
        repeats=1,
        world_count=2,
        pool_size=32,
        steps=(16, 32),
        learning_rate=2e-3,
        milestones=(1500, 2100),
        seed_interval=2,
        out=_OUT,
        picture_interval=200,
        checkpoint_interval=200,
        tensorboard=False,
    ),
    "tiny": TrainConfig(
        task=Morphogenesis2DConfig(
            target="ring",
            target_point_count=128,
            particle_count=128,
            hidden_dim=32,
            eps=0.3,
            resolution=32,
        ),
        iterations=40,
        repeats=1,
        world_count=2,
        pool_size=8,
        steps=(8, 16),
        learning_rate=5e-3,
        milestones=(30,),
        out=_OUT,
        log_interval=1,
        picture_interval=20,
        checkpoint_interval=20,
        tensorboard=False,
    ),
}
"""2D morphogenesis: `paper` (arXiv 2601.16096), `fast` (minutes on one core), `tiny` (tests)."""

_PAPER_TEXTURE: TrainConfig[TextureConfig] = TrainConfig(
    task=TextureConfig(loss="vgg_ot"),
    iterations=12_000,
    repeats=1,
    steps=(16, 32),
    learning_rate=1e-4,
    weight_decay=0.1,
    milestones=(3_000, 6_000, 9_000),
    out=_TEXTURE_OUT,
)

TEXTURE_PRESETS: Mapping[str, TrainConfig[TextureConfig]] = {
    "paper": _PAPER_TEXTURE,
    # Dots of both colours after some three minutes on one core.
    "fast": TrainConfig(
        task=TextureConfig(
            target="dots", particle_count=1024, hidden_dim=64, resolution=64, damage_radius=0.2
        ),
        iterations=1200,
        repeats=1,
        world_count=2,
        pool_size=32,
        steps=(12, 24),
        learning_rate=2e-3,
        milestones=(800, 1050),
        seed_interval=4,
        out=_TEXTURE_OUT,
        picture_interval=100,
        checkpoint_interval=200,
        tensorboard=False,
    ),
    "tiny": TrainConfig(
        task=TextureConfig(
            target="dots", particle_count=256, hidden_dim=32, eps=0.3, resolution=24
        ),
        iterations=60,
        repeats=1,
        world_count=2,
        pool_size=8,
        steps=(8, 16),
        learning_rate=5e-3,
        milestones=(45,),
        seed_interval=4,
        out=_TEXTURE_OUT,
        log_interval=1,
        picture_interval=20,
        checkpoint_interval=20,
        tensorboard=False,
    ),
}
"""Textures: `paper` (arXiv 2601.16096, needs VGG16's weights), `fast` (on one core), `tiny`."""

POINT_CLASSIFICATION_PRESETS: Mapping[str, TrainConfig[PointClassificationConfig]] = {
    "paper": TrainConfig(
        task=PointClassificationConfig(),
        iterations=50_000,
        repeats=1,
        world_count=64,
        pool_size=1024,
        steps=(12, 24),
        learning_rate=1e-3,
        weight_decay=0.1,
        milestones=(20_000, 40_000),
        seed_interval=1,
        fresh_share=0.5,
        out=_POINTS_OUT,
    ),
    # Of clouds never seen 91 % are classified rightly, after some four minutes on one core.
    "fast": TrainConfig(
        task=PointClassificationConfig(
            stretch=0.1,
            mutated_share=0.25,
            particle_count=128,
            hidden_dim=128,
            readout_hidden_dim=64,
            eps=0.2,
            resolution=64,
        ),
        iterations=1500,
        repeats=1,
        world_count=32,
        pool_size=256,
        steps=(12, 20),
        learning_rate=2e-3,
        milestones=(1100, 1400),
        seed_interval=1,
        fresh_share=0.5,
        out=_POINTS_OUT,
        picture_interval=500,
        checkpoint_interval=300,
        tensorboard=False,
    ),
    "tiny": TrainConfig(
        task=PointClassificationConfig(
            particle_count=64,
            hidden_dim=32,
            readout_hidden_dim=32,
            eps=0.25,
            resolution=32,
        ),
        iterations=60,
        repeats=1,
        world_count=8,
        pool_size=32,
        steps=(6, 10),
        learning_rate=5e-3,
        milestones=(45,),
        seed_interval=1,
        fresh_share=0.5,
        out=_POINTS_OUT,
        log_interval=1,
        picture_interval=20,
        checkpoint_interval=20,
        tensorboard=False,
    ),
}
"""Classification of point clouds: `paper` (arXiv 2601.16096), `fast` (on one core), `tiny`."""

TASKS: Mapping[str, TaskEntry] = {
    "morphogenesis2d": TaskEntry(
        summary="grow a picture from a disk of blank particles",
        presets=MORPHOGENESIS2D_PRESETS,
        make=_make_morphogenesis2d,
        targets=_morphogenesis2d_targets,
    ),
    "morphogenesis3d": TaskEntry(
        summary="grow a thing seen from all sides from a ball of blank particles",
        presets=MORPHOGENESIS3D_PRESETS,
        make=_make_morphogenesis3d,
        targets=_morphogenesis3d_targets,
        space_dim=3,
    ),
    "texture": TaskEntry(
        summary="arrange particles all over a periodic box to a texture",
        presets=TEXTURE_PRESETS,
        make=_make_texture,
        targets=_texture_targets,
    ),
    "point_classification": TaskEntry(
        summary="particles that stay where they are agree on which digit they form",
        presets=POINT_CLASSIFICATION_PRESETS,
        make=_make_point_classification,
        targets=tuple,
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
    if task_name not in TASKS:
        raise NPAError(f"unknown task {task_name!r}: {suggest(task_name, TASKS)}")
    return TASKS[task_name]


def preset(name: str, task_name: str = "morphogenesis2d", /, **fields: Any) -> TrainConfig[Any]:
    """Return a preset with fields changed by plain name.

    Args:
        name: `paper`, `fast` or `tiny`.
        task_name: The task it is for.
        fields: New values by field name, the run's and the task's alike.

    Raises:
        NPAError: The task, the preset or a field is unknown, or a value is not allowed.
    """
    presets = task_entry(task_name).presets
    if name not in presets:
        raise NPAError(f"unknown preset {name!r} of {task_name}: {suggest(name, presets)}")
    return override(presets[name], **fields)
