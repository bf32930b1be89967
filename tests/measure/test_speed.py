"""The benchmark measures what it says: times, memory, drift, and which kernels a step takes."""

import json
import math
import sys

import pytest
import skips
import torch
from drift import DriftRow

from npa_envs.cli import main
from npa_envs.measure.speed import suites
from npa_envs.measure.speed.explain import explain
from npa_envs.measure.speed.timing import Timing, TimingSession, Workload

TINY = Workload(2, 2, 150, 2, hidden_dim=16, eps=0.2)
FORWARD = 1e-5
"""Relative error that float32 may have in worlds after a few steps."""


def session(**options) -> TimingSession:
    return TimingSession(torch.device("cpu"), repeats=1, small=True, **options)


# Timing and workloads


def test_the_time_of_a_call_is_a_median_within_its_range():
    calls = []
    cost = TimingSession(torch.device("cpu"), repeats=5).cost(lambda: calls.append(0))
    assert 0.0 < cost.time.low <= cost.time.median <= cost.time.high
    assert len(calls) > 100
    assert cost.peak_mib is None
    assert str(Timing(100.0, 90.0, 120.0)) == "100 ±20%"
    assert Timing(100.0, 90.0, 120.0).divided(10) == Timing(10.0, 9.0, 12.0)


def test_workloads_have_the_neighbours_they_claim():
    for workload in (
        Workload(2, 1, 2000, 1),
        Workload(3, 1, 2000, 1),
        suites.varied("neighbours", 32),
    ):
        (x,), _ = workload.worlds(torch.device("cpu"))
        inner = (x.abs() < workload.half_width - workload.eps).all(1)
        counted = (torch.cdist(x[inner], x) < workload.eps).sum(1).double().mean()
        assert float(counted) == pytest.approx(workload.neighbour_count, rel=0.1)
    flat = [workload for workload in suites.PAPER if workload.space_dim == 2]
    assert {round(workload.neighbour_count, 6) for workload in flat} == {66.652875}
    state = torch.get_rng_state()
    one, other = (TINY.rule(torch.device("cpu")) for _ in range(2))
    assert torch.equal(one.hidden.weight, other.hidden.weight)
    assert torch.equal(state, torch.get_rng_state())


# Suites


def test_throughput_stores_and_recomputes():
    store, recompute = suites.throughput_rows(session(), [TINY])
    assert (store.memory, recompute.memory) == ("store", "recompute")
    assert store.workload == "2D (2, 150, 2)"
    assert store.worlds_mib == pytest.approx(2 * 150 * (2 + 16) * 4 / 2**20)
    for row in (store, recompute):
        assert min(row.infer_us.low, row.train_us.low) > 0.0


def test_scaling_varies_one_number_at_a_time():
    rows = suites.scaling_rows(session())
    assert [row.value for row in rows] == [256, 1024, 16, 64, 1, 2, 4, 16]
    assert [round(row.neighbours) for row in rows] == [67, 67, 16, 64, 67, 67, 67, 67]
    assert [row.channels for row in rows] == [16] * 6 + [4, 16]


def test_what_does_not_fit_into_memory_or_the_time_is_left_out():
    def large():
        raise torch.OutOfMemoryError("too large")

    done = []
    here = session(progress=done.append, enough=iter([False, False, True]).__next__)
    found = [here.attempt(name, make) for name, make in (("large", large), ("small", lambda: 3))]
    assert found == [[], [3]]
    assert here.attempt("late", lambda: 4) == []
    assert here.left_out == {"large": "not enough memory", "late": "no time was left"}
    assert done == [1, 1]


def test_each_skip_is_measured_with_and_without():
    here = session()
    rows = skips.skip_rows(here)
    assert here.left_out == {}
    assert len({row.condition for row in rows}) == len(rows) == 10
    assert all(row.done_us.median > 0 and row.skipped_us.median > 0 for row in rows)
    assert all(row.saved.endswith("%") for row in rows)


def test_kernels_are_cudas(device):
    here = TimingSession(device, repeats=1, small=True)
    rows = suites.SUITES["kernels"](here)["kernels"]
    assert any("perceive" in row.kernel for row in rows) == (device.type == "cuda")
    assert [*here.left_out] == ([] if rows else ["kernels"])


# One species beside `rollout`


def test_one_species_is_compared_with_the_rollout_that_it_is():
    here = session()
    rows = skips.one_species_rows(here)
    assert [(row.left_out, row.condition) for row in rows] == [
        ("species, 2D (1, 256, 2)", f"{what}, eager") for what in ("inference", "training")
    ]
    assert all(row.done_us.median > 0 and row.skipped_us.median > 0 for row in rows)


# Plots, report


def test_a_report_is_json_without_numbers_that_json_has_not():
    row = DriftRow("tiny", 1e-6, math.nan, 1e-6, 1e-6, 1e-6)
    skip = skips.SkipRow("a", "b", Timing(3.0, 3.0, 3.0), Timing(3.0, 3.0, 3.0), "0%")
    tables = {"drift": [row], "skips": [skip]}
    report = suites.BenchReport("quick", "npa-envs bench", "abc", 1, session(), tables)
    loaded = json.loads(report.json())
    assert {"suite", "command", "commit", "date", "device", "machine", "versions"} <= set(loaded)
    assert torch.__version__.startswith(loaded["versions"]["torch"])
    assert loaded["tables"]["drift"][0]["states"] is None
    (times,) = loaded["tables"]["skips"]
    assert times["done_us"] == {"median": 3.0, "low": 3.0, "high": 3.0}


# Explanations


def explained(workload=TINY, dtype=torch.float32, **options) -> str:
    return explain(workload, torch.device("cpu"), dtype, **options)


def test_an_explanation_names_the_kernels_and_follows_what_is_asked_for():
    forward, backward = explained().split("backward:")
    for kernel in ("sort_worlds", "compute_density", "perceive", "apply_update"):
        assert f"  {kernel} " in forward
    assert "  gather_state_cotangents " in backward
    assert "Sort a world" in forward
    wide = Workload(2, 1, 900, 1)
    plain = explained(workload=wide, gradients="none", periodic=True)
    assert "backward:" not in plain
    assert "periodic" in plain
    assert "gather_position_cotangents" in explained(gradients="positions")
    assert "f64" in explained(dtype=torch.float64)


# The command


def test_the_command_prints_tables_and_writes_what_it_says(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(
        suites.SUITES, "quick", lambda here: {"throughput": suites.throughput_rows(here, [TINY])}
    )
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "results"
    words = ["bench", "--no-progress", "--repeats", "1", "--commit", "abc"]
    assert main([*words, "--out", str(folder)]) == 0
    text = capsys.readouterr().out
    assert "throughput:" in text
    (path,) = folder.iterdir()
    assert f"wrote {path}" in text
    loaded = json.loads(path.read_text(encoding="utf-8"))
    assert (path.name, loaded["commit"]) == ("quick_cpu.json", "abc")
    assert loaded["command"].startswith("npa-envs bench --no-progress")
    # Nothing is written unless asked for.
    assert main(words) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"results"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--suite", "papper", "--out", "results"], "did you mean 'paper'?"),
        (["--device", "cuda:99"], "device must"),
        (["--repeats", "0"], "repeats must be at least 1"),
        (["--plots"], "give --out DIR"),
        (["--plots", "--out", "."], "pip install 'npa-envs[bench]'"),
    ],
)
def test_mistakes_are_refused_in_one_line_before_anything_is_measured(
    words, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["bench", "--no-progress", *words]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert (captured.out, list(tmp_path.iterdir())) == ("", [])


def test_explain_prints_and_measures_nothing(capsys):
    assert main(["bench", "--explain", "--particle-count", "64", "--gradients", "none"]) == 0
    assert "One step of 1 x 64 particles in 2D" in capsys.readouterr().out
