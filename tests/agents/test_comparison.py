"""Comparisons: runs are processes that may fail or stop, and tables say what they reached."""

import dataclasses
import itertools
import json
import math
import os
import shutil
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from support.refusals import refused
from support.slow import slow

from npa_envs.agents import RandomPolicy, ZeroPolicy
from npa_envs.agents.comparison import single_run as one_run
from npa_envs.agents.comparison.plan import LEFT_OUT, PROBLEMS, ComparisonPlan, Job, make_problem
from npa_envs.agents.comparison.report import (
    Estimate,
    curves_csv,
    fraction,
    markdown,
    mean_curve,
    report_rows,
)
from npa_envs.agents.comparison.single_run import (
    PICTURE_SIDE,
    RunRecord,
    final_picture,
    held_records,
    run_jobs,
)
from npa_envs.agents.learning import METHODS, CurvePoint, RuleSet
from npa_envs.cli import main
from npa_envs.cli.compare import CompareOptions, make_plan
from npa_envs.cli.compare import _jobs as jobs_of
from npa_envs.measure.process_queue import Slots

FACTS = {"problem": {}, "budget": 1.0, "options": {}, "episodes": 2}

CHILD = """
import json, os, sys, time
from pathlib import Path
folder = Path(sys.argv[1])
seed = json.loads((folder / "request.json").read_text())["job"]["seed"]
{before}
for line in sys.stdin:
    folder, device, teacher = json.loads(line)
    folder = Path(folder)
    request = json.loads((folder / "request.json").read_text())
    seed, status = request["job"]["seed"], "done"
{body}
    record = {{
        "job": request["job"], "facts": request["facts"], "status": status, "error": "",
        "curve": [], "returns": [1.0 + seed, 2.0 + seed], "final_losses": [0.1, 0.2],
        "endings": {{"time limit": 2}}, "seconds": 0.0, "command": request["command"], "date": "",
    }}
    (folder / "part").write_text(json.dumps(record))
    os.replace(folder / "part", folder / "run.json")
"""
"""A process that records results at once, one run after the other; tests put in what it does before
the first order, and in each run."""

WRITE_PID = "Path('{}', f'pid-{{os.getpid()}}').write_text(str(os.getpid()))"
"""Code of a process that writes its number into a folder."""


def plan(**changes) -> ComparisonPlan:
    fields = {"tasks": {"growth": {}}, "methods": ["one"], "seeds": (0, 1, 2)}
    return ComparisonPlan(
        **fields | {"budgets": {"seconds": {"growth": 1.0}}, "episodes": 2} | changes
    )


def record(method: str, seed: int, returns=(), *, axis="seconds", status="done", **fields):
    fields = {
        "facts": FACTS,
        "returns": tuple(returns),
        "final_losses": tuple(1.0 - value for value in returns),
        "endings": {"time limit": len(returns)} if returns else None,
        **fields,
    }
    return RunRecord(job=Job(axis, "growth", method, seed), status=status, **fields)


def points(*pairs: tuple[float, float]) -> tuple[CurvePoint, ...]:
    """A curve of returns against seconds; a second is 100 particle-steps."""
    return tuple(CurvePoint(at, 100.0 * at, value, 0.0, 1.0 - value) for at, value in pairs)


@pytest.fixture
def child(monkeypatch):
    """Sets what the processes of runs do before they leave their records."""

    def set_body(body: str, before: str = "") -> None:
        code = CHILD.format(body=textwrap.indent(body, "    "), before=before)
        monkeypatch.setattr(one_run, "PROGRAM", (sys.executable, "-c", code))

    set_body("")
    return set_body


def ran(plan, folder, *devices, jobs=1, **options) -> list[RunRecord]:
    """Run all jobs of a plan; return their records in the order in which they ended."""
    records: list[RunRecord] = []
    options = {"written": records.append, **options}
    run_jobs(plan, plan.jobs(), folder, Slots(devices or ("cpu",), jobs), **options)
    return records


def output_of(folder, job, name="seen") -> str:
    return (folder / job.folder / name).read_text(encoding="utf-8")


def living(folder) -> list[bool]:
    """Whether each process that wrote its number into a folder lives."""
    # A file that has just appeared may be empty still.
    numbers = [path.read_text(encoding="utf-8") for path in folder.glob("pid-*")]
    return [Path("/proc", number).exists() for number in numbers if number]


# Plans


def test_every_method_runs_on_every_task_from_every_seed_in_every_budget():
    both = {"tasks": {"a": {}, "b": {}}, "methods": ["gradient", "clone"]}
    jobs = plan(**both, budgets={"seconds": {}, "particle-steps": {}}).jobs()
    assert len(set(jobs)) == len(jobs) == 2 * 3 * 2 * 2
    assert [job.seed for job in jobs[:5]] == [0, 0, 0, 0, 1]
    assert str(jobs[0].folder) == "seconds/a/gradient/seed-0"
    fewer = plan(**both, left_out={("b", "clone")}).jobs()
    pairs = {("a", "gradient"), ("a", "clone"), ("b", "gradient")}
    assert {(job.task, job.method) for job in fewer} == pairs
    # Parts share all runs, and leave those of a seed and task together.
    whole = plan(**both)
    clone, gradient = (Job("seconds", "a", method, 0) for method in ("clone", "gradient"))
    assert (whole.teacher(clone), whole.teacher(gradient)) == (gradient, None)
    assert plan(options={"clone": {"teacher": "heart"}}).teacher(clone) is None
    parts = [whole.part(f"{number}/4") for number in (1, 2, 3, 4)]
    assert sorted(str(job) for part in parts for job in part) == sorted(map(str, whole.jobs()))
    assert [len(part) for part in parts] == [4, 4, 2, 2]
    for part in parts:
        assert all(whole.teacher(job) in part for job in part if job.method == "clone")
    assert whole.part(None) == whole.part("1/1") == whole.jobs()


def test_the_command_line_becomes_a_plan():
    options = ("evolution.population=8",)
    made = make_plan(CompareOptions(learning_seconds=2.0, particle_steps=1e6, options=options))
    assert list(made.tasks) == list(PROBLEMS)
    assert list(made.methods) == [name for name in METHODS if name != "clone"]
    assert made.budgets["seconds"] == dict.fromkeys(PROBLEMS, 2.0)
    assert set(made.left_out) == LEFT_OUT
    job = Job("particle-steps", "mixing", "evolution", 0)
    facts = made.facts(job)
    assert (facts["budget"], facts["options"]) == (1e6, {"population": 8})
    assert facts["problem"]["env_id"] == "npa/Mixing-v0"
    assert made.facts(dataclasses.replace(job, method="ppo"))["options"] == {}
    named = make_plan(CompareOptions(learning_seconds=2.0, methods=("zero", "clone")))
    assert (list(named.methods), set(named.left_out)) == (["clone", "zero"], set())
    quick = make_plan(CompareOptions(quick=True))
    assert (list(quick.tasks), quick.seeds) == (["morphogenesis2d"], (0,))
    assert set(quick.methods) == {"gradient", "evolution", "zero"}
    quick = make_plan(CompareOptions(quick=True, tasks=("mixing",), seed_count=2))
    assert (list(quick.tasks), quick.seeds) == (["mixing"], (0, 1))
    for name, quick in itertools.product(PROBLEMS, (True, False)):
        problem = make_problem(name, quick=quick)
        assert (problem.particle_count == 64) == quick
        assert problem.interface.state_scale == 0.1


def test_every_device_has_a_run_and_none_more_than_another_where_times_are_compared():
    common = {"methods": ("zero",), "devices": ("cpu", "cpu")}
    for changes, counts in (
        ({"learning_seconds": 1.0}, (2, 1)),
        ({"learning_seconds": 1.0, "jobs": 4}, (4, 2)),
        ({"particle_steps": 1e6, "jobs": 3}, (3, 2)),
    ):
        options = CompareOptions(**common, **changes)
        assert (jobs_of(options), make_plan(options).settings["runs_at_once"]) == counts
    uneven = CompareOptions(**common, learning_seconds=1.0, jobs=3)
    refused(r"multiple of the number of devices, 2.*give --jobs 4", jobs_of, uneven)


def test_a_record_comes_back_as_it_was_written_but_for_what_is_not_finite(tmp_path):
    written = record("one", 0, (0.25, 0.5), curve=points((0.0, 0.0), (1.0, 0.25)))
    written.write(tmp_path)
    assert RunRecord.read(tmp_path, FACTS) == written
    assert RunRecord.read(tmp_path / "elsewhere", FACTS) is None
    record("one", 0, (0.25, math.inf), status="diverged").write(tmp_path)
    assert np.isnan(RunRecord.read(tmp_path, FACTS).returns).tolist() == [False, True]


# Processes


def test_runs_are_spread_over_devices_and_leave_their_records(tmp_path, child):
    child("Path(folder / 'seen').write_text(device)")
    both = plan(methods=["one", "two"])
    # What a killed comparison left half way is swept away.
    half = tmp_path / both.jobs()[0].folder.parent / ".seed-0.1234"
    half.mkdir(parents=True)
    (half / "run.json").write_text("{", encoding="utf-8")
    assert held_records(both, tmp_path) == {}
    ended = ran(both, tmp_path, "cpu", "other", jobs=2, command="it")
    assert sorted(map(str, both.jobs())) == sorted(str(one.job) for one in ended)
    assert {one.command for one in ended} == {"it"}
    records = held_records(both, tmp_path)
    for job in both.jobs():
        assert records[job].returns == (1.0 + job.seed, 2.0 + job.seed)
    assert {output_of(tmp_path, job) for job in both.jobs()} == {"cpu", "other"}
    assert not list(tmp_path.rglob(".seed*")) + list(tmp_path.rglob("request.json"))


def test_on_gpus_the_next_process_gets_ready_and_waits_for_its_turn(tmp_path, child):
    # Each says that it is there; how many runs were over when it was told to begin; and how many
    # others were there when it had done its work.
    child(
        "over = len(list(folder.parent.glob('seed-*')))\n"
        "others = lambda: len(list(folder.parent.glob('.seed-*/there'))) - 1\n"
        "until = time.time() + (300 if seed < 2 and device != 'cpu' else 0.5)\n"
        "while not others() and time.time() < until: time.sleep(0.01)\n"
        "(folder / 'seen').write_text(f'{over}{others()}')",
        before="(folder / 'there').touch()",
    )
    for device, seen in {"cuda:0": ["01", "11", "20"], "cpu": ["00", "10", "20"]}.items():
        ran(plan(), tmp_path / device, device)
        assert [output_of(tmp_path / device, job) for job in plan().jobs()] == seen


def test_no_place_stays_free_while_a_process_waits(tmp_path, child):
    # The first lasts until the others are over.
    child(
        "until = time.time() + (0 if seed else 100)\n"
        "over = lambda: len(list(folder.parent.glob('seed-*')))\n"
        "while time.time() < until and over() < 3: time.sleep(0.01)"
    )
    ended = ran(plan(seeds=(0, 1, 2, 3)), tmp_path, "cuda:0", "cuda:1", jobs=2)
    assert [one.job.seed for one in ended] == [1, 2, 3, 0]


@pytest.mark.skipif(os.name != "posix", reason="elsewhere each run has a process")
def test_runs_follow_each_other_in_a_process_until_one_fails(tmp_path, child):
    child(
        "if seed == 2: os._exit(3)\n"
        "if seed == 4: status = 'failed'\n"
        "(folder / 'seen').write_text(str(os.getpid()))\n" + WRITE_PID.format(tmp_path)
    )
    steps = {"particle-steps": {"growth": 1.0}}
    made = plan(seeds=range(7), budgets=steps)
    ended = ran(made, tmp_path, "cuda")
    assert [one.job.seed for one in ended] == list(range(7))
    statuses = [one.status for one in ended]
    assert statuses == ["done", "done", "failed", "done", "failed", "done", "done"]
    assert ended[2].error.startswith("its process ended with code 3")
    by = {one.job.seed: output_of(tmp_path, one.job) for one in ended if one.job.seed != 2}
    assert by[0] == by[1] != by[3] == by[4] != by[5] == by[6]
    assert not any(living(tmp_path))
    # Functions from outside, and what is measured by time, have processes of their own.
    job = made.jobs()[0]
    assert one_run.shares_process(made, job)
    assert not one_run.shares_process(plan(own={"one": "mine:train"}, budgets=steps), job)
    assert not one_run.shares_process(made, dataclasses.replace(job, axis="seconds"))


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_a_run_that_clones_begins_when_its_teacher_is_over(tmp_path, child, device):
    child(
        "if not teacher: time.sleep(0.5)\n"
        "(folder / 'seen').write_text(str(bool(teacher) and Path(teacher, 'run.json').exists()))"
    )
    made = plan(methods=["clone", "gradient"], seeds=(0, 1))
    order = [one.job for one in ran(made, tmp_path, device, jobs=4)]
    for job in made.jobs():
        assert output_of(tmp_path, job) == str(job.method == "clone")
        if job.method == "clone":
            assert order.index(made.teacher(job)) < order.index(job)


def test_a_run_that_clones_is_refused_where_its_teacher_will_never_be(tmp_path, child):
    made = plan(methods=["clone"], seeds=(0,))
    refused(r"clones the rules of 'gradient'.*add --methods gradient", ran, made, tmp_path)
    assert list(tmp_path.iterdir()) == []
    # What an earlier call has run serves as well, from the same settings.
    taught = plan(methods=["gradient"], seeds=(0,), options={"gradient": {"num_envs": 2}})
    ran(taught, tmp_path)
    refused(r"of other settings: options was \{'num_envs': 2\}, now", ran, made, tmp_path)
    shutil.rmtree(tmp_path / taught.jobs()[0].folder)
    ran(plan(methods=["gradient"], seeds=(0,)), tmp_path)
    ran(made, tmp_path)
    assert (tmp_path / made.jobs()[0].folder / "run.json").exists()


@pytest.mark.parametrize("waiting", [False, True])
def test_a_process_that_dies_is_recorded_the_others_go_on_and_it_is_run_again(
    tmp_path, child, waiting
):
    death = "if seed == 1: print('out of luck', flush=True); os._exit(3)"
    child("time.sleep(0 if seed else 1)" if waiting else death, before=death if waiting else "")
    records, ends = [], []

    def written(one):
        records.append(one)
        ends.append(time.perf_counter())

    ran(plan(), tmp_path, "cuda" if waiting else "cpu", written=written)
    assert [one.status for one in records] == ["done", "failed", "done"]
    failed = records[1]
    assert failed.error == "its process ended with code 3: out of luck"
    # While it waited, which was for at least a second, no time counted.
    assert failed.seconds <= ends[1] - ends[0]
    assert list(held_records(plan(), tmp_path)) == [records[0].job, records[2].job]
    assert RunRecord.read(tmp_path / failed.job.folder, plan().facts(failed.job)) == failed
    child("")
    run_jobs(plan(), [failed.job], tmp_path, Slots(("cpu",)))
    assert list(held_records(plan(), tmp_path)) == plan().jobs()


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_an_interrupted_comparison_ends_its_processes_and_goes_on_where_it_was(
    tmp_path, child, device
):
    both = f"while len(list(Path({str(tmp_path)!r}).glob('pid-*'))) < 2: time.sleep(0.01)"
    child(f"if seed: time.sleep(600)\n{both}", before=WRITE_PID.format(tmp_path))

    def interrupt(_):
        raise KeyboardInterrupt

    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        ran(plan(), tmp_path, device, jobs=2, written=interrupt)
    assert len(living(tmp_path)) >= 2
    assert not any(living(tmp_path))
    assert time.perf_counter() - begin < 300.0
    assert list(held_records(plan(), tmp_path)) == plan().jobs()[:1]
    assert not list(tmp_path.rglob(".seed*"))


@pytest.mark.parametrize("learns", [slow(False), True], ids=["that waits", "that learns"])
def test_the_process_of_a_run_ends_with_the_comparison(tmp_path, learns):
    # With an order it would learn for ten minutes.
    request_of("mixing", "gradient", tmp_path, learning_seconds=600.0)
    process = subprocess.Popen(
        [*one_run.PROGRAM, str(tmp_path)], stdin=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        order = json.dumps([str(tmp_path), "cpu", ""])
        process.stdin.write(f"{order}\n".encode() if learns else b"")
        process.stdin.flush()
        _, errors = process.communicate(timeout=100)
    finally:
        process.kill()
    assert process.returncode == 1
    assert b"Traceback" not in errors
    assert not (tmp_path / "run.json").exists()


def request_of(task, method, folder, **options):
    """Write the request of a quick run into a folder, and return its facts."""
    made = make_plan(CompareOptions(quick=True, tasks=(task,), methods=(method,), **options))
    (job, *_) = made.jobs()
    request = {"job": dataclasses.asdict(job), "facts": made.facts(job)}
    (folder / "request.json").write_text(json.dumps(request), encoding="utf-8")
    return request["facts"]


def train_wildly(progress):
    still = ZeroPolicy(progress.problem.make_envs(1))
    return lambda observation: math.nan + still(observation)


@pytest.mark.parametrize(
    ("task", "method", "status", "error"),
    [
        ("morphogenesis2d", "wild", "diverged", "must be finite"),
        ("mixing", "wild", "diverged", "must be finite"),
        ("mixing", "gradient", "failed", "NPAError: world_count must be a whole number"),
    ],
)
def test_a_run_records_what_it_raises(task, method, status, error, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(METHODS, "wild", f"{__name__}:train_wildly")
    options = ("gradient.num_envs=0",) if method == "gradient" else ()
    facts = request_of(task, method, tmp_path, options=options)
    one_run.run(tmp_path, "cpu")
    result = RunRecord.read(tmp_path, facts)
    assert (result.status, error in result.error) == (status, True)
    assert "Traceback" in capsys.readouterr().err


# Tables


def synthetic() -> list[RunRecord]:
    ended = {"time limit": 2, "diverged": 1, "left the world": 1}
    return [
        *(record("gradient", k, (2.0 + k, 4.0 + k)) for k in range(2)),
        *(record("zero", k, (0.5, 0.5)) for k in range(2)),
        record("ppo", 0, (1.0, 1.0), endings=ended, curve=points((0.0, 0.0), (4.0, 1.0))),
        record("ppo", 1, (3.0, 3.0), curve=points((0.0, 0.0), (6.0, 3.0))),
        record("ppo", 2, status="failed", error="no"),
        record("evolution", 0, status="diverged", error="inf"),
        record("ppo", 0, (7.0,), axis="particle-steps"),
    ]


HEAD = """\
| method | runs | return | final loss | fraction of gradient | seconds | particle-steps |
| --- | --- | --- | --- | --- | --- | --- |
"""
PPO = (
    "| ppo | 2, 1 failed, 33% of episodes diverged | 2.000 ± 1.000 (of 2 of 3) | "
    "-1.000 ± 1.000 (of 2 of 3) | 0.500 ± 0.344 (of 2 of 3) | 5 | 500 |"
)
TABLE = f"""\
## Equal wall time

### growth

{HEAD}\
| gradient | 2 | 3.500 ± 0.500 | -2.500 ± 0.500 | 1.000 | – | – |
{PPO}
| zero | 2 | 0.500 ± 0.000 | 0.500 ± 0.000 | 0.000 ± 0.000 | – | – |
| evolution | 0, 1 diverged | – | – | – | – | – |

## Equal particle-steps

### growth

{HEAD}\
| ppo | 1 | 7.000 | -6.000 | – | – | – |

Fractions need runs of `zero` and `gradient`.
"""


def test_a_table_has_the_right_numbers_the_best_first_and_leaves_no_method_out():
    assert markdown(report_rows(synthetic())) == TABLE
    ppo = next(row for row in report_rows(synthetic()) if row.method == "ppo")
    assert ppo.fraction == Estimate(0.5, pytest.approx(math.hypot(1.0, 0.5 * 0.5) / 3.0))
    assert ppo.episodes_diverged == pytest.approx(2 / 6)
    # No fraction of an improvement that there is not.
    nothing = Estimate(0.5, 0.0)
    for reference in (Estimate(0.5, 0.1), Estimate(math.nan, 0.1)):
        assert math.isnan(fraction(Estimate(1.5, 0.1), nothing, reference).mean)


def test_curves_have_a_line_for_each_point_of_each_run():
    some = [record("ppo", 0, curve=points((1.25, 0.125))), record("zero", 0)]
    some.append(record("evolution", 1, status="diverged", curve=points((2.0, math.nan))))
    assert curves_csv(some).splitlines() == [
        "axis,task,method,seed,status,seconds,particle_steps,mean_return,standard_error,final_loss",
        "seconds,growth,ppo,0,done,1.25,125,0.125,0,0.875",
        "seconds,growth,evolution,1,diverged,2,200,nan,0,nan",
    ]


# Pictures


def test_a_curve_is_the_mean_of_seeds_where_all_of_them_are():
    def mean_of(*records):
        return mean_curve(records, "seconds")

    some = [
        record("ppo", 0, curve=points((0.0, 0.0), (2.0, 2.0), (4.0, 2.0))),
        record("ppo", 1, curve=points((1.0, 3.0), (3.0, 5.0))),
        record("ppo", 2, status="failed"),
    ]
    across, mean, error = curve = mean_of(*some)
    assert (across[0], across[-1]) == (1.0, 3.0)
    assert np.allclose(mean, np.interp(across, [1, 2, 3], [2.0, 3.0, 3.5]), atol=0.02)
    assert error[0] == pytest.approx(1.0)
    assert mean_of(some[2]) is None
    # One that broke off early is no part of it, and alone it is all there is.
    diverged = record("ppo", 3, status="diverged", curve=points((0.0, -9.0), (0.5, -9.0)))
    assert np.array_equal(mean_of(*some, diverged), curve)
    assert mean_of(diverged)[0][-1] == 0.5
    across, mean, _ = mean_of(record("zero", 0, curve=points((0.0, 0.5))))
    assert (across.tolist(), mean.tolist()) == ([0.0], [0.5])


@pytest.mark.parametrize("name", ["morphogenesis2d", "mixing"])
def test_a_picture_shows_the_end_of_the_episode_and_not_the_next_start(name, device):
    problem = make_problem(name, quick=True)
    keywords = {**problem.keywords, "render_mode": "rgb_array", "render_size": PICTURE_SIDE}
    longer = dataclasses.replace(problem, keywords=keywords, episode_steps=99)
    envs = longer.make_envs(1, device=device)
    first, second, third = (RandomPolicy(envs) for _ in range(3))
    observation, _ = envs.reset(seed=[3])
    for _ in range(problem.episode_steps):
        observation, *_ = envs.step(first(observation))
    (last,) = envs.render()
    assert last.shape == (PICTURE_SIDE, PICTURE_SIDE, 3)
    assert np.array_equal(last, final_picture(problem, second, 3, device=str(device)))
    assert not np.array_equal(last, final_picture(problem, third, 4, device=str(device)))


# The whole command


def quick_words(methods: str, out: Path) -> list[str]:
    return (
        f"compare --quick --tasks morphogenesis2d --seed-count 1 --no-progress --methods {methods} "
        f"--particle-steps 5000 --out {out}"
    ).split()


def test_a_quick_comparison_stops_goes_on_and_refuses_other_settings(tmp_path, capsys, monkeypatch):
    pytest.importorskip("cma")
    words = quick_words("zero evolution", tmp_path)
    words += ["--options", "evolution.population=4", "--commit", "test"]
    assert main([*words, "--max-seconds", "1e-3"]) == 0
    assert "1 runs are left: call again" in capsys.readouterr().out
    folder = tmp_path / "particle-steps" / "morphogenesis2d"
    (first,) = folder.rglob("run.json")
    before = first.stat().st_mtime_ns
    quick = CHILD.format(body="    pass", before="")
    monkeypatch.setattr(one_run, "PROGRAM", (sys.executable, "-c", quick))
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "are left" not in printed
    assert first.stat().st_mtime_ns == before
    folder /= "evolution/seed-0"
    content = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert (content["status"], len(content["returns"])) == ("done", 4)
    assert content["curve"][-1]["particle_steps"] >= 5000
    assert str(tmp_path) not in json.dumps(content)
    assert "--out OUT" in content["command"]
    assert len(list(RuleSet.load(folder, make_problem("morphogenesis2d", quick=True)))) == 1
    assert f"| evolution | 1 | {np.mean(content['returns']):.3f}" in printed
    table = json.loads((tmp_path / "comparison.json").read_text(encoding="utf-8"))
    assert {row["method"] for row in table["rows"]} == {"evolution", "zero"}
    assert (tmp_path / "comparison.csv").is_file()
    text = (tmp_path / "comparison.md").read_text(encoding="utf-8")
    assert text.endswith(printed.split("wrote")[0].rstrip() + "\n")
    for name in ("grown_morphogenesis2d_particle-steps.png", "curves_morphogenesis2d.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert main([*words, "--episodes", "5"]) == 2
    assert "other settings: episodes was 4, now 5" in capsys.readouterr().err


def test_a_method_that_fails_is_in_the_table_and_the_command_says_so(tmp_path, capsys, child):
    child("os._exit(3)")
    assert main(quick_words("zero", tmp_path)) == 1
    printed = capsys.readouterr().out
    assert "| zero | 0, 1 failed | – |" in printed
    assert "zero/seed-0 failed: its process ended with code 3" in printed
