"""The shipped rules do what their cards and scores say."""

import json
import re

import pytest
from support.slow import slow

import npa_envs
from npa_envs.cli import main
from npa_envs.measure.quality import accuracies, evaluate, scores
from npa_envs.rule.files import rule_metadata, shipped_rules
from npa_envs.training.task_of_rule import has_data, task_of_rule

UNSEEN = range(1_000_000, 1_000_001)
RULES = shipped_rules()
TASK_OF = {name: rule_metadata(path)["task"] for name, path in RULES.items()}


def named(task):
    return [name for name, of in TASK_OF.items() if of == task]


def growth(name):
    return {row["step"]: row for row in scores(name)["growth"]}


@pytest.mark.parametrize("name", RULES)
def test_a_card_says_what_was_measured(name):
    card = RULES[name].with_suffix(".md").read_text("utf-8")
    assert card.startswith(f"# {name}\n")
    assert "npa-envs train" in card
    config = json.loads(rule_metadata(RULES[name])["config"])
    assert not {"out", "device", "initial_rule"} & set(config)
    # JSON without NaN.
    json.loads(RULES[name].with_suffix(".json").read_text("utf-8"), parse_constant=pytest.fail)
    measured = scores(name)
    assert re.fullmatch(r"[0-9a-f]{7}", measured["commit"])
    assert measured["machine"] in card
    rows = measured.get("growth") or measured["accuracy"]
    for row in rows:
        (line,) = re.findall(rf"^\| {row['step']} \| .*$", card, re.MULTILINE)
        cell = line.split(" | ")[1]
        if "accuracy" in measured:
            assert cell == f"{100 * row['majority']:.1f} %"
        else:
            digits = len(cell.partition(".")[2])
            assert cell == f"{row['loss']:.{digits}f}"


def test_what_is_grown_lasts_and_the_classifier_is_right():
    counts = {task: len(named(task)) for task in set(TASK_OF.values())}
    assert counts["morphogenesis2d"] >= 6
    assert counts["texture"] >= 4
    assert counts["morphogenesis3d"] >= 2
    for name in named("morphogenesis3d"):
        assert growth(name)[512]["psnr"] > growth(name)[128]["psnr"] - 2.0, name
    for name in named("morphogenesis2d"):
        assert max(growth(name)[step]["loss"] for step in (512, 4096)) <= 0.18, name
    for name in named("point_classification"):
        (row,) = (row for row in scores(name)["accuracy"] if row["step"] == 32)
        assert row["majority"] >= 0.975
        assert row["particle"] >= 0.96
        changes = {(row["change"], row["steps"]): row for row in scores(name)["changes"]}
        assert changes["25% cut off", 32]["majority"] >= row["majority"] - 0.02
        assert changes["all mutated", 32]["majority"] >= 0.95


GROWING = [n for task in ("morphogenesis2d", "texture", "morphogenesis3d") for n in named(task)]
QUICK = named("morphogenesis2d")[0], named("texture")[0]


@pytest.mark.parametrize("name", [n if n in QUICK else slow(n) for n in GROWING])
def test_a_world_grows_as_measured(name, device):
    rule = npa_envs.load_rule(name, device=device)
    trained = task_of_rule(name, rule, device)
    assert trained.why_not_measurable is None
    first, *_ = (row for row in scores(name)["growth"])
    rows = evaluate(rule, trained.task, checkpoints=(first["step"],), seeds=UNSEEN, device=device)
    # One world's loss lies about the mean of all as the worst one does.
    spread = first["loss_worst"] - first["loss"]
    assert abs(rows[0].loss - first["loss"]) < 2.0 * spread + 0.02 * first["loss"]


@pytest.mark.parametrize(("count", "tolerance"), [(64, 0.02), slow(None, 0.012)])
@pytest.mark.parametrize("name", named("point_classification"))
def test_clouds_say_what_they_are_as_measured(name, count, tolerance, device):
    if not has_data(name):
        pytest.skip(f"the data of {name} are not shipped")
    rule = npa_envs.load_rule(name, device=device)
    task = task_of_rule(name, rule, device).task
    task.clouds.label = task.clouds.label[:count]
    (row,) = accuracies(rule, task, checkpoints=(32,))
    (measured,) = (row for row in scores(name)["accuracy"] if row["step"] == 32)
    assert row.majority == pytest.approx(measured["majority"], abs=tolerance)
    assert row.particle == pytest.approx(measured["particle"], abs=tolerance)


def test_the_list_tells_every_score(capsys):
    assert main(["list", "rules"]) == 0
    text = capsys.readouterr().out
    for name in RULES:
        (line,) = re.findall(rf"^    {name} +\d+ weights  (.*)$", text, re.MULTILINE)
        measured = scores(name)
        table, column, scale = "growth", "loss", 1.0
        if "judge" in measured:
            table, column = "judge", "ratio"
        elif "accuracy" in measured:
            table, column, scale = "accuracy", "majority", 100.0
        elif measured["metric"] == "view loss":
            column = "psnr"
        stored = {row["step"]: scale * row[column] for row in measured[table]}
        told = re.findall(r"([\d.]+)%? at (\d+)", line)
        assert {step for _, step in told} == {str(n) for n in (32, 128, 512, 4096) if n in stored}
        for value, step in told:
            half = 0.501 * 10.0 ** -len(value.partition(".")[2])
            assert float(value) == pytest.approx(stored[int(step)], abs=half)
    assert "gecko       10880 weights  0.078 at 128, 0.075 at 512, 0.088 at 4096" in text
    assert "digits      28170 weights  98.1% at 32" in text
