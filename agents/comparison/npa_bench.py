"""NPA-Bench v0: frozen problems and budgets, rows of results as JSON files, and their scores.

There are two suites, one for a GPU and a small one for a laptop. A row contains the results of one
method in a suite: for each problem the returns of at least `MIN_SEEDS` runs. It is a JSON file by
`npa_bench_v0.schema.json`. Scores are computed from rows only; the methods `zero` and `gradient`
have the scores 0 and 1.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from npa_envs.agents.comparison.plan import NOTHING, YARDSTICK, Axis, ComparisonPlan
from npa_envs.agents.comparison.run import RunRecord
from npa_envs.agents.learning import methods_for
from npa_envs.agents.learning.problem import Problem
from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest
from npa_envs.files import read_json
from npa_envs.measure.record import number, write_record

AXIS: Axis = "particle-steps"

METHODS = {
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
"""Descriptions of the methods; problems that a method cannot learn are left out."""

EPISODES = 32
"""Held-out episodes after a run."""

MIN_SEEDS = 5
"""Least runs of a method on a problem, from different seeds."""

EXCESS = 1.25
"""Most particle-steps of a run over its budget, which the last iteration may exceed."""

SCHEMA = Path(__file__).with_name("npa_bench_v0.schema.json")


class BenchProblem(NamedTuple):
    """Fields of a `Problem`, and its budget."""

    episode_steps: int
    num_envs: int
    hidden_dim: int
    particle_steps: int


QUICK_SHARE = 1e-3
"""Factor on the budgets of quick runs, which only test that everything runs."""

LEFT_OUT = frozenset({("npa/PointClassificationSmall-v0", "scripted")})
"""Pairs of a problem and a method that are not run: no scripted policy classifies."""


@dataclass(frozen=True)
class Suite:
    """Problems and budgets by ids, in groups; a change would make another version."""

    name: str
    groups: Mapping[str, Mapping[str, BenchProblem]]

    @property
    def entries(self) -> dict[str, BenchProblem]:
        """All problems by their ids."""
        return {env_id: entry for group in self.groups.values() for env_id, entry in group.items()}

    @property
    def tasks(self) -> dict[str, str]:
        """Ids by task names."""
        return {task_name(env_id): env_id for env_id in self.entries}

    @property
    def methods(self) -> list[str]:
        """Methods that can learn at least one of the problems."""
        suited = [methods_for(self.problem_of(task)) for task in self.tasks]
        return [name for name in METHODS if any(name in table for table in suited)]

    def problem_of(self, task: str) -> Problem:
        """Return the problem of a task name."""
        if task not in self.tasks:
            raise NPAError(
                f"unknown task {shown(task)} of {self.name}: {suggest(task, self.tasks)}"
            )
        env_id = self.tasks[task]
        fields = self.entries[env_id]._asdict()
        del fields["particle_steps"]
        return Problem(env_id=env_id, **fields)

    def leaves_out(self, task: str, method: str) -> bool:
        """Return whether a method cannot learn a task; "module:function" can learn any."""
        if ":" in method:
            return False
        known = methods_for(self.problem_of(task))
        return method not in known or (self.tasks[task], method) in LEFT_OUT

    def budget_of(self, task: str, *, quick: bool = False) -> float:
        """Return the particle-steps of a run."""
        return self.entries[self.tasks[task]].particle_steps * (QUICK_SHARE if quick else 1.0)


def task_name(env_id: str) -> str:
    """Return the task name of an id: without "npa/"."""
    return env_id.removeprefix("npa/")


_PARTICLES = {
    "npa/Morphogenesis2DSmall-v0": BenchProblem(32, 16, 64, 5_000_000),
    "npa/Regeneration2DSmall-v0": BenchProblem(24, 16, 64, 5_000_000),
    # Less, as its loss is slow.
    "npa/TextureSmall-v0": BenchProblem(24, 16, 64, 1_000_000),
    "npa/PointClassificationSmall-v0": BenchProblem(16, 16, 64, 5_000_000),
    "npa/MixingSmall-v0": BenchProblem(32, 16, 64, 5_000_000),
}

_GARDENS = {
    # 48 828 steps of an environment, of 8 steps of the rule each.
    "npa/Gardener2DSmall-v0": BenchProblem(32, 64, 64, 100_000_000),
    "npa/Shepherd2DSmall-v0": BenchProblem(32, 64, 64, 100_000_000),
}

_SMALL = {
    "npa/Morphogenesis2DSmall-v0": BenchProblem(32, 16, 64, 1_000_000),
    "npa/Regeneration2DSmall-v0": BenchProblem(24, 16, 64, 500_000),
    "npa/TextureSmall-v0": BenchProblem(24, 16, 64, 300_000),
    "npa/PointClassificationSmall-v0": BenchProblem(16, 16, 64, 1_000_000),
    "npa/MixingSmall-v0": BenchProblem(32, 16, 64, 500_000),
    "npa/SegregationSmall-v0": BenchProblem(32, 16, 64, 500_000),
    "npa/CoMorphogenesisSmall-v0": BenchProblem(32, 16, 64, 500_000),
    "npa/SymbiosisSmall-v0": BenchProblem(32, 16, 64, 1_500_000),
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


@dataclass(frozen=True)
class BenchRun:
    """The result of one run."""

    env_id: str
    seed: int
    particle_steps: float
    mean_return: float
    """Mean return of the held-out episodes; NaN where it diverged."""
    curve: tuple[tuple[float, float], ...] = ()
    """Pairs of particle-steps and the mean return of evaluation episodes."""
    machine: str = ""
    """Machine of the run, in a row of several machines."""


@dataclass(frozen=True)
class BenchRow:
    """The results of a method in a suite."""

    suite: Suite
    method: str
    runs: tuple[BenchRun, ...]
    about: str = ""
    machine: str = ""
    """Machines of the runs, separated by semicolons."""

    def returns(self, env_id: str) -> NDArray[np.float64]:
        """Return the mean returns of the runs on a problem, in the order of their seeds."""
        found = sorted((run for run in self.runs if run.env_id == env_id), key=lambda r: r.seed)
        return np.array([run.mean_return for run in found])


def write_rows(
    suite: Suite, plan: ComparisonPlan, records: Sequence[RunRecord], folder: Path, command: str
) -> list[Path]:
    """Write METHOD.json for each method of a suite's plan, and return the paths.

    Runs of other problems and seeds in an existing file are kept. It then names the commands,
    commits, machines and versions of all of its runs, separated by semicolons.
    """
    paths = []
    for method in dict.fromkeys(record.job.method for record in records):
        some = [r for r in records if r.job.method == method and r.status != "failed"]
        if some:
            paths.append(folder / f"{method}.json")
            row = {
                "benchmark": suite.name,
                "method": method,
                "about": METHODS.get(method) or plan.own[method],
                "options": dict(plan.options.get(method, {})),
                "command": command,
                "date": max(record.date for record in some),
                **{name: plan.settings[name] for name in ("machine", "commit", "versions")},
                "runs": [
                    {
                        "id": suite.tasks[record.job.task],
                        "seed": record.job.seed,
                        "particle_steps": record.curve[-1].particle_steps if record.curve else 0,
                        "seconds": round(record.curve[-1].seconds, 2) if record.curve else 0.0,
                        "returns": [round(value, 5) for value in record.returns],
                        "curve": [
                            [p.particle_steps, round(p.mean_return, 5)] for p in record.curve
                        ],
                    }
                    for record in some
                ],
            }
            held = _held_row(suite, plan, method, folder)
            write_record(paths[-1], row if held is None else _joined(suite, held, row))
    return paths


def check_rows(suite: Suite, plan: ComparisonPlan, folder: Path) -> None:
    """Check that runs of a plan can be added to the rows in a folder."""
    for method in plan.methods:
        _held_row(suite, plan, method, folder)


def _held_row(
    suite: Suite, plan: ComparisonPlan, method: str, folder: Path
) -> dict[str, Any] | None:
    """Return a method's row in a folder as JSON, or None; raises if runs cannot be added."""
    path = folder / f"{method}.json"
    if not path.exists():
        return None
    cure = "choose another folder with --out, or remove the row"
    wanted = {"benchmark": suite.name, "method": method}
    wanted["options"] = json.loads(json.dumps(plan.options.get(method, {})))
    if method in plan.own:
        wanted["about"] = plan.own[method]
    try:
        held: dict[str, Any] = read_json(path)
        found = {"options": {}} | held
        lengths = {len(run["returns"]) for run in held["runs"]}
        for run in held["runs"]:
            run["id"], run["seed"]
        texts = [held[name] for name in ("machine", "commit", "command", "date")]
        if not all(isinstance(text, str) for text in texts):
            raise TypeError("machine, commit, command and date must be text")
    except (TypeError, KeyError, AttributeError, NPAError) as error:
        raise NPAError(
            f"{str(path)!r} must be a row that runs can be added to, but cannot be read "
            f"({shown(error)}): {cure}"
        ) from error
    for name, value in wanted.items():
        if found.get(name) != value:
            raise NPAError(
                f"{str(path)!r} must have the {name} {shown(value)} for runs to be added, got "
                f"{shown(found.get(name))}: {cure}, or give the method a name of its own"
            )
    if lengths - {0, plan.episodes}:
        raise NPAError(
            f"{str(path)!r} must have runs of {plan.episodes} episodes for runs to be added, got "
            f"{max(lengths)}: {cure}"
        )
    return held


def _joined(suite: Suite, held: Mapping[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    """Return `row` with the runs of the stored row `held` added that it lacks."""
    new = {(run["id"], run["seed"]) for run in row["runs"]}
    kept = [dict(run) for run in held["runs"] if (run["id"], run["seed"]) not in new]
    if not kept:
        return row
    added = [dict(run) for run in row["runs"]]
    for some, machine in ((kept, held["machine"]), (added, row["machine"])):
        # In a row of several machines each run names its machine already.
        if held["machine"] != row["machine"] and ";" not in machine:
            for run in some:
                run.setdefault("machine", machine)
    order, runs = list(suite.entries), [*kept, *added]
    runs.sort(key=lambda run: (run["seed"], order.index(run["id"]) if run["id"] in order else -1))
    before, now = held.get("versions", {}), row["versions"]
    versions = {
        name: _both(before.get(name, version), now.get(name, version))
        for name, version in {**before, **now}.items()
    }
    both = {name: _both(held[name], row[name]) for name in ("command", "commit", "machine")}
    date = max(held["date"], row["date"])
    return {**row, **both, "date": date, "versions": versions, "runs": runs}


def _both(first: str | None, second: str | None) -> str | None:
    """Join two lists that are separated by semicolons, without duplicates."""
    if first == second:
        return first
    parts = [part for text in (first, second) for part in str(text).split("; ")]
    return "; ".join(dict.fromkeys(parts))


def read_row(path: Path) -> BenchRow:
    """Return a row from its file."""
    try:
        import jsonschema
    except ImportError as error:
        raise MissingDependencyError(
            "rows are checked by jsonschema, which is not installed: pip install 'npa-envs[bench]'"
        ) from error
    held = read_json(path)
    try:
        jsonschema.validate(held, json.loads(SCHEMA.read_text("utf-8")))
    except jsonschema.ValidationError as error:
        raise NPAError(
            f"{path.name} must follow {SCHEMA.name}, but at {error.json_path} {error.message}"
        ) from error
    runs = tuple(map(_read_run, held["runs"]))
    suite, about = SUITES[held["benchmark"]], held.get("about", "")
    row = BenchRow(suite, held["method"], runs, about, held["machine"])
    _check_row(row, path.name)
    return row


def _read_run(held: Mapping[str, Any]) -> BenchRun:
    returns = [number(value) for value in held["returns"]]
    mean = sum(returns) / len(returns) if returns else math.nan
    curve = tuple((at, value) for at, value in held["curve"] if value is not None)
    machine = held.get("machine", "")
    return BenchRun(held["id"], held["seed"], held["particle_steps"], mean, curve, machine)


def _check_row(row: BenchRow, name: str) -> None:
    """Check the rules that are not in the schema; raises NPAError."""
    entries = row.suite.entries
    for run in row.runs:
        if run.machine and run.machine not in row.machine.split("; "):
            raise NPAError(
                f"{name} has a run on {shown(run.machine)} that its machine does not name, got "
                f"{shown(row.machine)}: name it there, behind a semicolon"
            )
    for env_id in dict.fromkeys(run.env_id for run in row.runs):
        if env_id not in entries:
            raise NPAError(
                f"{name} has runs of {env_id}, no problem of {row.suite.name}: leave them out"
            )
        some = [run for run in row.runs if run.env_id == env_id]
        seeds = {run.seed for run in some}
        if len(seeds) < len(some) or len(seeds) < MIN_SEEDS:
            raise NPAError(
                f"{name} must have runs of {env_id} from at least {MIN_SEEDS} seeds, each once, "
                f"got {sorted(run.seed for run in some)}: run the missing ones"
            )
        most = EXCESS * entries[env_id].particle_steps
        for run in some:
            if run.particle_steps > most:
                raise NPAError(
                    f"{name} must take at most {most:.3g} particle-steps on {env_id}, got "
                    f"{run.particle_steps:.3g} from seed {run.seed}: learn from fewer"
                )


def read_rows(suite: Suite, folder: Path) -> dict[str, BenchRow]:
    """Return all rows of a suite's folder by method."""
    rows: dict[str, BenchRow] = {}
    for path in sorted(folder.glob("*.json")):
        row = read_row(path)
        if row.suite is not suite:
            raise NPAError(
                f"{path} must be a row of {suite.name} like its folder, got {row.suite.name}: "
                "put it into the folder of its suite"
            )
        if row.method in rows:
            raise NPAError(f"{path.name} is a second row of {row.method!r}: name the method anew")
        rows[row.method] = row
    return rows


# Scores


class Score(NamedTuple):
    """An interquartile mean of normalised returns, with its 95 % interval."""

    middle: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.middle:.2f} [{self.low:.2f}, {self.high:.2f}]"


def normalised(rows: Mapping[str, BenchRow], method: str, env_id: str) -> NDArray[np.float64]:
    """Return the score of each run: (R − R_zero) / (R_gradient − R_zero) of mean returns R.

    R_zero and R_gradient are means over their runs. A run that diverged has the score 0.
    """
    ends = []
    for name in (NOTHING, YARDSTICK):
        values = rows[name].returns(env_id) if name in rows else np.array([])
        if not np.isfinite(values).any():
            raise NPAError(f"scores of {env_id} need runs of {name!r}: run them")
        ends.append(float(np.nanmean(values)))
    nothing, yardstick = ends
    if not yardstick > nothing:
        raise NPAError(f"scores of {env_id} need {YARDSTICK} to be better than {NOTHING}")
    scores = (rows[method].returns(env_id) - nothing) / (yardstick - nothing)
    return np.nan_to_num(scores, nan=0.0)


def interquartile_mean(*samples: NDArray[np.float64], axis: int = -1) -> Any:
    """Return the mean of the middle half of all samples together, along an axis."""
    from scipy.stats import trim_mean

    return trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)


def score(samples: Sequence[NDArray[np.float64]], seed: int = 0) -> Score:
    """Return the interquartile mean of the problems' scores, and its 95 % interval.

    The interval is by stratified bootstrap, which resamples the runs within each problem, 2000
    times (Agarwal et al., arXiv 2108.13264).
    """
    try:
        from scipy.stats import bootstrap
    except ImportError as error:
        raise MissingDependencyError(
            "scores need SciPy, which is not installed: pip install 'npa-envs[bench]'"
        ) from error
    middle = float(interquartile_mean(*samples))
    if all(np.ptp(values) == 0.0 for values in samples):
        return Score(middle, middle, middle)
    draws = np.random.default_rng(seed)
    how: dict[str, Any] = {"n_resamples": 2000, "method": "percentile", "rng": draws}
    low, high = bootstrap(samples, interquartile_mean, **how).confidence_interval
    return Score(middle, float(low), float(high))


def scores_in(
    rows: Mapping[str, BenchRow], method: str, env_ids: Iterable[str]
) -> dict[str, NDArray[np.float64]]:
    """Return the scores of a method's runs by problem, for the problems that it has runs of."""
    return {
        env_id: normalised(rows, method, env_id)
        for env_id in env_ids
        if len(rows[method].returns(env_id))
    }
