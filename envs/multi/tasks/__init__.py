"""The table of tasks of several species, and of their ids."""

from __future__ import annotations

from typing import Any

from npa_envs.envs.multi.task import SpeciesTask
from npa_envs.envs.multi.tasks.mixing import MixingTask, SegregationTask
from npa_envs.envs.multi.tasks.pictures import CoMorphogenesisTask, InvasionTask, SymbiosisTask
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.registration import SPECIES_SIZES

TASKS: dict[str, type[SpeciesTask]] = {
    "mixing": MixingTask,
    "segregation": SegregationTask,
    "co_morphogenesis": CoMorphogenesisTask,
    "invasion": InvasionTask,
    "symbiosis": SymbiosisTask,
}
"""Tasks by the names that environments take."""


ENVIRONMENTS = {
    "npa/Mixing-v0": "mixing",
    "npa/Segregation-v0": "segregation",
    "npa/CoMorphogenesis-v0": "co_morphogenesis",
    "npa/Invasion-v0": "invasion",
    "npa/Symbiosis-v0": "symbiosis",
}
"""Tasks by the ids that `pettingzoo.make` takes."""


def task_settings(name: str) -> tuple[str, dict[str, Any]]:
    """Return the task that an id means, and its keywords; a task's name means itself."""
    for size in SPECIES_SIZES:
        if name == size.id:
            return size.task, dict(size.keywords)
    return (ENVIRONMENTS.get(name, name) if isinstance(name, str) else name), {}


def task_type(name: str) -> type[SpeciesTask]:
    """Return a task's class."""
    if not isinstance(name, str) or name not in TASKS:
        known = [*TASKS, *ENVIRONMENTS, *(size.id for size in SPECIES_SIZES)]
        raise NPAError(f"task must be a known word, got {shown(name)}: {suggest(name, known)}")
    return TASKS[name]
