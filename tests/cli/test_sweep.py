"""Sweeps: each combination of options is a run, which may fail or stop by itself."""

import json
import sys

import pytest

from npa_envs.cli import main, sweep
from npa_envs.cli.sweep import combinations
from npa_envs.errors import NPAError

CHILD = """
import json, sys
from pathlib import Path
words = sys.argv[1:]
out = Path(words[words.index("--out") + 1])
with (out / "begun").open("a") as file: file.write("x")
if "1" in words and not (out / "second").exists():
    (out / "second").touch()
    sys.exit("out of luck")
(out / "words").write_text(json.dumps(words))
"""


@pytest.fixture
def child(monkeypatch):
    monkeypatch.setattr(sweep, "PROGRAM", (sys.executable, "-c", CHILD))


def call(tmp_path, *words):
    given = ["sweep", "--over", "seed=0,1", "target=a,b", "--out", str(tmp_path), "--no-progress"]
    return main([*given, *words, "--", "texture", "--preset", "tiny"])


def test_every_combination_is_a_run_with_its_own_words():
    runs = combinations(["seed=0,1", "target=a,b/c.png"], ["texture", "--preset", "tiny"])
    assert [dict(run.values) for run in runs] == [
        {"seed": "0", "target": "a"},
        {"seed": "0", "target": "b/c.png"},
        {"seed": "1", "target": "a"},
        {"seed": "1", "target": "b/c.png"},
    ]
    assert " ".join(runs[1].words) == "texture --preset tiny --seed 0 --target b/c.png"
    assert runs[1].name == "seed=0,target=b_c.png"


@pytest.mark.parametrize(
    ("over", "common", "words"),
    [
        (["seed"], ["texture"], "NAME=A,B,C"),
        (["seed=0,"], ["texture"], "NAME=A,B,C"),
        (["seed=0", "seed=1"], ["texture"], "must be given once"),
        (["seed=0"], ["texture", "--seed", "1"], "must be given once"),
        (["out=a,b"], ["texture"], "by itself"),
        (["seed=0"], ["texture", "--device", "cuda"], "by itself"),
        (["seed=0"], ["texture2d"], "did you mean 'texture'"),
        (["seed=0"], [], "must begin with a task"),
    ],
)
def test_mistakes_are_told(over, common, words):
    with pytest.raises(NPAError, match=words):
        combinations(over, common)


def test_a_run_that_fails_is_tried_again_and_those_that_are_over_are_left(tmp_path, child, capsys):
    assert call(tmp_path, "--devices", "cpu", "cpu") == 1
    told = capsys.readouterr().out
    assert "| 0 | a | done |" in told
    assert "| 1 | b | failed with code 1 |" in told
    assert "seed=1,target=a failed: out of luck" in told
    assert call(tmp_path) == 0
    assert capsys.readouterr().out.count("| done |") == 4
    begun = {path.parent.name: path.read_text() for path in tmp_path.glob("*/begun")}
    assert begun == {
        f"seed={seed},target={target}": "x" * (seed + 1) for seed in (0, 1) for target in "ab"
    }
    words = json.loads((tmp_path / "seed=0,target=b" / "words").read_text())
    assert words[words.index("--device") + 1] == "cpu"
    assert words[words.index("--resume") + 1] == "auto"
    assert (tmp_path / "sweep.md").read_text().count("done") == 4


def test_parts_and_time_limits_leave_runs_to_other_calls(tmp_path, child, capsys):
    assert call(tmp_path, "--max-seconds", "1e-9") == 0
    assert "4 runs are left" in capsys.readouterr().out
    assert call(tmp_path, "--part", "1/2") == 1
    assert {path.parent.name for path in tmp_path.glob("*/begun")} == {
        "seed=0,target=a",
        "seed=1,target=a",
    }
    with pytest.raises(SystemExit):
        main(["sweep", "--out", str(tmp_path)])
    assert main(["sweep", "--over", "seed=0", "--part", "3/2", "--", "texture"]) == 2
    assert "must be K/N" in capsys.readouterr().err


def test_a_folder_with_runs_of_other_words_is_refused(tmp_path, child, capsys):
    call(tmp_path)
    words = ["sweep", "--over", "seed=0,1", "target=a,b", "--out", str(tmp_path)]
    assert main([*words, "--", "texture", "--preset", "fast"]) == 2
    assert "holds a run of other words" in capsys.readouterr().err


@pytest.mark.slow
def test_a_sweep_trains_in_folders_of_their_own(tmp_path, capsys):
    words = ["sweep", "--over", "seed=0,1", "--out", str(tmp_path), "--no-progress", "--"]
    tiny = ["--preset", "tiny", "--iterations", "1", "--target", "heart", "--no-report"]
    assert main([*words, "morphogenesis2d", *tiny]) == 0
    assert capsys.readouterr().out.count("| done |") == 2
    for seed in (0, 1):
        assert (tmp_path / f"seed={seed}" / "rule.safetensors").is_file()
