"""The plan of a comparison: its tasks, its runs (`Job`) and their budgets.

Tasks are small enough for all methods: worlds are smaller and episodes shorter than the paper's,
for many episodes a minute. States have few channels and change in small steps: less to explore.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import Any, Literal, get_args

from npa_envs.agents.learning.problem import Problem
from npa_envs.measure.process_queue import part_of

GROWTH_KEYWORDS = {
    "target": "heart", "particle_count": 512, "state_dim": 8, "eps": 0.12, "eps0": 0.12,
    "state_scale": 0.1, "colour_weight": 20.0,
}  # fmt: skip
"""Keywords of the tasks "morphogenesis2d" and "regeneration2d"."""

PROBLEMS: Mapping[str, Mapping[str, Any]] = {
    "morphogenesis2d": {
        "env_id": "npa/Morphogenesis2D-v0", "episode_steps": 48, "hidden_dim": 64,
        "keywords": {**GROWTH_KEYWORDS, "seed_radius": 0.4},
    },
    "regeneration2d": {
        "env_id": "npa/Regeneration2D-v0", "episode_steps": 32, "hidden_dim": 64,
        "keywords": {**GROWTH_KEYWORDS, "rule": "picture", "damage": "wipe", "damage_size": 0.4},
    },
    "point_classification": {
        "env_id": "npa/PointClassification-v0", "episode_steps": 24, "hidden_dim": 128,
        "keywords": {
            "particle_count": 256, "state_dim": 16, "state_scale": 0.1, "eps": 0.3, "eps0": 0.3
        },
    },
    "mixing": {
        "env_id": "npa/Mixing-v0", "episode_steps": 48, "hidden_dim": 64,
        "keywords": {
            "species_count": 2, "particle_count": 512, "state_dim": 8, "state_scale": 0.1,
            "perception": "per_species",
        },
    },
}  # fmt: skip
"""Fields of the task's `Problem` by the name of the task."""

WIDER = {"eps": 0.2, "eps0": 0.2}
QUICK_KEYWORDS: Mapping[str, Mapping[str, Any]] = {
    "morphogenesis2d": {**WIDER, "resolution": 32},
    "regeneration2d": {**WIDER, "resolution": 32},
    "mixing": WIDER,
}
"""Keywords that `make_problem` changes with `quick`, by task."""

LEFT_OUT = frozenset({("point_classification", "scripted")})
"""Pairs (task, method) that do not run by default: no scripted policy classifies."""


def make_problem(name: str, *, quick: bool = False) -> Problem:
    """Return the problem of a task in `PROBLEMS`; `quick`: 4 worlds of 64 particles, 16 steps."""
    fields = {"num_envs": 32, **PROBLEMS[name]}
    if quick:
        keywords = {**fields["keywords"], "particle_count": 64, **QUICK_KEYWORDS.get(name, {})}
        fields |= {"keywords": keywords, "episode_steps": 16, "num_envs": 4, "hidden_dim": 16}
    return Problem(**fields)


# Every method on every task, from every seed, within every budget.

NOTHING, REFERENCE = "zero", "gradient"
"""Methods whose mean returns have the scores 0 and 1: doing nothing, and the reference method."""

BudgetKind = Literal["seconds", "particle-steps"]
"""What a run's budget limits: wall time [s], or particle-steps."""

BUDGET_KINDS: tuple[BudgetKind, ...] = get_args(BudgetKind)


@dataclass(frozen=True)
class Job:
    """One run: a method on a task of the plan, from a seed; `axis` is the kind of its budget."""

    axis: BudgetKind
    task: str
    method: str
    seed: int

    @property
    def folder(self) -> PurePosixPath:
        """Folder of the run's results, relative to the folder of the comparison."""
        return PurePosixPath(self.axis, self.task, self.method, f"seed-{self.seed}")

    def __str__(self) -> str:
        return str(self.folder)


@dataclass(frozen=True, kw_only=True)
class ComparisonPlan:
    """Tasks, methods, seeds, budgets and settings of a comparison, which fix its results."""

    tasks: Mapping[str, Mapping[str, Any]]
    """Problems as JSON (`Problem.to_json`), by their names."""
    methods: Sequence[str]
    seeds: Sequence[int]
    budgets: Mapping[BudgetKind, Mapping[str, float]]
    """Seconds or particle-steps of each run, by kind of budget and task."""
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Options of methods, by method; other options have the methods' defaults."""
    own: Mapping[str, str] = field(default_factory=dict)
    """Methods that the user named: name -> a known method, or "module:function"."""
    left_out: Collection[tuple[str, str]] = ()
    """Pairs (task, method) that are not run."""
    episodes: int = 32
    """Held-out episodes after each run."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Other settings that results depend on: device, machine, runs at once, commit, versions."""

    def jobs(self) -> list[Job]:
        """Return all runs of the comparison: by kind of budget, then by seed."""
        return [
            Job(axis, task, method, seed)
            for axis in self.budgets
            for seed in self.seeds
            for task in self.tasks
            for method in self.methods
            if (task, method) not in self.left_out
        ]

    def part(self, part: str | None) -> list[Job]:
        """Return the runs that machine K of N does, for `part` "K/N"; None: all runs.

        All methods on a task from a seed run on one machine, as some use rules that others learned.
        """
        return part_of(self.jobs(), part, lambda job: (job.axis, job.seed, job.task))

    def teacher(self, job: Job) -> Job | None:
        """Return the "gradient" run whose rules a "clone" run imitates; None for other runs."""
        if self.own.get(job.method, job.method) != "clone":
            return None
        if "teacher" in self.options.get(job.method, {}):
            return None
        return replace(job, method="gradient")

    def facts(self, job: Job) -> dict[str, Any]:
        """Return all settings that the results of a run depend on, by name, of JSON's types."""
        return {
            "problem": dict(self.tasks[job.task]),
            "budget": self.budgets[job.axis][job.task],
            "method": self.own.get(job.method, job.method),
            "options": dict(self.options.get(job.method, {})),
            "episodes": self.episodes,
            **self.settings,
        }
