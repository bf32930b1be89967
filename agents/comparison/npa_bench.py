"""NPA-Bench v0: frozen problems and budgets, and rows of results as JSON files.

There are two suites, one for a GPU and a small one for a laptop. A row is a JSON file with the
results of one method in a suite: for each problem the returns of at least `MIN_SEEDS` runs. Its
format is `npa_bench_v0.schema.json`. `docs/scripts/npa_bench_rows.py` checks and scores rows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from npa_envs.agents.comparison.plan import BudgetKind, ComparisonPlan
from npa_envs.agents.comparison.single_run import RunRecord
from npa_envs.agents.learning import methods_for
from npa_envs.agents.learning.problem import Problem, registration_of
from npa_envs.atomic_files import read_json
from npa_envs.errors import NPAError, shown
from npa_envs.measure.benchmark_records import write_record
from npa_envs.registration import GARDEN_IDS

BUDGET_KIND: BudgetKind = "particle-steps"

METHOD_DESCRIPTIONS = {
    "gradient": "descends the loss through the physics; in gardens plans by it, and learns nothing",
    "shac": "short-horizon actor-critic: gradients through few steps, a critic for the rest",
    "ppo": "PPO on the device, a likelihood for each particle",
    "ppo_world": "Stable-Baselines3's PPO, a likelihood for each world",
    "sac": "Stable-Baselines3's SAC",
    "evolution": "sep-CMA-ES over the rule's weights",
    "clone": "imitates the rule of `gradient` from the same seed, and sees no reward",
    "scripted": "the best of the scripted policies",
    "random": "acts at random",
    "zero": "does nothing",
}
"""What each method does, for the tables of rows."""

EPISODES = 32
"""Held-out episodes after a run."""

MIN_SEEDS = 5
"""Minimum number of runs of a method on a problem, from different seeds."""

SCHEMA = Path(__file__).with_name("npa_bench_v0.schema.json")

QUICK_FRACTION = 1e-3
"""Factor on the budgets of quick runs, which only test that all methods run."""

LEFT_OUT = frozenset({("npa/PointClassificationSmall-v0", "scripted")})
"""Pairs of a problem and a method that are not run: no scripted policy classifies."""


@dataclass(frozen=True)
class Suite:
    """A benchmark: problems and their budgets. A suite that is changed must have a new name."""

    name: str
    groups: Mapping[str, Mapping[str, int]]
    """Particle-steps of a run by ids of environments, in groups of problems."""

    @property
    def budgets(self) -> dict[str, int]:
        """Budget of a run [particle-steps] by environment id, for all groups."""
        return {env_id: steps for group in self.groups.values() for env_id, steps in group.items()}

    @property
    def tasks(self) -> dict[str, str]:
        """Environment ids of the problems by their `task_name`."""
        return {task_name(env_id): env_id for env_id in self.budgets}

    @property
    def methods(self) -> list[str]:
        """Names of the methods that can learn at least one problem of the suite."""
        known = [methods_for(self.problem_of(task)) for task in self.tasks]
        return [name for name in METHOD_DESCRIPTIONS if any(name in table for table in known)]

    def problem_of(self, task: str) -> Problem:
        """Return the problem of a task: the environment with 16 worlds, or a garden with 64."""
        env_id = self.tasks[task]
        steps, worlds = registration_of(env_id).steps, 64 if env_id in GARDEN_IDS else 16
        return Problem(env_id=env_id, episode_steps=steps, num_envs=worlds, hidden_dim=64)

    def leaves_out(self, task: str, method: str) -> bool:
        """Return whether a method is skipped on a task; a user's "module:function" never is."""
        if ":" in method:
            return False
        known = methods_for(self.problem_of(task))
        return method not in known or (self.tasks[task], method) in LEFT_OUT


def task_name(env_id: str) -> str:
    """Return the task name of an environment id: the id without "npa/"."""
    return env_id.removeprefix("npa/")


_PARTICLES = {
    "npa/Morphogenesis2DSmall-v0": 5_000_000,
    "npa/Regeneration2DSmall-v0": 5_000_000,
    # Less, as its loss is slow.
    "npa/TextureSmall-v0": 1_000_000,
    "npa/PointClassificationSmall-v0": 5_000_000,
    "npa/MixingSmall-v0": 5_000_000,
}

_GARDENS = {
    # 48 828 steps of an environment, of 8 steps of the rule each.
    "npa/Gardener2DSmall-v0": 100_000_000,
    "npa/Shepherd2DSmall-v0": 100_000_000,
}

_SMALL = {
    "npa/Morphogenesis2DSmall-v0": 1_000_000,
    "npa/Regeneration2DSmall-v0": 500_000,
    "npa/TextureSmall-v0": 300_000,
    "npa/PointClassificationSmall-v0": 1_000_000,
    "npa/MixingSmall-v0": 500_000,
    "npa/SegregationSmall-v0": 500_000,
    "npa/CoMorphogenesisSmall-v0": 500_000,
    "npa/SymbiosisSmall-v0": 1_500_000,
}
"""Budgets of at most a minute on a CPU core."""

SUITES: Mapping[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite("npa-bench-v0", {"particles": _PARTICLES, "gardens": _GARDENS}),
        Suite("npa-bench-small-v0", {"small": _SMALL}),
    )
}
"""Suites by name. In gardens the particle-steps are those of the rule."""


# Rows: results of methods


def write_rows(
    suite: Suite, plan: ComparisonPlan, records: Sequence[RunRecord], folder: Path, command: str
) -> list[Path]:
    """Write the runs of each method as a row of the suite, METHOD.json, and return the paths.

    Failed runs are left out. A file that exists keeps its runs of other problems and seeds; then it
    names the commands, commits, machines and versions of all its runs, separated by semicolons.
    """
    paths = []
    ended = [record for record in records if record.status != "failed"]
    for method in dict.fromkeys(record.job.method for record in ended):
        runs = [record for record in ended if record.job.method == method]
        row = {
            "benchmark": suite.name,
            "method": method,
            "about": METHOD_DESCRIPTIONS.get(method) or plan.own[method],
            "options": dict(plan.options.get(method, {})),
            "command": command,
            "date": max(record.date for record in runs),
            **{name: plan.settings[name] for name in ("machine", "commit", "versions")},
            "runs": [
                {
                    "id": suite.tasks[record.job.task],
                    "seed": record.job.seed,
                    "particle_steps": record.curve[-1].particle_steps if record.curve else 0,
                    "seconds": round(record.curve[-1].seconds, 2) if record.curve else 0.0,
                    "returns": [round(value, 5) for value in record.returns],
                    "curve": [[p.particle_steps, round(p.mean_return, 5)] for p in record.curve],
                }
                for record in runs
            ],
        }
        stored = _stored_row(suite, plan, method, folder)
        paths.append(folder / f"{method}.json")
        write_record(paths[-1], row if stored is None else _joined(suite, stored, row))
    return paths


def check_rows(suite: Suite, plan: ComparisonPlan, folder: Path) -> None:
    """Raise an NPAError if a plan's runs cannot be added to the METHOD.json files in a folder."""
    for method in plan.methods:
        _stored_row(suite, plan, method, folder)


def _stored_row(
    suite: Suite, plan: ComparisonPlan, method: str, folder: Path
) -> dict[str, Any] | None:
    """Return the row in METHOD.json, None if there is no file; raises as `check_rows` does."""
    path = folder / f"{method}.json"
    if not path.exists():
        return None
    hint = "choose another folder with --out, or remove the row"
    wanted = {"benchmark": suite.name, "method": method, "episodes": plan.episodes}
    wanted["options"] = json.loads(json.dumps(plan.options.get(method, {})))
    if method in plan.own:
        wanted["about"] = plan.own[method]
    try:
        row: dict[str, Any] = read_json(path)
        episodes = {(run["id"], run["seed"]): len(run["returns"]) for run in row["runs"]}
        if not all(isinstance(row[name], str) for name in ("machine", "commit", "command", "date")):
            raise TypeError("machine, commit, command and date must be text")
    except (TypeError, KeyError, AttributeError, NPAError) as error:
        raise NPAError(
            f"{str(path)!r} must be a row that runs can be added to, but cannot be read "
            f"({shown(error)}): {hint}"
        ) from error
    # Runs that diverged have no episodes.
    others = set(episodes.values()) - {0, plan.episodes}
    facts = {"options": {}, "episodes": max(others, default=plan.episodes)} | row
    for name, value in wanted.items():
        if facts.get(name) != value:
            raise NPAError(
                f"{str(path)!r} must have the {name} {shown(value)} for runs to be added, got "
                f"{shown(facts.get(name))}: {hint}, or give the method another name"
            )
    return row


def _joined(suite: Suite, stored: Mapping[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    """Return the new row, plus the runs of the stored row that it does not repeat."""
    new = {(run["id"], run["seed"]) for run in row["runs"]}
    old = [dict(run) for run in stored["runs"] if (run["id"], run["seed"]) not in new]
    if not old:
        return row
    added = [dict(run) for run in row["runs"]]
    for runs, machine in ((old, stored["machine"]), (added, row["machine"])):
        # In a row of several machines each run names its machine already.
        if stored["machine"] != row["machine"] and ";" not in machine:
            for run in runs:
                run.setdefault("machine", machine)
    order, runs = list(suite.budgets), [*old, *added]
    runs.sort(key=lambda run: (run["seed"], order.index(run["id"]) if run["id"] in order else -1))
    before, now = stored.get("versions", {}), row["versions"]
    versions = {
        name: _united(before.get(name, version), now.get(name, version))
        for name, version in {**before, **now}.items()
    }
    both = {name: _united(stored[name], row[name]) for name in ("command", "commit", "machine")}
    date = max(stored["date"], row["date"])
    return {**row, **both, "date": date, "versions": versions, "runs": runs}


def _united(first: str | None, second: str | None) -> str | None:
    """Merge two texts, each a list of items separated by semicolons, without duplicates."""
    if first == second:
        return first
    items = [item for text in (first, second) for item in str(text).split("; ")]
    return "; ".join(dict.fromkeys(items))
