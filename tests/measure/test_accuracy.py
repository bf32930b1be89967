"""The stress command finds what breaks, says where, and continues where it was stopped."""

import copy
import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch
from support.slow import slow

from npa_envs.cli import main
from npa_envs.cli.common import named_rules
from npa_envs.errors import NPAError
from npa_envs.measure import accuracy
from npa_envs.measure.accuracy import all_checks, check_runner, hard_cases, trained_rule_checks
from npa_envs.measure.accuracy import scenes as places
from npa_envs.measure.accuracy.check_runner import GROUPS, Check, CheckResult, CheckSession, Skipped
from npa_envs.measure.accuracy.scenes import scenes
from npa_envs.measure.accuracy.trained_rule_checks import rule_worlds
from npa_envs.rule.files import load_rule, rule_digest, rule_file, rule_metadata, save_rule
from npa_envs.training import preset, train

CHECKS = {check.name: check for check in all_checks(quick=True)}
FACTS = {"device": "cpu", "commit": "0"}


def session(device: torch.device | None = None) -> CheckSession:
    return CheckSession(device or torch.device("cpu"), quick=True)


def stub_check(name: str, **fields) -> Check:
    """A check with this result."""
    return Check(name, "as given", lambda session: CheckResult(**{"metrics": {}, **fields}))


# The registry


def test_every_check_has_a_name_of_its_own_a_group_and_an_expectation():
    for quick in (False, True):
        checks = all_checks(quick=quick)
        assert len({check.name for check in checks}) == len(checks)
        assert {check.group for check in checks} == set(GROUPS)
        assert all(check.expected for check in checks)


def test_checks_are_chosen_by_group_by_name_and_by_how_names_begin():
    checks = list(CHECKS.values())
    groups = {check.group for check in check_runner.chosen_checks(checks, ["time", "values"])}
    assert groups == {"time", "values"}
    assert [c.name for c in check_runner.chosen_checks(checks, ["time/gecko"])] == ["time/gecko"]
    clumps = check_runner.chosen_checks(checks, ["geometry/clump"])
    where = ["2d/open", "2d/periodic", "3d/open", "3d/periodic"]
    assert [c.name.removeprefix("geometry/clump/") for c in clumps] == where
    assert check_runner.chosen_checks(checks, []) == checks
    with pytest.raises(NPAError, match="unknown check 'geometri': did you mean 'geometry'"):
        check_runner.chosen_checks(checks, ["geometri"])


# Verdicts


@pytest.mark.parametrize(
    ("metrics", "holds", "verdict"),
    [
        ({"error": 1.0}, "", "pass"),
        ({"error": 1.5}, "", "fail"),
        ({"error": math.nan}, "", "fail"),
        ({"error": math.inf}, "", "fail"),
        ({}, "", "fail"),
        ({"error": 0.5}, "0.1 … 1", "range"),
        ({"error": 1.5}, "0.1 … 1", "fail"),
    ],
)
def test_a_figure_above_its_limit_not_a_number_or_missing_fails(metrics, holds, verdict):
    assert CheckResult({**metrics, "other": 9.0}, {"error": 1.0}, holds).verdict == verdict


def test_the_worst_figure_is_named():
    result = CheckResult({"x": 1.0, "y": 3.0}, {"x": 10.0, "y": 4.0, "z": 1.0})
    assert result.worst() == "z nan (at most 1)"
    assert result.fraction("y") == 0.75
    assert CheckResult({"x": 1.0}, {"x": 0.0}).fraction("x") == math.inf
    assert CheckResult({"x": 0.0}, {"x": 0.0}).fraction("x") == 0.0


def test_what_raises_has_failed_and_the_others_go_on():
    def raising(error: Exception) -> Check:
        def run(session: CheckSession) -> CheckResult:
            raise error

        return Check(f"values/{type(error).__name__}", "no error", run)

    record = check_runner.StressRecord(FACTS)
    errors = (ZeroDivisionError("by\nzero"), Skipped("no device"), torch.OutOfMemoryError("much"))
    check_runner.run_checks([*map(raising, errors), stub_check("values/last")], session(), record)
    verdicts = {entry.name: (entry.verdict, entry.note) for entry in record.rows}
    assert verdicts == {
        "values/ZeroDivisionError": ("fail", "ZeroDivisionError: by zero"),
        "values/Skipped": ("skipped", "no device"),
        "values/OutOfMemoryError": ("skipped", "not enough memory"),
        "values/last": ("pass", ""),
    }
    assert "values/ZeroDivisionError failed: ZeroDivisionError: by zero" in record.text()
    assert record.text().endswith("1 pass, 0 range, 1 fail, 2 skipped")


# Records


def test_a_record_comes_back_as_it_was_written(tmp_path: Path):
    path = tmp_path / "record.json"
    assert check_runner.StressRecord(FACTS, path).read().rows == []
    metrics = {"a": 1.5, "b": math.inf, "c": math.nan}
    record = check_runner.StressRecord(FACTS, path)
    record.store(CheckResult(metrics, {"a": 1.0}, note="n", name="x/y", expected="s"))
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert stored["counts"] == {"pass": 0, "range": 0, "fail": 1, "skipped": 0}
    assert stored["checks"][0]["figures"] == {"a": 1.5, "b": "inf", "c": "nan"}
    assert repr(check_runner.StressRecord(FACTS, path).read().rows) == repr(record.rows)


def test_a_run_goes_on_where_it_was_and_repeats_what_did_not_pass():
    ran: list[str] = []

    def counted(name: str, **fields) -> Check:
        check = stub_check(name, **fields)
        return dataclasses.replace(check, run=lambda here: ran.append(name) or check.run(here))

    failing = {"metrics": {"x": 2.0}, "limits": {"x": 1.0}}
    checks = [counted("a/1"), counted("a/2", **failing), counted("a/3", holds="all")]
    record, sizes = check_runner.StressRecord(FACTS), []
    record.write = lambda: sizes.append(len(record.rows))
    check_runner.run_checks(checks, session(), record)
    assert sizes == [1, 2, 3]
    check_runner.run_checks(checks, session(), record)
    assert ran == ["a/1", "a/2", "a/3", "a/2"]
    late = check_runner.StressRecord(FACTS)
    verdicts = []
    # No time is no reason to forget that something failed.
    for seconds in (0.0, None, 0.0):
        check_runner.run_checks(checks, session(), late, max_seconds=seconds)
        verdicts.append([entry.verdict for entry in late.rows])
    assert verdicts == [["skipped"] * 3, *(2 * [["pass", "fail", "range"]])]


# What the checks find


AS_EXPECTED = """
    geometry/touching/2d/open geometry/far/3d/open geometry/seam/2d/periodic
    geometry/tight_box/3d/periodic geometry/threshold/2d geometry/smooth_inverse/3d
    geometry/crowd/2d geometry/nearest/2d values/infinite_channel/2d values/gradient_of_nan
    values/nan_state values/nan_position precision/order/2d precision/batch/3d
    precision/repeated/2d gradients/finite_differences/2d/periodic
"""


@pytest.mark.parametrize("name", AS_EXPECTED.split())
def test_the_library_is_as_expected(name, device):
    entry = check_runner.run_check(CHECKS[name], session(device))
    assert entry.verdict in ("pass", "range"), (entry.worst(), entry.note)


@pytest.mark.parametrize("factor", [1.0 + 1e-5, math.nan])
def test_a_wrong_operator_is_found_out(factor, monkeypatch):
    def wrong(*arguments, **options):
        return right(*arguments, **options) * factor

    for module in (places, hard_cases):
        right = module.perceive
        monkeypatch.setattr(module, "perceive", wrong)
    for name in ("geometry/clump/2d/open", "geometry/threshold/2d", "geometry/outside/3d"):
        assert check_runner.run_check(CHECKS[name], session()).verdict == "fail"
    difference = check_runner.run_check(CHECKS["gradients/finite_differences/2d/open"], session())
    # A wrong factor is differentiated rightly; what is not a number is not.
    assert difference.verdict == ("fail" if math.isnan(factor) else "pass")


@pytest.mark.parametrize(
    ("module", "name"),
    [(hard_cases, "geometry/smooth_inverse/2d"), (places, "precision/repeated/2d")],
)
def test_jumps_and_results_that_change_from_call_to_call_are_found_out(module, name, monkeypatch):
    right, calls = module.perceive, iter(range(1000))

    def wrong(*arguments, **options):
        if "moment_inverse" in options:
            return right(*arguments, **options | {"moment_inverse": "threshold"})
        return right(*arguments, **options) * (1.0 + 1e-6 * next(calls))

    monkeypatch.setattr(module, "perceive", wrong)
    assert check_runner.run_check(CHECKS[name], session()).verdict == "fail"


def test_no_limit_is_more_than_a_scene_asks_for():
    """Limits follow from how answers change with their last bit, and must not become vacuous."""
    for space_dim in (2, 3):
        for periodic in (False, True):
            for scene in scenes(space_dim, periodic=periodic):
                exact = places.perceived(scene.x, scene.s, scene.box, by_reference=True)
                limits = places.error_limits(scene.x, scene.s, scene.box, exact)
                assert limits.keys() == places.LIMITS.keys()
                for name, limit in limits.items():
                    assert places.LIMITS[name] <= limit < 1e-2, (scene.name, name)


@pytest.mark.parametrize(
    ("factor", "count", "verdict"), [(1.0, 256, "pass"), (20.0, 256, "fail"), (1.0, 1, "pass")]
)
def test_a_rule_that_blows_up_is_found_out(factor, count, verdict, device, monkeypatch):
    def tampered(*arguments, **options):
        start = rule_worlds(*arguments, **options)
        rule = copy.deepcopy(start.rule)
        with torch.no_grad():
            rule.output.weight *= factor
        return start._replace(rule=rule, worlds=start.worlds.map(lambda part: part[:, :count]))

    monkeypatch.setattr(trained_rule_checks, "rule_worlds", tampered)
    entry = check_runner.run_check(
        CHECKS["time/heart" if count == 1 else "time/dots"], session(device)
    )
    if count == 1:
        # A world that extends nowhere is measured all the same.
        assert (entry.metrics["extent"], entry.metrics["drift"] >= 0.0) == (0.0, True)
    else:
        assert entry.verdict == verdict
        assert (entry.note == "") == (verdict == "pass")


@pytest.mark.parametrize(
    "fields",
    [
        {"equivariant": True},
        slow({"targets": ("ring", "heart"), "code_dim": 3}),
        {"targets": ("ring", "heart"), "code_dim": 3, "encoder": True},
        {"division": True},
    ],
    ids=["equivariant", "coded", "encoded", "dividing"],
)
def test_rules_of_every_kind_in_files_are_checked_by_themselves(fields, tmp_path, device):
    config = preset("tiny", **fields, iterations=2, device=str(device), out=tmp_path / "mine")
    train(config, progress=False)
    sources = named_rules([str(tmp_path / "mine")])
    assert sources == {"mine": str(tmp_path / "mine")}
    checks = all_checks(quick=True, rules=sources)
    assert [check.name for check in checks] == [
        "time/mine",
        "gradients/norm/mine",
        "gradients/float32/mine",
    ]
    entries = {check.name: check_runner.run_check(check, session(device)) for check in checks}
    assert all(entry.metrics or entry.verdict == "skipped" for entry in entries.values())
    assert entries["gradients/norm/mine"].verdict == "pass"
    alike = entries["gradients/float32/mine"]
    assert alike.verdict == ("skipped" if "division" in fields else "range"), alike.worst()


# The command


def test_the_command_writes_a_record_and_goes_on(tmp_path, capsys, monkeypatch):
    words = ["stress", "--quick", "--no-progress", "--out", str(tmp_path), "--commit", "x"]
    assert main([*words, "--only", "geometry/one", "values/nan_position"]) == 0
    record = json.loads((tmp_path / "stress_cpu_quick.json").read_text(encoding="utf-8"))
    assert record["counts"] == {"pass": 5, "range": 0, "fail": 0, "skipped": 0}
    assert record["facts"]["commit"] == "x"
    assert "5 pass" in capsys.readouterr().out
    broken = stub_check("values/nan_position", metrics={"x": 1.0}, limits={"x": 0.0})
    monkeypatch.setattr(accuracy, "all_checks", lambda **_: [broken, CHECKS["time/heart"]])
    assert main(["stress", "--no-progress", "--only", "values"]) == 1
    assert "values/nan_position failed: x 1 (at most 0)" in capsys.readouterr().out
    assert main([*words, "--only", "values"]) == 0
    assert "1 of 1 checks were done before" in capsys.readouterr().out


def test_checks_of_a_rule_that_was_trained_anew_are_run_again(tmp_path, capsys):
    rule = load_rule("heart")
    metadata = {"task": "morphogenesis2d", "config": rule_metadata(rule_file("heart"))["config"]}
    path = tmp_path / "mine.safetensors"
    save_rule(rule, path, metadata=metadata)
    words = ["stress", str(path), "--quick", "--no-progress", "--out", str(tmp_path)]
    words += ["--commit", "x", "--only", "gradients/norm"]

    def verdict():
        main(words)
        stored = json.loads((tmp_path / "stress_cpu_quick.json").read_text(encoding="utf-8"))
        (entry,) = stored["checks"]
        return entry["weights"], entry["verdict"]

    assert verdict() == (rule_digest(rule), "pass")
    capsys.readouterr()
    assert verdict() == (rule_digest(rule), "pass")
    assert "1 of 1 checks were done before" in capsys.readouterr().out
    before = rule_digest(rule)
    with torch.no_grad():
        rule.output.weight.mul_(1.01)
    save_rule(rule, path, metadata=metadata)
    assert verdict() == (rule_digest(rule), "pass")
    assert rule_digest(rule) != before
    assert "done before" not in capsys.readouterr().out


def test_two_rules_of_one_name_are_refused(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        save_rule(load_rule("heart"), tmp_path / folder / "heart.safetensors")
    first, second = (str(tmp_path / name / "heart.safetensors") for name in ("a", "b"))
    assert named_rules([first, first]) == {"heart": first}
    for words in ([first, second], ["heart", second]):
        with pytest.raises(NPAError, match=r"different names, but .* are both called 'heart'"):
            named_rules(words)


def test_the_command_lists_its_checks(capsys):
    assert main(["stress", "--list", "--only", "values"]) == 0
    text = capsys.readouterr().out
    assert "values/nan_state: NaN in one state spreads in its own world only" in text
    assert "geometry" not in text
    assert main(["stress", "heart", "seven-pictures", "--list", "--only", "time"]) == 0
    text = capsys.readouterr().out
    names = ("time/heart:", "time/seven-pictures:", "time/dots:")
    assert [name in text for name in names] == [True, True, False]
    assert main(["stress", "hart"]) == 2
    assert "unknown rule 'hart': did you mean 'heart'" in capsys.readouterr().err


@pytest.mark.slow
def test_everything_quick_is_as_expected(device):
    record = check_runner.StressRecord(FACTS)
    check_runner.run_checks(list(CHECKS.values()), session(device), record)
    assert record.counts()["fail"] == 0, record.text()
