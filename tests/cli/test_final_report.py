"""A training run ends with its report: metrics, a film and a model card, for every task."""

import json
import math
import re
from dataclasses import fields, replace

import pytest
from PIL import Image
from support.slow import slow
from support.small_digits import write_idx

from npa_envs.cli import final_report as report
from npa_envs.cli import main
from npa_envs.errors import MissingDependencyError
from npa_envs.measure import quality
from npa_envs.measure.quality import AccuracyRow, EvaluationRow, HealingRow, PictureRow
from npa_envs.measure.wounds import WoundRow
from npa_envs.render import turntable_frames, world_film
from npa_envs.training import TASKS, preset
from npa_envs.training.trainer import JOINT_TASK_NAME


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Few steps, of which one is among those that scores tell."""
    monkeypatch.setattr(report, "CHECKPOINTS", (8, 128))
    monkeypatch.setattr(report, "CLOUD_CHECKPOINTS", (8, 32))
    monkeypatch.setattr(report, "FILM_STEPS", 6)
    monkeypatch.setitem(turntable_frames.__kwdefaults__, "frame_count", 4)
    for name in ("grow_steps", "heal_steps"):
        monkeypatch.setitem(quality.healing.__wrapped__.__kwdefaults__, name, 16)


def words_of(task, folder):
    words = ["train", task, "--preset", "tiny", "--iterations", "2", "--milestones"]
    if task == "point_classification":
        words += ["--data", str(write_idx(folder / "idx")), "--class-count", "3"]
    return [*words, "--no-progress", "--out", str(folder / "run")]


@pytest.mark.parametrize("task", TASKS)
def test_a_run_of_every_task_ends_with_a_model_card_of_each_rule(task, tmp_path, capsys):
    words = words_of(task, tmp_path)
    assert main(words) == 0
    output = capsys.readouterr().out
    assert output.splitlines()[-1].split() == f"look at it npa-envs view {words[-1]}".split()
    run = tmp_path / "run"
    rules = sorted(run.glob("rule*.safetensors"))
    assert len(rules) == (2 if task == JOINT_TASK_NAME else 1)
    solid = {"turntable.gif", "points.ply", "gaussians.ply", "cloud.splat"}
    expected = solid if task == "morphogenesis3d" else set()
    for rule in rules:
        stem = rule.stem
        expected |= {stem + end for end in (".md", ".json", ".gif", ".mp4", "-filmstrip.png")}
        extra = ("states.gif", "states.png") if task == "point_classification" else ("target.png",)
        expected |= {f"{stem}-{name}" for name in extra}
        card = (run / "report" / f"{stem}.md").read_text("utf-8")
        held = json.loads((run / "report" / f"{stem}.json").read_text("utf-8"))
        assert "npa-envs train" in card
        assert "2 iterations in" in card
        assert held["machine"] in card
        assert f"Commit {held['commit']}" in card
        assert held["command"] in card
        clouds = task == "point_classification"
        assert ("projected to the plane, by class.](" in card) is clouds
        rows = held["accuracy" if clouds else "growth"]
        assert [row["step"] for row in rows] == ([8, 32] if clouds else [8, 128])
        for row in rows:
            line, *_ = re.findall(rf"^\| {row['step']} \| (.*?) \|", card, re.MULTILINE)
            assert float(line) == pytest.approx(row["majority" if clouds else "loss"], rel=1e-3)
        with Image.open(run / "report" / f"{stem}.gif") as film:
            assert film.n_frames == 7
            assert min(film.size) >= 256
        (said,) = re.findall(rf"report +{re.escape(str(run / 'report' / stem))}\.md: (.*)", output)
        assert said
        if task == "morphogenesis2d":
            again = run / "again.json"
            command = held["command"].removeprefix("npa-envs ").split()
            assert main([*command, "--no-progress", "--json", str(again)]) == 0
            assert json.loads(again.read_text("utf-8"))["growth"] == held["growth"]
    assert {path.name for path in (run / "report").iterdir()} == expected


def test_a_run_writes_no_report_where_none_is_wanted_or_no_iteration_was_done(tmp_path, capsys):
    words = words_of("morphogenesis2d", tmp_path)
    assert main([*words, "--no-report"]) == 0
    assert f"look at it  npa-envs view {words[-1]}" in capsys.readouterr().out
    assert main([*words, "--overwrite", "--max-seconds", "1e-9"]) == 0
    assert not (tmp_path / "run" / "report").exists()
    assert main([*words, "--resume"]) == 0
    card = (tmp_path / "run" / "report" / "rule.md").read_text("utf-8")
    assert f"npa-envs train morphogenesis2d --config {tmp_path / 'run' / 'config.json'}\n" in card
    assert main([*words, "--overwrite", "--no-report"]) == 0
    assert not list((tmp_path / "run" / "report").iterdir())
    assert "  report  " not in capsys.readouterr().out.rpartition("finished")[2]


def test_a_report_without_ffmpeg_has_all_but_the_film_that_needs_it(tmp_path, capsys, monkeypatch):
    def refuse(*_arguments):
        raise MissingDependencyError("an MP4 file needs imageio with ffmpeg")

    monkeypatch.setattr(world_film, "write_mp4", refuse)
    assert main(words_of("morphogenesis2d", tmp_path)) == 0
    said = r"report .*rule\.md: .*; not all films: an MP4 file needs"
    assert re.search(said, capsys.readouterr().out)
    files = {path.name for path in (tmp_path / "run" / "report").iterdir()}
    assert files == {"rule.md", "rule.json", "rule.gif", "rule-filmstrip.png", "rule-target.png"}


@pytest.mark.parametrize(("factor", "holds"), [(1.0, True), (10.0, False), slow(math.nan, False)])
def test_a_report_says_where_worlds_do_not_hold(factor, holds, tmp_path, capsys, monkeypatch):
    measure = report.tables_of

    def measured(*told, **options):
        tables = measure(*told, **options)
        first, last = tables["growth"]
        return {"growth": [first, replace(last, loss=factor * first.loss)]}

    monkeypatch.setattr(report, "tables_of", measured)
    assert main(words_of("morphogenesis2d", tmp_path)) == 0
    output = capsys.readouterr().out
    said = " unstable: at step 128 the loss is many times the least"
    assert (said in output) is not holds
    commands = re.findall("train on: npa-envs (.*)", output)
    card = (tmp_path / "run" / "report" / "rule.md").read_text("utf-8")
    assert "- 2 iterations of the 40 of the preset `tiny`." in card
    (command,) = commands
    assert f"To train on:\n\n```sh\nnpa-envs {command}\n" in card
    assert main([*command.split(), "--no-progress", "--no-report"]) == 0
    assert "finished: 40 iterations" in capsys.readouterr().out
    assert (tmp_path / "run2" / "rule.safetensors").exists()


def test_a_report_names_the_next_step_of_short_runs_and_what_is_usual_for_the_preset(tmp_path):
    path, task = tmp_path / "lizard2" / "rule.safetensors", "morphogenesis2d"
    short = preset("fast", task, target="heart", iterations=60)
    usual, command = report.next_steps(path, task, short, {})
    assert usual == ["60 iterations of the 2400 of the preset `fast`"]
    assert command.endswith(f"--iterations 2400 --out {tmp_path / 'lizard3'}")
    (tmp_path / "lizard3").mkdir()
    assert report.next_steps(path, task, short, {})[1].endswith("lizard4")
    tables = {"healing": [WoundRow("wipe, radius 0.2", 6, 6, 0, 0.1, 1.0, 0.3, scars="top")]}
    (usual,), command = report.next_steps(path, task, preset("fast", task), tables)
    assert (usual[:17], command) == ("usual for `fast`;", "")
    assert report.next_steps(path, task, preset("best", task), tables) == ([], "")
    assert report.next_steps(path, task, preset("fast", task), {}) == ([], "")


@pytest.mark.parametrize("task", TASKS)
def test_a_configuration_is_taken_for_the_preset_that_it_was_made_of(task):
    for name in TASKS[task].presets:
        config = preset(name, task, iterations=2, milestones=(), seed=5, device="cuda")
        assert report.nearest_preset(task, config) == name


def test_a_rule_that_cannot_be_measured_is_kept_and_said_to_have_no_report(
    tmp_path, capsys, monkeypatch
):
    # The untrained rule's worlds leave all that float32 can say.
    monkeypatch.setattr(report, "CHECKPOINTS", (8, 4096))
    words = words_of("morphogenesis2d", tmp_path)
    assert main([*words, "--learning-rate", "1"]) == 0
    assert "no report   x must be finite" in capsys.readouterr().out
    assert (tmp_path / "run" / "rule.safetensors").exists()


def test_a_card_says_in_words_what_does_not_hold():
    growth = [EvaluationRow(8, 0.1, 0.1, 25.0, 24.0, 0.0, 1.0)]
    assert report.shortfalls({"growth": growth}) == []
    rough = [replace(growth[0], step=16, psnr=15.0)]
    assert report.shortfalls({"growth": rough}) == ["unlike the target: 15.0 dB at step 16"]
    wide = [*growth, replace(growth[0], step=16, extent=2.5)]
    escape = "particles escape: the world is 1.0 wide at step 8 and 2.5 at step 16"
    assert report.shortfalls({"growth": wide}) == [escape]
    wound = WoundRow("wipe, radius 0.2", 6, 5, 3, 0.1, 1.0, 0.3, scars="top left, bottom")
    whole = HealingRow("cut, gap 0.1", 0.1, 0.5, None, 6, 8, 0.2)
    assert report.shortfalls({"growth": growth, "healing": [wound, whole]}) == [
        "5 of 6 wipes, radius 0.2, left a mark, and 2 of these did not heal (top left, bottom); "
        "the mean loss becomes 3.0 times that before",
        "after a cut, gap 0.1, 2 of 8 worlds do not heal; the mean loss becomes 2.0 times that "
        "before",
    ]
    lone = report.shortfalls({"healing": [replace(wound, changed=1, healed=0)]})
    assert lone[0].startswith("1 of 6 wipes, radius 0.2, left a mark, and it did not heal (top")
    healed = replace(wound, healed=5)
    assert report.shortfalls({"growth": growth, "healing": [healed]}) == []


def test_a_card_explains_each_column_of_its_tables():
    rows = {EvaluationRow, HealingRow, WoundRow, AccuracyRow, PictureRow}
    names = {field.name for row in rows for field in fields(row)}
    assert names - report.WORDS.keys() == {"world_count", "target"}
