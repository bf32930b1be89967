"""Presets of 2D morphogenesis of two species that are trained together."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from npa_envs.tasks.co_morphogenesis2d_config import CoMorphogenesis2DConfig
from npa_envs.training.config import Morphogenesis2DTrainConfig
from npa_envs.training.joint_config import JointTrainConfig
from npa_envs.training.presets2d import MORPHOGENESIS2D_PRESETS

DISTANCE = 0.8
"""Distance between the seeds' centres in every preset [length units]: the pictures overlap."""


def _beside(
    alone: Morphogenesis2DTrainConfig, neighbour: str
) -> JointTrainConfig[CoMorphogenesis2DConfig]:
    """Return a run of one species, with another one of the same kind beside it."""
    species = (alone.task, dataclasses.replace(alone.task, target=neighbour))
    run = {field.name: getattr(alone, field.name) for field in dataclasses.fields(alone)}
    run["task"] = CoMorphogenesis2DConfig(species=species, distance=DISTANCE)
    return JointTrainConfig(**run | {"out": Path("runs/co_morphogenesis2d")})


CO_MORPHOGENESIS2D_PRESETS: Mapping[str, JointTrainConfig[CoMorphogenesis2DConfig]] = {
    name: _beside(alone, "heart") for name, alone in MORPHOGENESIS2D_PRESETS.items()
}
"""Each preset of 2D morphogenesis, with as many particles of a second species: same schedule."""
