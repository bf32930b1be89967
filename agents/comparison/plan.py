"""What a comparison runs: every method on every task, from every seed, within every budget."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any, Literal, get_args

Axis = Literal["seconds", "particle-steps"]
"""What a comparison holds equal for all methods: wall time, or particle-steps."""

AXES: tuple[Axis, ...] = get_args(Axis)


@dataclass(frozen=True)
class Job:
    """One run: a method on a task, from a seed, within a budget along one axis."""

    axis: Axis
    """What its budget is counted in."""
    task: str
    """Name of the task, from `npa_envs.agents.comparison.problems.PROBLEMS`."""
    method: str
    """Name of the method, from `npa_envs.agents.learning.METHODS`."""
    seed: int
    """Of the rule's first weights, of training's worlds and of everything that is drawn."""

    @property
    def folder(self) -> PurePosixPath:
        """Where its results lie, below the comparison's folder."""
        return PurePosixPath(self.axis, self.task, self.method, f"seed-{self.seed}")

    def __str__(self) -> str:
        return str(self.folder)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A whole comparison."""

    tasks: Mapping[str, Mapping[str, Any]]
    """Problems as JSON (`Problem.to_json`), by their names."""
    methods: Sequence[str]
    """Methods."""
    seeds: Sequence[int]
    """Seeds."""
    budgets: Mapping[Axis, float]
    """Seconds or particle-steps that each run may take, by axis."""
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Keyword options by method; others run with their defaults."""
    left_out: Collection[tuple[str, str]] = ()
    """Pairs (task, method) that are not run, as the method has nothing for the task."""
    episodes: int = 32
    """Held-out episodes that tell what a run has reached."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What else figures follow from: device, machine, runs at once, commit, versions."""

    def jobs(self) -> list[Job]:
        """Return all runs, one seed after the other: what is whole first is whole for all."""
        return [
            Job(axis, task, method, seed)
            for axis in self.budgets
            for seed in self.seeds
            for task in self.tasks
            for method in self.methods
            if (task, method) not in self.left_out
        ]

    def facts(self, job: Job) -> dict[str, Any]:
        """Return what the figures of a run follow from, as JSON has it.

        Args:
            job: One of `jobs()`.
        """
        return {
            "problem": dict(self.tasks[job.task]),
            "budget": self.budgets[job.axis],
            "options": dict(self.options.get(job.method, {})),
            "episodes": self.episodes,
            **self.settings,
        }
