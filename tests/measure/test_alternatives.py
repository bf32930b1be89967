"""The library against its alternatives: real strategies, true errors, and a guard that bites."""

import json
import math
import sys
from pathlib import Path

import alternatives
import pytest
import torch
from strategies import STRATEGIES

from npa_envs import reference
from npa_envs.errors import NPAError
from npa_envs.measure.speed.timing import Workload
from npa_envs.world.rollout import rollout

TINY = Workload(2, 2, 150, 2, hidden_dim=16, eps=0.2)
FORWARD = 1e-5
"""Relative error that float32 may have in one perception; the worst measured is 3.2e-7."""


def session(**options) -> alternatives.Alternatives:
    return alternatives.Alternatives(torch.device("cpu"), repeats=1, small=True, **options)


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


def test_steps_composed_in_torch_are_those_of_the_library_with_the_same_masks():
    start = alternatives.gecko(1, 300, torch.device("cpu")).grown(3)
    rule, x, s = start.rule.double(), start.x.double(), start.s.double()
    own = rollout(rule, x, s, 3, update_prob=0.5, generator=alternatives.mask_source(x))
    generator = alternatives.mask_source(x)
    assert not torch.equal(own[0], x)
    for _ in range(3):
        mask = alternatives.drawn_mask(x, 0.5, generator)
        x, s = alternatives.composed_step(STRATEGIES["dense"], rule, x, s, mask)
    for value, expected in zip((x, s), own, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-10, atol=1e-10)


def test_perception_in_float32_errs_little_and_the_reference_not_at_all():
    here = session()
    rows = alternatives.perception_rows(here, TINY)
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
    assert {"tf32", "perception in mixed", "plain, float32, 2D (2, 150)"} <= {*here.left_out}


def stored(tmp_path: Path, **values: float) -> Path:
    path = tmp_path / "ratios.json"
    path.write_text(json.dumps({"cpu": values}), encoding="utf-8")
    return path


def test_a_ratio_is_held_down_to_a_third_and_missed_below(tmp_path):
    path = stored(tmp_path, dense=30.0, grid=3.0)
    wanted = alternatives.stored_ratios(path, torch.device("cpu"))
    assert alternatives.missed_ratios({"dense": 10.1, "grid": 5.0}, wanted) == []
    (line,) = alternatives.missed_ratios({"dense": 9.9, "grid": 5.0}, wanted)
    assert line == "dense: 9.9, stored 30, at least 10 wanted"
    assert len(alternatives.missed_ratios({"dense": math.nan}, wanted)) == 2


def test_the_library_is_faster_than_dense_torch_and_stored_ratios_are_those_measured():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "ratios.json"
    measured = alternatives.ratios(session())
    assert measured["perceive: dense torch over library"] > 3.0
    assert all(value > 0.0 for value in measured.values())
    assert sorted(json.loads(path.read_text(encoding="utf-8"))["cpu"]) == sorted(measured)


def test_the_script_prints_tables_writes_what_it_says_and_checks_ratios(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(
        alternatives,
        "accuracy",
        lambda here: {"perception": alternatives.perception_rows(here, TINY)},
    )
    monkeypatch.setattr(alternatives, "WORKLOAD", Workload(2, 1, 100, 1, hidden_dim=16))

    def script(*words):
        given = ["alternatives.py", "--device", "cpu", "--repeats", "1", *words]
        monkeypatch.setattr(sys, "argv", given)
        return alternatives.main()

    name, path = "perceive: dense torch over library", tmp_path / "record.json"
    held = ["--check", str(stored(tmp_path, **{name: 1e-3}))]
    assert script(*held, "--output", str(path), "--commit", "abc") == 0
    text = capsys.readouterr().out
    for word in ("perception:", "neighbour_cap", "bf16_storage", "left out:", "times faster:"):
        assert word in text
    assert text.endswith("ratios are held\n")
    loaded = json.loads(path.read_text(encoding="utf-8"))
    assert loaded["commit"] == "abc"
    assert sorted(loaded["ratios"])[-1] == "step: composed in torch over fused"
    strategies = {row["strategy"] for row in loaded["tables"]["perception"]}
    assert strategies == set(STRATEGIES) - {"plain"}
    missed = str(stored(tmp_path, **{name: 1e9}))
    assert script("--strategies", "library", "--check", missed) == 1
    assert f"missed: {name}" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["{}", "[]", "no json", '{"cpu": {"a": "fast"}}'])
def test_a_file_without_ratios_is_refused(text, tmp_path):
    path = tmp_path / "ratios.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(NPAError, match="must hold ratios under 'cpu'"):
        alternatives.stored_ratios(path, torch.device("cpu"))
