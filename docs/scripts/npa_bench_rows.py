"""Rows of NPA-Bench as files: their checks and scores. Needs the extra `bench`.

Scores are computed from rows only; the methods `zero` and `gradient` have the scores 0 and 1.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jsonschema
import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, trim_mean

from npa_envs.agents.comparison.npa_bench import MIN_SEEDS, SCHEMA, SUITES, Suite
from npa_envs.agents.comparison.plan import NOTHING, REFERENCE
from npa_envs.agents.comparison.single_run import mean_of
from npa_envs.atomic_files import read_json
from npa_envs.errors import NPAError, shown
from npa_envs.measure.benchmark_records import number

EXCESS = 1.25
"""Most particle-steps of a run over its budget, which the last iteration may exceed."""


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


def read_row(path: Path) -> BenchRow:
    """Return a row from its file."""
    row = read_json(path)
    try:
        jsonschema.validate(row, json.loads(SCHEMA.read_text("utf-8")))
    except jsonschema.ValidationError as error:
        raise NPAError(
            f"{path.name} must follow {SCHEMA.name}, but at {error.json_path} {error.message}"
        ) from error
    runs = tuple(
        BenchRun(
            env_id=run["id"],
            seed=run["seed"],
            particle_steps=run["particle_steps"],
            mean_return=mean_of(list(map(number, run["returns"]))),
            curve=tuple((at, value) for at, value in run["curve"] if value is not None),
            machine=run.get("machine", ""),
        )
        for run in row["runs"]
    )
    suite, about = SUITES[row["benchmark"]], row.get("about", "")
    read = BenchRow(suite, row["method"], runs, about, row["machine"])
    _check_row(read, path.name)
    return read


def _check_row(row: BenchRow, name: str) -> None:
    """Check the rules that are not in the schema; raises NPAError."""
    budgets = row.suite.budgets
    for run in row.runs:
        if run.machine and run.machine not in row.machine.split("; "):
            raise NPAError(
                f"{name} has a run on {shown(run.machine)} that its machine does not name, got "
                f"{shown(row.machine)}: name it there, behind a semicolon"
            )
        if run.env_id not in budgets:
            raise NPAError(
                f"{name} has runs of {run.env_id}, no problem of {row.suite.name}: leave them out"
            )
        seeds = sorted(other.seed for other in row.runs if other.env_id == run.env_id)
        if len(set(seeds)) < max(len(seeds), MIN_SEEDS):
            raise NPAError(
                f"{name} must have runs of {run.env_id} from at least {MIN_SEEDS} seeds, each "
                f"once, got {seeds}: run the missing ones"
            )
        most = EXCESS * budgets[run.env_id]
        if run.particle_steps > most:
            raise NPAError(
                f"{name} must take at most {most:.3g} particle-steps on {run.env_id}, got "
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
    for name in (NOTHING, REFERENCE):
        values = rows[name].returns(env_id) if name in rows else np.array([])
        if not np.isfinite(values).any():
            raise NPAError(f"scores of {env_id} need runs of {name!r}: run them")
        ends.append(float(np.nanmean(values)))
    nothing, reference = ends
    if not reference > nothing:
        raise NPAError(f"scores of {env_id} need {REFERENCE} to be better than {NOTHING}")
    scores = (rows[method].returns(env_id) - nothing) / (reference - nothing)
    return np.nan_to_num(scores, nan=0.0)


def interquartile_mean(*samples: NDArray[np.float64], axis: int = -1) -> Any:
    """Return the mean of the middle half of all samples together, along an axis."""
    return trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)


def score(samples: Sequence[NDArray[np.float64]], seed: int = 0) -> Score:
    """Return the interquartile mean of the problems' scores, and its 95 % interval.

    The interval is by stratified bootstrap, which resamples the runs within each problem, 2000
    times (Agarwal et al., arXiv 2108.13264).
    """
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
