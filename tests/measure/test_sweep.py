"""Sweeps: each combination of options is a run, which may fail or stop by itself."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import sweep
from support.clock import wait_until
from support.slow import slow
from sweep import combinations, main

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


def call(tmp_path, *words, preset="tiny"):
    given = ["--over", "seed=0,1", "target=a,b", "--out", str(tmp_path)]
    return main([*given, *words, "--", "texture", "--preset", preset])


def test_every_combination_is_a_run_with_its_own_words():
    runs = combinations(["seed=0,1", "target=a,b/c.png"], ["texture", "--preset", "tiny"])
    values = [(run.values["seed"], run.values["target"]) for run in runs]
    assert values == [(seed, target) for seed in "01" for target in ("a", "b/c.png")]
    assert " ".join(runs[1].arguments) == "texture --preset tiny --seed 0 --target b/c.png"
    assert runs[1].folder.name == "seed=0,target=b%2Fc.png"


@pytest.mark.parametrize(
    ("over", "common", "words"),
    [
        (["seed"], ["texture"], "NAME=A,B,C"),
        (["seed=0", "seed=1"], ["texture"], "must be given once"),
        (["seed=0"], ["texture", "--seed", "1"], "must be given once"),
        (["out=a,b"], ["texture"], "by itself"),
        (["seed=0"], ["texture", "--device", "cuda"], "by itself"),
        (["seed=0,1,0"], ["texture"], "each value once, got 'seed=0,1,0': leave the others out"),
        (["world_count=2"], ["texture", "--world-count=3"], "must be given once"),
        (["seed=0"], ["texture", "--max_seconds", "5"], "--max-seconds must not be given"),
        (["seed=0"], ["texture2d"], "did you mean 'texture'"),
        (["seed=0"], [], "must begin with a task"),
    ],
)
def test_mistakes_are_refused(over, common, words):
    with pytest.raises(NPAError, match=words):
        combinations(over, common)


def test_a_run_that_fails_is_tried_again_and_those_that_are_over_are_left(tmp_path, child, capsys):
    assert call(tmp_path, "--devices", "cpu", "cpu") == 1
    output = capsys.readouterr().out
    assert "| 0 | a | done |" in output
    assert "| 1 | b | failed with code 1 |" in output
    assert "seed=1,target=a failed: out of luck" in output
    assert call(tmp_path) == 0
    assert capsys.readouterr().out.count("| done |") == 4
    begun = {path.parent.name: path.read_text("utf-8") for path in tmp_path.glob("*/begun")}
    names = {f"seed={seed},target={target}": seed for seed in (0, 1) for target in "ab"}
    assert begun == {name: "x" * (seed + 1) for name, seed in names.items()}
    words = json.loads((tmp_path / "seed=0,target=b" / "words").read_text(encoding="utf-8"))
    assert words[words.index("--device") + 1] == "cpu"
    assert words[words.index("--resume") + 1] == "auto"
    assert (tmp_path / "sweep.md").read_text(encoding="utf-8").count("done") == 4


def test_parts_and_time_limits_leave_runs_to_other_calls(tmp_path, child, capsys):
    assert call(tmp_path, "--max-seconds", "1e-9") == 0
    assert "4 runs are left" in capsys.readouterr().out
    assert call(tmp_path, "--part", "1/2") == 1
    begun = {path.parent.name for path in tmp_path.glob("*/begun")}
    assert begun == {"seed=0,target=a", "seed=1,target=a"}
    with pytest.raises(NPAError, match="jobs must be at least 1"):
        call(tmp_path, "--jobs", "0")


def test_a_folder_with_runs_of_other_words_is_refused(tmp_path, child):
    call(tmp_path)
    with pytest.raises(NPAError, match="other settings: words was"):
        call(tmp_path, preset="fast")


SAVING = """
import signal, sys, time
from pathlib import Path

asked = []
def stop(number, frame):
    # As a trainer does: the second signal ends it.
    asked.append(number)
    for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, signal.SIG_DFL)
for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, stop)

words = sys.argv[1:]
out = Path(words[words.index("--out") + 1])
(out / "begun").touch()
end = time.monotonic() + 300
while not asked and time.monotonic() < end: time.sleep(0.01)
time.sleep(0.5)
(out / "saved").touch()
"""

SWEEP = f"""
import signal, sys
sys.path.insert(0, {str(Path(sweep.__file__).parent)!r})
import sweep

# Tests that nohup started ignore it, and so would all that they start.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

sweep.PROGRAM = (sys.executable, "-c", {SAVING!r})
sys.exit(sweep.main(sys.argv[1:]))
"""


def in_a_terminal(tmp_path):
    """A sweep of two runs at once, with a group of processes of its own as in a terminal."""
    words = ["--over", "seed=0,1,2", "--out", str(tmp_path)]
    return subprocess.Popen(
        [sys.executable, "-c", SWEEP, *words, "--jobs", "2", "--", "texture"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True, encoding="utf-8",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("send", "number"),
    [(os.killpg, signal.SIGINT), slow(os.kill, signal.SIGTERM), (os.kill, signal.SIGHUP)],
    ids=["ctrl-c", "SIGTERM", "SIGHUP"],
)
def test_a_sweep_that_is_stopped_lets_its_runs_save_what_they_have(tmp_path, send, number):
    run = in_a_terminal(tmp_path)
    try:
        wait_until(lambda: len(list(tmp_path.glob("*/begun"))) == 2, 300, run)
        send(run.pid, number)
        output, _ = run.communicate(timeout=300)
    finally:
        run.kill()
    assert run.returncode == 130
    assert "3 runs are left: call again with the same arguments" in output
    assert {path.parent.name for path in tmp_path.glob("*/saved")} == {"seed=0", "seed=1"}
    assert not list(tmp_path.glob("*/run.json"))
