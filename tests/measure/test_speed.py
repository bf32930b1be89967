"""The benchmark measures what it says: real strategies, true errors, and a guard that bites."""

import json
import math
import sys
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch
from clock import Clock

from npa_envs import reference
from npa_envs.cli import main
from npa_envs.measure.speed import suites, throughput
from npa_envs.measure.speed.errors import (
    PEERS,
    RolloutRow,
    composed_step,
    drawn_mask,
    drift_rows,
    mask_source,
    peer_rows,
    perception_rows,
    rollout_rows,
)
from npa_envs.measure.speed.explain import Question, explain
from npa_envs.measure.speed.strategies import NEIGHBOUR_CAP, PRECISIONS, STRATEGIES, nearest
from npa_envs.measure.speed.suites import Point, Report, front, pictures
from npa_envs.measure.speed.throughput import (
    PAPER,
    aim_rows,
    roll_one_species,
    scaling_rows,
    skip_rows,
    slope_rows,
    throughput_rows,
    varied,
)
from npa_envs.measure.speed.timing import LeftOut, Session, Timing, compare
from npa_envs.measure.speed.workloads import Workload, gecko
from npa_envs.ops import perceive
from npa_envs.ops.launch import noted_launches
from npa_envs.world.rollout import rollout

TINY = Workload(2, 2, 150, 2, hidden_dim=16, eps=0.2)
FORWARD = 1e-5
"""Relative error that float32 may have in one perception; the worst measured is 3.2e-7."""

FAST = ["bench", "--no-progress", "--repeats", "1"]


def session(**options) -> Session:
    return Session(torch.device("cpu"), repeats=1, small=True, **options)


def timing(median: float) -> Timing:
    return Timing(median, median, median)


# Strategies and precisions


@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("name", STRATEGIES)
def test_every_strategy_perceives_what_the_reference_does(name, space_dim, device):
    # So sparse that no particle has more neighbours than the cap.
    workload = Workload(space_dim, 2, 150, 1, state_dim=5, eps=0.05 if space_dim == 2 else 0.1)
    x, s = workload.worlds(device)
    expected = reference.perceive(x.double(), s.double(), workload.eps, workload.eps)
    for dtype, tolerance in ((torch.float32, FORWARD), (torch.float64, 1e-12)):
        z = STRATEGIES[name].perceive(x.to(dtype), s.to(dtype), workload.eps)
        assert z.dtype == dtype
        assert float((z - expected).norm() / expected.norm()) < tolerance
        rho = STRATEGIES[name].density(x.to(dtype), s.to(dtype), workload.eps)
        exact = reference.fields(x.double(), s.double(), workload.eps).rho
        assert float((rho - exact).norm() / exact.norm()) < tolerance


def test_the_neighbour_cap_leaves_out_all_but_the_nearest():
    x, s = Workload(2, 1, 400, 1).worlds(torch.device("cpu"))
    index = nearest(x, 3)
    distances = torch.cdist(x[0].double(), x[0].double())
    assert torch.equal(index[0].sort().values, distances.topk(3, largest=False)[1].sort().values)
    capped = STRATEGIES["neighbour_cap"].density(x, s, 0.1)
    assert (capped <= STRATEGIES["dense"].density(x, s, 0.1) * (1 + 1e-5)).all()
    crowded = (distances < 0.1).sum(1) > NEIGHBOUR_CAP
    assert crowded.any()
    lost = capped < 0.99 * STRATEGIES["dense"].density(x, s, 0.1)
    assert not lost[0, ~crowded].any()


def test_steps_composed_in_torch_are_those_of_the_library_with_the_same_masks():
    start = gecko(1, 300, torch.device("cpu")).grown(3)
    rule, x, s = start.rule.double(), start.x.double(), start.s.double()
    own = rollout(rule, x, s, 3, update_prob=0.5, generator=mask_source(x))
    generator = mask_source(x)
    assert not torch.equal(own[0], x)
    for _ in range(3):
        mask = drawn_mask(x, 0.5, generator)
        x, s = composed_step(STRATEGIES["dense"], rule, x, s, mask)
    for value, expected in zip((x, s), own, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-10, atol=1e-10)


def test_a_precision_keeps_weights_and_rounds_what_it_says():
    rule = gecko(1, 64, torch.device("cpu")).rule
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(40, rule.perception_dim, generator=generator)
    s = torch.randn(2, 3, 4, generator=generator)
    expected = rule(z).detach()
    for name, precision in PRECISIONS.items():
        own = precision.rule(rule)
        assert own.hidden.weight.dtype == precision.dtype
        assert torch.equal(own.output.weight.float(), rule.output.weight)
        value = own(z.to(precision.dtype)).detach()
        assert value.dtype == precision.dtype
        error = float((value - expected).norm() / expected.norm())
        assert (1e-4 < error < 2e-2) if name == "mixed" else (error < 1e-6)
        rounded = s.bfloat16().float() if name == "bf16_storage" else s
        assert torch.equal(precision.kept(s), rounded)
    rule.dead_zone = 1e6
    assert not any(own.rule(rule)(z.to(own.dtype)).any() for own in PRECISIONS.values())
    # The fused path does not see torch's switch.
    assert not PRECISIONS["tf32"].rule(rule).is_plain()
    before = torch.backends.cuda.matmul.allow_tf32
    with PRECISIONS["tf32"].active():
        assert torch.backends.cuda.matmul.allow_tf32
    assert torch.backends.cuda.matmul.allow_tf32 == before


# Timing and workloads


def test_the_time_of_a_call_is_a_median_within_its_range():
    calls = []
    cost = Session(torch.device("cpu"), repeats=5).cost(lambda: calls.append(0))
    assert 0.0 < cost.time.low <= cost.time.median <= cost.time.high
    assert len(calls) > 100
    assert cost.peak_mib is None
    assert str(Timing(100.0, 90.0, 120.0)) == "100 ±20%"
    assert Timing(100.0, 90.0, 120.0).divided(10) == Timing(10.0, 9.0, 12.0)


def test_workloads_have_the_neighbours_they_claim():
    for workload in (Workload(2, 1, 2000, 1), Workload(3, 1, 2000, 1), varied("neighbours", 32)):
        (x,), _ = workload.worlds(torch.device("cpu"))
        inner = (x.abs() < workload.half_width - workload.eps).all(1)
        counted = (torch.cdist(x[inner], x) < workload.eps).sum(1).double().mean()
        assert float(counted) == pytest.approx(workload.neighbour_count, rel=0.1)
    flat = [workload for workload in PAPER if workload.space_dim == 2]
    assert {round(workload.neighbour_count, 6) for workload in flat} == {66.652875}
    state = torch.get_rng_state()
    one, other = (TINY.rule(torch.device("cpu")) for _ in range(2))
    assert torch.equal(one.hidden.weight, other.hidden.weight)
    assert torch.equal(state, torch.get_rng_state())


# Suites


def test_perception_in_float32_errs_little_and_the_reference_not_at_all():
    here = session()
    rows = perception_rows(here, TINY)
    exact = [row for row in rows if (row.strategy, row.precision) == ("library", "float64")]
    assert [row.perception for row in exact] == [0.0]
    summed = [row for row in rows if row.strategy != "neighbour_cap"]
    for row in (row for row in summed if row.precision == "float32"):
        fields = (row.density, row.smoothed, row.state_gradient, row.density_gradient)
        assert 0.0 < max(*fields, row.perception) < FORWARD
    dense = next(row for row in rows if (row.strategy, row.precision) == ("dense", "float64"))
    assert dense.perception < 1e-13
    assert dense.cotangent < 1e-13
    cut = next(row for row in rows if row.strategy == "neighbour_cap")
    assert cut.perception > 1e-3
    short = next(row for row in rows if row.precision == "bf16_storage")
    assert 1e-5 < short.perception < 1e-2
    left = {entry.what for entry in here.left_out}
    assert {"tf32", "perception in mixed", "plain, float32, 2D (2, 150)"} <= left


def test_float32_drifts_little_from_float64_over_a_rollout(device):
    rows = drift_rows(Session(device, repeats=1), [Workload(2, 2, 300, 8), Workload(3, 1, 300, 8)])
    named = [(row.workload, row.strategy) for row in rows]
    assert named == list(product(["2D (2, 300, 8)", "3D (1, 300, 8)"], ["library", "dense"]))
    for row in rows:
        assert 0.0 < row.positions < FORWARD
        assert 0.0 < row.states < FORWARD
        # A hidden unit may be on in one precision alone.
        assert 0.0 < row.state_gradient < 1e-3
        assert 0.0 < row.state_gradient_median < 1e-5
        assert 0.0 < row.weight_gradient < 1e-3


def test_rollouts_err_more_in_shorter_precisions():
    chosen = [PRECISIONS[name] for name in ("float64", "float32", "bf16_storage", "mixed")]
    here = session(strategies=[STRATEGIES["library"], STRATEGIES["dense"]], precisions=chosen)
    exact, single, storage, mixed = rollout_rows(here, 200)
    assert (exact.x_1, exact.s_64, exact.weights) == (0.0, 0.0, 0.0)
    assert 0.0 < single.x_1 < FORWARD
    assert single.s_1 < FORWARD
    assert single.weights < 1e-4
    for row in (storage, mixed):
        assert 10 * single.s_8 < row.s_8 < 0.1
    assert all(math.isfinite(row.psnr_512) for row in (exact, single, storage, mixed))
    assert abs(exact.psnr_512 - single.psnr_512) < 1.0
    assert {entry.what for entry in here.left_out} == {"rollouts of dense"}


def test_throughput_stores_and_recomputes_and_an_aim_takes_the_better_of_both():
    store, recompute = throughput_rows(session(), [TINY])
    assert (store.memory, recompute.memory) == ("store", "recompute")
    assert store.workload == "2D (2, 150, 2)"
    assert store.worlds_mib == pytest.approx(2 * 150 * (2 + 16) * 4 / 2**20)
    for row in (store, recompute):
        assert min(row.infer_us.low, row.train_us.low) > 0.0
    assert aim_rows([store, recompute]) == []
    known = {"workload": PAPER[0].name, "infer_us": timing(80.0)}
    store = replace(store, **known, train_us=timing(150.0), train_mib=900.0)
    recompute = replace(recompute, **known, train_us=timing(210.0), train_mib=300.0)
    (row,) = aim_rows([store, recompute])
    assert (row.train_us, row.recompute_mib, row.recompute_slower) == (150.0, 300.0, 1.4)
    assert (row.infer_aim, row.train_aim, row.mib_aim) == (72, 163, 395)


def test_scaling_varies_one_number_at_a_time_and_slopes_are_those_of_logarithms():
    rows = scaling_rows(session())
    assert [row.value for row in rows] == [256, 1024, 16, 64, 1, 2, 4, 16]
    assert [round(row.neighbours) for row in rows] == [67, 67, 16, 64, 67, 67, 67, 67]
    assert [row.channels for row in rows] == [16] * 6 + [4, 16]
    grown = [
        replace(row, value=n, infer_us=timing(3 * n), train_us=timing(n**2))
        for row in rows[::2]
        for n in (16, 64, 256, 1024)
    ]
    slopes = slope_rows(grown)
    assert [slope.axis for slope in slopes] == list(throughput.AXES)
    for slope in slopes:
        assert (slope.infer_slope, slope.train_slope) == pytest.approx((1.0, 2.0))


def test_what_does_not_fit_into_memory_is_left_out():
    def large():
        raise torch.OutOfMemoryError("too large")

    done = []
    here = session(progress=done.append)
    assert here.attempt("large", large) == []
    assert here.attempt("small", lambda: 3) == [3]
    assert here.left_out == [LeftOut("large", "not enough memory")]
    assert done == [1, 1]


def test_what_has_not_begun_when_time_is_over_is_left_out():
    here = session(enough=iter([False, True]).__next__)
    assert here.attempt("first", lambda: 3) == [3]
    assert here.attempt("second", lambda: 4) == []
    assert here.left_out == [LeftOut("second", "no time was left")]


def test_peers_that_are_there_are_right_and_others_are_left_out_with_a_reason(monkeypatch):
    def missing(*_):
        raise ModuleNotFoundError("No module named 'absent'")

    monkeypatch.setitem(PEERS, "absent", missing)
    here = session()
    rows = peer_rows(here, Workload(3, 1, 120, 1, eps=0.2))
    assert {"npa-envs", "wp.HashGrid", "dense torch"} <= {row.peer for row in rows}
    assert max(row.error for row in rows) < FORWARD
    assert LeftOut("absent", "ModuleNotFoundError: No module named 'absent'") in here.left_out
    measured = {row.peer for row in rows} | {entry.what for entry in here.left_out}
    assert measured == set(PEERS)


def test_each_skip_is_measured_with_and_without():
    here = session()
    rows = skip_rows(here)
    assert here.left_out == []
    assert len({row.condition for row in rows}) == len(rows) == 10
    assert all(row.done_us.median > 0 and row.skipped_us.median > 0 for row in rows)
    assert all(row.saved.endswith("%") for row in rows)


def test_kernels_are_cudas(device):
    here = Session(device, repeats=1, small=True)
    rows = suites.SUITES["kernels"](here)["kernels"]
    assert any("perceive" in row.kernel for row in rows) == (device.type == "cuda")
    assert [entry.what for entry in here.left_out] == ([] if rows else ["kernels"])


def test_the_suites_measure_all_their_tables():
    here = session(strategies=[STRATEGIES["library"]], precisions=[PRECISIONS["float32"]])
    tables = suites.quick(here)
    assert list(tables) == ["perception", "rollouts", "peers", "throughput", "drift"]
    assert all(tables.values())
    assert here.small
    assert list(suites.paper(here)) == ["throughput", "drift"]


# One species beside `rollout`


def test_calls_are_compared_in_turn_and_each_pair_the_other_way_round(device, monkeypatch):
    calls, clock = [], Clock()
    monkeypatch.setattr("npa_envs.measure.speed.timing.time", clock)

    def call(name, seconds):
        calls.append(name)
        clock.sleep(seconds)

    source = torch.Generator(device)
    first, second = partial(call, "a", 0.01), partial(call, "b", 0.02)
    # A graph holds nothing of a call that launches nothing.
    compared = compare((first, source), (second, source), device, repeats=4, graph=False)
    assert "".join(calls)[4:] == "abbaabba"
    assert compared.first.median == pytest.approx(10_000)
    assert compared.second.median == pytest.approx(20_000)
    assert compared.ratio == pytest.approx(2.0)


def test_one_species_is_compared_with_the_rollout_that_it_is():
    here = Session(torch.device("cpu"), repeats=9, small=True)
    rows = suites.SUITES["species"](here)["one_species"]
    assert [(row.workload, row.what, row.calls) for row in rows] == [
        ("2D (1, 256, 2)", what, "eager") for what in ("inference", "training")
    ]
    # What it costs is measured; that it is not another rollout is known.
    assert all(row.rollout_us.median > 0 and row.ratio > 0 for row in rows)
    x, s = TINY.worlds(here.device)
    rule = TINY.rule(here.device)
    outcomes = [
        roll(rule, x, s, 2, update_prob=0.5, generator=torch.Generator().manual_seed(1))
        for roll in (rollout, roll_one_species)
    ]
    assert all(map(torch.equal, *outcomes))


# Plots, report


def test_the_front_holds_what_nothing_beats():
    points = [Point(1e-7, 5.0, "a", ""), Point(1e-3, 2.0, "b", ""), Point(1e-2, 3.0, "c", "")]
    points.append(Point(1e-7, 6.0, "d", ""))
    assert [point.strategy for point in front(points)] == ["a", "b"]


def rollout_row(**values) -> RolloutRow:
    numbers = dict.fromkeys(("x_1", "s_1", "x_8", "s_8", "x_64", "s_64"), 1e-6)
    usual = {"strategy": "library", "precision": "float32", "particles": 10, **numbers}
    usual |= {"step_us": timing(3.0), "training_us": None, "peak_mib": None}
    return RolloutRow(**usual | {"weights": None, "psnr_512": math.nan} | values)


def report_of(tables, **options) -> Report:
    return Report("quick", "npa-envs bench", "abc", torch.device("cpu"), 1, tables, (), **options)


def test_a_report_is_json_without_numbers_that_json_has_not():
    loaded = json.loads(report_of({"rollouts": [rollout_row()]}, ratios={"a": 2.0}).json())
    assert {"suite", "command", "commit", "date", "device", "machine", "versions"} <= set(loaded)
    assert torch.__version__.startswith(loaded["versions"]["torch"])
    (row,) = loaded["tables"]["rollouts"]
    assert row["psnr_512"] is None
    assert row["step_us"] == {"median": 3.0, "low": 3.0, "high": 3.0}
    assert loaded["ratios"] == {"a": 2.0}


def test_pictures_are_drawn_of_what_was_measured():
    pytest.importorskip("matplotlib")
    tables = {
        "perception": perception_rows(session(), Workload(2, 1, 60, 1)),
        "rollouts": [rollout_row(), rollout_row(precision="mixed", s_8=1e-3)],
    }
    drawn = pictures(tables)
    assert list(drawn) == ["pareto"]
    assert drawn["pareto"].startswith(b"\x89PNG")


# Explanations


def question(**options) -> Question:
    usual = {"workload": TINY, "device": torch.device("cpu"), "dtype": torch.float32}
    return Question(**usual | {"periodic": False, "gradients": "weights"} | options)


def test_an_explanation_names_the_kernels_and_follows_what_is_asked_for():
    forward, backward = explain(question()).split("backward:")
    for kernel in ("sort_worlds", "compute_density", "perceive", "apply_update"):
        assert f"  {kernel} " in forward
    assert "  gather_state_cotangents " in backward
    assert "Sort a world" in forward
    wide = Workload(2, 1, 900, 1)
    plain = explain(question(workload=wide, gradients="none", periodic=True))
    assert "backward:" not in plain
    assert "periodic" in plain
    assert "gather_position_cotangents" in explain(question(gradients="positions"))
    assert "f64" in explain(question(dtype=torch.float64))


def test_noted_launches_are_those_of_the_block():
    x, s = TINY.worlds(torch.device("cpu"))
    with noted_launches() as launches:
        perceive(x, s, TINY.eps)
    names = [launch.kernel for launch in launches]
    perceive(x, s, TINY.eps)
    assert [launch.kernel for launch in launches] == names
    assert "perceive" in names


# The guard


def stored(tmp_path: Path, **values: float) -> Path:
    path = tmp_path / "ratios.json"
    path.write_text(json.dumps({"cpu": values}))
    return path


def test_a_ratio_is_held_down_to_a_third_and_missed_below(tmp_path):
    path = stored(tmp_path, dense=30.0, grid=3.0)
    wanted = suites.stored_ratios(path, torch.device("cpu"))
    assert suites.missed_ratios({"dense": 10.1, "grid": 5.0}, wanted) == []
    (line,) = suites.missed_ratios({"dense": 9.9, "grid": 5.0}, wanted)
    assert line == "dense: 9.9, stored 30, at least 10 wanted"
    assert len(suites.missed_ratios({"dense": math.nan}, wanted)) == 2


def test_stored_ratios_are_those_measured():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "ratios.json"
    measured = suites.ratios(session())
    assert all(value > 0.0 for value in measured.values())
    assert sorted(json.loads(path.read_text())["cpu"]) == sorted(measured)


@pytest.mark.slow
def test_the_library_is_faster_than_dense_torch():
    assert suites.ratios(session())["perceive: dense torch over library"] > 3.0


def test_the_command_prints_tables_writes_what_it_says_and_checks_ratios(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(
        suites.SUITES, "quick", lambda here: {"perception": perception_rows(here, TINY)}
    )
    monkeypatch.setattr(suites, "WORKLOAD", Workload(2, 1, 100, 1, hidden_dim=16))
    monkeypatch.chdir(tmp_path)
    name, folder = "perceive: dense torch over library", tmp_path / "results"
    held = [*FAST, "--check", str(stored(tmp_path, **{name: 1e-3}))]
    assert main([*held, "--out", str(folder), "--commit", "abc"]) == 0
    text = capsys.readouterr().out
    for word in ("perception:", "neighbour_cap", "bf16_storage", "left out:", "times faster:"):
        assert word in text
    (path,) = folder.iterdir()
    assert f"wrote {path}" in text
    assert text.endswith("ratios are held\n")
    loaded = json.loads(path.read_text())
    assert (path.name, loaded["commit"]) == ("quick_cpu.json", "abc")
    assert loaded["command"].startswith("npa-envs bench --no-progress")
    strategies = {row["strategy"] for row in loaded["tables"]["perception"]}
    assert strategies == set(STRATEGIES) - {"plain"}
    missed = str(stored(tmp_path, **{name: 1e9}))
    assert main([*FAST, "--strategies", "library", "--check", missed]) == 1
    assert f"missed: {name}" in capsys.readouterr().out
    # Nothing is written unless asked for.
    assert {path.name for path in tmp_path.iterdir()} == {"ratios.json", "results"}


# The command


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--suite", "papper", "--out", "results"], "did you mean 'paper'?"),
        (["--strategies", "libraries"], "did you mean 'library'?"),
        (["--precisions", "float16"], "unknown precision 'float16'"),
        (["--device", "cuda:99"], "device must"),
        (["--repeats", "0"], "repeats must be at least 1"),
        (["--plots"], "give --out DIR"),
        (["--plots", "--out", "."], "pip install 'npa-envs[bench]'"),
        (["--suite", "paper", "--check", "x.json"], "leave --suite out"),
        (["--check", "{}"], "must hold ratios under 'cpu'"),
        (["--check", "[]"], "must hold ratios under 'cpu'"),
        (["--check", "no json"], "must hold ratios under 'cpu'"),
        (["--check", '{"cpu": {"a": "fast"}}'], "must hold ratios under 'cpu'"),
    ],
)
def test_mistakes_are_refused_in_one_line_before_anything_is_measured(
    words, message, tmp_path, tmp_path_factory, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    if words[0] == "--check":
        path = tmp_path_factory.mktemp("stored") / "ratios.json"
        path.write_text(words[1])
        words = ["--check", str(path)]
    assert main(["bench", "--no-progress", *words]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert (captured.out, list(tmp_path.iterdir())) == ("", [])


def test_explain_prints_and_measures_nothing(capsys):
    assert main(["bench", "--explain", "--particle-count", "64", "--gradients", "none"]) == 0
    assert "One step of 1 x 64 particles in 2D" in capsys.readouterr().out
