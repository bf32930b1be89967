"""NPA-Bench: rows are files that anybody can write, and scores follow from them alone."""

import dataclasses
import json
import math

import numpy as np
import pytest
from support.refusals import refused

from npa_envs.agents.comparison.npa_bench import SUITES, check_rows, write_rows
from npa_envs.agents.comparison.single_run import RunRecord
from npa_envs.agents.learning import CurvePoint, methods_for
from npa_envs.cli import main
from npa_envs.cli.compare import CompareOptions, make_plan
from npa_envs.errors import NPAError
from npa_envs.registration import SIZES, SPECIES_SIZES

pytest.importorskip("jsonschema")
pytest.importorskip("scipy")
from npa_bench_rows import BenchRow, BenchRun, normalised, read_row, read_rows, score, scores_in

SUITE, SMALL_SUITE = SUITES["npa-bench-v0"], SUITES["npa-bench-small-v0"]
FIRST = next(iter(SUITE.budgets))


def row(method: str, *means: float, env_id: str = FIRST) -> BenchRow:
    return BenchRow(
        SUITE, method, tuple(BenchRun(env_id, k, 0.0, mean) for k, mean in enumerate(means))
    )


def plan_of(suite="npa-bench-v0", **changes):
    return make_plan(CompareOptions(suite=suite, commit="c0ffee", **changes))


def records(plan, status="done"):
    """A record of each of a plan's runs: its seed is what it returned."""
    return [
        RunRecord(
            job=job,
            facts=plan.facts(job),
            status=status,
            returns=(float(job.seed),) * plan.episodes,
            curve=(CurvePoint(0.0, 0.0, -1.0, 0.1, 1.0), CurvePoint(2.0, 1000.0, 0.5, 0.1, 1.0)),
            date="2026-01-02",
        )
        for job in plan.jobs()
    ]


@pytest.fixture
def zero_row(tmp_path):
    """A plan of one method, and the file of its row."""
    plan = plan_of(methods=("zero",))
    (path,) = write_rows(SUITE, plan, records(plan), tmp_path, "first")
    return plan, path


def changed(path, change) -> None:
    data = json.loads(path.read_text(encoding="utf-8"))
    change(data)
    path.write_text(json.dumps(data), encoding="utf-8")


@pytest.mark.parametrize("suite", SUITES.values(), ids=SUITES)
def test_a_suite_is_every_method_on_all_that_it_can_learn_within_the_frozen_budgets(suite):
    plan = plan_of(suite.name)
    assert set(plan.tasks) == set(suite.tasks)
    assert (list(plan.seeds), plan.episodes) == ([0, 1, 2, 3, 4], 32)
    for task, env_id in suite.tasks.items():
        assert plan.budgets["particle-steps"][task] == suite.budgets[env_id]
        problem = suite.problem_of(task)
        ran = {job.method for job in plan.jobs() if job.task == task}
        assert ran <= methods_for(problem).keys()
        assert {"zero", "gradient", "random", "ppo_world"} <= ran
        assert ("sac" in ran) == (problem.controlled == "brushes")


def test_the_small_suite_is_all_small_worlds_that_rules_act_in():
    small = {row.id for row in (*SIZES, *SPECIES_SIZES) if "Small" in row.id}
    # The reference method is a gradient, and where one side pays for the other there is none.
    small.remove("npa/InvasionSmall-v0")
    assert set(SMALL_SUITE.budgets) == small


# Rows


def test_rows_come_back_from_their_files(tmp_path):
    plan = plan_of(methods=("zero", "random"))
    (first, second) = write_rows(SUITE, plan, records(plan), tmp_path, "it")
    assert (first.name, second.name) == ("random.json", "zero.json")
    rows = read_rows(SUITE, tmp_path)
    assert list(rows) == ["random", "zero"]
    for env_id in SUITE.budgets:
        assert rows["zero"].returns(env_id).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert rows["zero"].runs[0].curve == ((0.0, -1.0), (1000.0, 0.5))
    data = json.loads(first.read_text(encoding="utf-8"))
    assert (data["commit"], data["command"], data["date"]) == ("c0ffee", "it", "2026-01-02")
    (tmp_path / "again.json").write_bytes(second.read_bytes())
    refused("second row of 'zero'", read_rows, SUITE, tmp_path)


def test_a_row_of_ones_own_says_what_was_run(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    code = "def train(progress, *, patience=1): progress.start(progress.first_rules())"
    (tmp_path / "still.py").write_text(code, encoding="utf-8")
    plan = plan_of(
        SMALL_SUITE.name,
        methods=("zero", "still=still:train", "bold=ppo"),
        options=("bold.particle_rewards=marginal", "still.patience=2"),
        tasks=("MixingSmall-v0",),
    )
    assert plan.methods == ["zero", "still", "bold"]
    assert {plan.facts(job)["method"] for job in plan.jobs()} == {"zero", "still:train", "ppo"}
    write_rows(SMALL_SUITE, plan, records(plan), tmp_path, "it")
    rows = read_rows(SMALL_SUITE, tmp_path)
    assert (rows["still"].about, rows["bold"].about) == ("still:train", "ppo")
    data = json.loads((tmp_path / "bold.json").read_text(encoding="utf-8"))
    assert data["options"] == {"particle_rewards": "marginal"}
    refused("must be a row of npa-bench-v0", read_rows, SUITE, tmp_path)


def test_a_run_that_failed_is_in_no_row_and_one_that_diverged_has_no_returns(tmp_path):
    plan = plan_of(methods=("zero",))
    some = records(plan)
    some[0] = RunRecord(job=some[0].job, facts={}, status="failed")
    (path,) = write_rows(SUITE, plan, some, tmp_path, "it")
    assert len(json.loads(path.read_text(encoding="utf-8"))["runs"]) == len(some) - 1
    some[0] = RunRecord(job=some[0].job, facts={}, status="diverged", date="2026-01-01")
    write_rows(SUITE, plan, some, tmp_path, "it")
    found = read_row(path)
    assert math.isnan(next(run for run in found.runs if run.seed == some[0].job.seed).mean_return)


BROKEN = [
    (lambda data: data.pop("machine"), "'machine' is a required property"),
    (lambda data: data.update(benchmark="npa-bench-v1"), "is not one of"),
    (lambda data: data["runs"][0].update(returns=[1.0]), r"\$.runs\[0\].returns"),
    (lambda data: data["runs"][0].update(id="npa/Other-v0"), "no problem of npa-bench-v0"),
    (lambda data: data["runs"].pop(), "from at least 5 seeds"),
    (lambda data: data["runs"][0].update(seed=1), "each once"),
    (lambda data: data["runs"][0].update(particle_steps=1e12), "at most"),
    (lambda data: data["runs"][0].update(machine="abacus"), "its machine does not name"),
]
OTHER = [
    (lambda data: data.update(benchmark="npa-bench-small-v0"), "must have the benchmark"),
    (lambda data: data.update(options={"a": 1}), r"must have the options \{\} for runs to be"),
    (lambda data: data.update(about="other:train"), "must have the about 'zero'"),
    (lambda data: data["runs"][0].update(returns=[1.0]), "must have the episodes 32"),
    (lambda data: data.pop("runs"), "cannot be read"),
    (lambda data: data["runs"][0].pop("seed"), "cannot be read"),
    (lambda data: data.update(machine=None), "cannot be read"),
]


@pytest.mark.parametrize(
    ("adding", "change", "words"),
    [(False, *row) for row in BROKEN] + [(True, *row) for row in OTHER],
)
def test_a_row_that_breaks_a_rule_or_is_of_something_else_is_refused(
    tmp_path, adding, change, words
):
    plan = plan_of(methods=("mine=zero" if adding else "zero",))
    check_rows(SUITE, plan, tmp_path)
    (path,) = write_rows(SUITE, plan, records(plan), tmp_path, "it")
    check_rows(SUITE, plan, tmp_path)
    changed(path, change)
    given = (check_rows, SUITE, plan, tmp_path) if adding else (read_row, path)
    refused(words, *given)


def test_a_narrower_call_keeps_the_rest_of_a_row(zero_row, tmp_path):
    plan, path = zero_row
    whole = json.loads(path.read_text(encoding="utf-8"))
    fewer = plan_of(methods=("zero",), tasks=("MixingSmall-v0",))
    settings = fewer.settings | {"commit": "decade", "machine": "abacus"}
    fewer = dataclasses.replace(fewer, settings=settings)
    write_rows(SUITE, fewer, records(fewer), tmp_path, "second")
    data = json.loads(path.read_text(encoding="utf-8"))
    assert (data["command"], data["commit"]) == ("first; second", "c0ffee; decade")
    assert data["machine"] == f"{whole['machine']}; abacus"
    assert data["versions"] == whole["versions"]
    assert [(run["id"], run["seed"]) for run in data["runs"]] == [
        (run["id"], run["seed"]) for run in whole["runs"]
    ]
    read = read_row(path)
    where = {run.env_id: run.machine for run in read.runs}
    assert where.pop("npa/MixingSmall-v0") == "abacus"
    assert set(where.values()) == {whole["machine"]}
    # What holds all of it takes its place.
    write_rows(SUITE, plan, records(plan), tmp_path, "first")
    assert json.loads(path.read_text(encoding="utf-8")) == whole


# Scores


def test_scores_count_from_nothing_to_the_gradient():
    rows = {
        "zero": row("zero", 1.0, 1.0),
        "gradient": row("gradient", 2.0, 4.0),
        "ppo": row("ppo", 2.0, 1.0, 5.0, math.nan),
    }
    assert normalised(rows, "ppo", FIRST).tolist() == [0.5, 0.0, 2.0, 0.0]
    assert normalised(rows, "gradient", FIRST).mean() == 1.0
    assert list(scores_in(rows, "ppo", SUITE.budgets)) == [FIRST]
    with pytest.raises(NPAError, match="need runs of 'gradient'"):
        normalised({"zero": rows["zero"], "ppo": rows["ppo"]}, "ppo", FIRST)
    refused("better than zero", normalised, {**rows, "gradient": rows["zero"]}, "ppo", FIRST)


def test_a_score_is_the_mean_of_the_middle_half_and_its_interval_shrinks_with_more_seeds():
    found = score([np.array([0.0, 1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0, 100.0])])
    assert found.middle == 3.5
    assert 1.0 < found.low < found.middle < found.high < 36.0
    assert str(score([np.array([0.5, 0.5])])) == "0.50 [0.50, 0.50]"
    draws = np.random.default_rng(0).normal(0.6, 0.1, 400)
    few, many = score([draws[:10]]), score([draws])
    assert many.high - many.low < 0.4 * (few.high - few.low)
    assert many.low < 0.6 < many.high


@pytest.mark.slow
def test_the_command_writes_rows_that_can_be_read(tmp_path, capsys):
    words = ["compare", "--suite", "npa-bench-v0", "--tasks", "MixingSmall-v0", "--no-progress"]
    assert main([*words, "--methods", "zero", "random", "--jobs", "2", "--out", str(tmp_path)]) == 0
    assert "| random | 5 |" in capsys.readouterr().out
    rows = read_rows(SUITE, tmp_path / "rows")
    assert list(rows) == ["random", "zero"]
    for row in rows.values():
        assert [run.seed for run in row.runs] == [0, 1, 2, 3, 4]
        assert {run.env_id for run in row.runs} == {"npa/MixingSmall-v0"}
    assert np.allclose(rows["zero"].returns("npa/MixingSmall-v0"), 0.0)
    assert (rows["random"].returns("npa/MixingSmall-v0") > 0.1).all()
