"""Options of `npa-envs train` for tasks of several species: flat, although configurations nest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import tyro

from npa_envs.errors import NPAError
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.training import JointTrainConfig

LaunchT = TypeVar("LaunchT")


@dataclass(frozen=True, kw_only=True)
class SpeciesOptions(Morphogenesis2DConfig):
    """What all species share is said once; a --config file says it species by species."""

    target: tyro.conf.Suppress[str] = "gecko"

    particle_count: int = 4096
    """Particles of each species."""

    targets: tuple[str, ...] = ()
    """What each species grows: built-in names, emoji, or paths of pictures, two or more."""

    distance: float = 0.0
    """Distance between the centres of neighbouring seeds, which lie in a row [length units]."""


@dataclass(frozen=True, kw_only=True)
class JointOptions(JointTrainConfig[SpeciesOptions]):
    """A training run of several rules in one world; what is said of a species holds for all."""

    initial_rule: tyro.conf.Suppress[str] = ""


def parse_joint(
    base: JointTrainConfig[CoMorphogenesis2DConfig],
    read: Callable[[JointOptions], tuple[LaunchT, JointOptions]],
) -> tuple[LaunchT, JointTrainConfig[CoMorphogenesis2DConfig]]:
    """Return what the command line says of a run of several species.

    Args:
        base: The defaults.
        read: Reads the command line over these defaults.

    Raises:
        NPAError: There are fewer than two targets.
    """
    task = base.task
    # Once for each species, so that what is not said stays as it is in each of them.
    launch, told = read(_flat(base, task, 0))
    targets = told.task.targets
    if len(targets) < 2:
        raise NPAError(f"targets must be two or more, got {len(targets)}: --targets ring heart")
    species = []
    for number, target in enumerate(targets):
        _, own = read(_flat(base, task, min(number, len(task.species) - 1)))
        species.append(_of_type(Morphogenesis2DConfig, replace(own.task, target=target)))
    together = replace(task, species=tuple(species), distance=told.task.distance)
    return launch, _of_type(JointTrainConfig, told, task=together)


def _flat(
    base: JointTrainConfig[CoMorphogenesis2DConfig], task: CoMorphogenesis2DConfig, number: int
) -> JointOptions:
    """Return a configuration as options, with the fields of one species for all."""
    targets = tuple(config.target for config in task.species)
    options = _of_type(
        SpeciesOptions, task.species[number], targets=targets, distance=task.distance
    )
    flat: JointOptions = _of_type(JointOptions, base, task=options)
    return flat


def _of_type(kind: Any, source: Any, **others: Any) -> Any:
    """Return a dataclass with the fields that another one has, and others."""
    own = {field.name for field in fields(kind)}
    same = {f.name: getattr(source, f.name) for f in fields(source) if f.name in own}
    return kind(**same | others)
