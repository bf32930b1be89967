"""`npa-envs learn`: a run that is kept, and goes on; by one process and by two."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.clock import Clock, wait_until

from npa_envs.cli import main
from npa_envs.cli.common import problem_of
from npa_envs.cli.learn import parse
from npa_envs.training.checkpoint import load_checkpoint
from npa_envs.training.run_folder import Run

WORDS = ["learn", "ppo", "npa/Morphogenesis2DSmall-v0", "--keywords", "target=ring"]
WORDS += ["--num-envs", "2", "--episode-steps", "4", "--episodes", "1", "--curve-points", "2"]
WORDS += ["--options", "steps=4"]
ROUND = 4 * 2 * 64


def points(out):
    """The lines of the curve."""
    log = out / "log.jsonl"
    text = log.read_text(encoding="utf-8") if log.exists() else ""
    return [json.loads(line) for line in text.splitlines()]


def learned(out, rounds, *words):
    """The exit code, and the rounds of the curve's points."""
    budget = ["--particle-steps", str(rounds * ROUND), "--out", str(out)]
    code = main([*WORDS, *budget, *words])
    return code, [point["particle_steps"] // ROUND for point in points(out)]


def test_a_run_begins_and_goes_on_with_the_same_words(tmp_path, capsys):
    assert learned(tmp_path, 2, "--resume", "auto") == (0, [0, 1, 2])
    assert learned(tmp_path, 4, "--resume", "auto") == (0, [0, 1, 2, 4])
    output = capsys.readouterr().out
    assert output.count("return") == 4
    assert f"finished: rules, curve and checkpoint are in {tmp_path}/" in output


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc")
def test_a_killed_process_ends_a_run_and_a_signal_stops_it(tmp_path):
    words = [*WORDS, "--particle-steps", "1e9", "--learning-seconds", "60", "--curve-points", "60"]
    words += ["--out", str(tmp_path), "--processes", "2", "--resume", "auto"]

    def begun(count):
        run = subprocess.Popen(
            [sys.executable, "-m", "npa_envs", *words],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8",
        )  # fmt: skip
        wait_until(lambda: len(points(tmp_path)) >= count, 60, run)
        return run

    run = begun(2)
    workers = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text(encoding="utf-8").split()
    os.kill(int(workers[1]), signal.SIGKILL)
    output, _ = run.communicate(timeout=60)
    assert run.returncode == 2
    assert "process 1 of 2 was ended by SIGKILL" in output
    done = load_checkpoint(tmp_path / "checkpoint.pt")["iteration"]
    run = begun(len(points(tmp_path)) + 1)
    run.terminate()
    output, _ = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "stopped; the same arguments with --resume continue" in output
    assert load_checkpoint(tmp_path / "checkpoint.pt")["iteration"] > done > 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--particle-steps", "nan"], "particle_steps must be finite"),
        (["--options", "tempo=3"], "has no option 'tempo'"),
        (["--keywords", "heart"], "keywords must be NAME=VALUE, got 'heart'"),
        (["--gpus=2", "--device=cpu"], "gpus goes with device 'cuda', got 'cpu'"),
        (["--episode-steps", "0"], "episode_steps must be"),
        (["--resume", "now"], "invalid choice: 'now'"),
        (["--resume", "auto", "--overwrite"], "resume and overwrite exclude each other"),
    ],
)
def test_mistakes_are_refused(words, message, tmp_path, capsys):
    assert main([*WORDS, "--particle-steps", "9", "--out", str(tmp_path), *words]) == 2
    assert message in capsys.readouterr().err
    assert main([*WORDS, "--out", str(tmp_path)]) == 2
    assert "learn needs a budget: give --particle-steps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("env", "steps"),
    [("MixingSmall", 32), ("MixingLarge", 256), ("Mixing", 256), ("Morphogenesis2DSmall", 32)],
)
def test_episodes_are_as_long_as_registered(env, steps):
    options = parse(["ppo", f"npa/{env}-v0"])
    assert problem_of(options, 1).episode_steps == steps
    assert problem_of(options, 1, 5).episode_steps == 5


def test_worlds_are_those_of_shac_when_given(tmp_path):
    words = ["learn", "shac", "npa/MixingSmall-v0", "--particle-steps", "1", "--episodes", "1"]
    words += ["--curve-points", "1", "--episode-steps", "2", "--no-progress", "--out"]
    for name, worlds, count in (("told", ["--num-envs", "3"], 3), ("default", [], 8)):
        assert main([*words, str(tmp_path / name), *worlds]) == 0
        assert points(tmp_path / name)[-1]["particle_steps"] == count * 2 * 64


def test_what_is_written_takes_no_time_and_what_is_over_has_finished(tmp_path, monkeypatch):
    clock, write = Clock(tick=1 / 64), Run.write_checkpoint
    monkeypatch.setattr("npa_envs.agents.learning.progress.time", clock)

    def slow(run, content):
        clock.sleep(1.0)
        write(run, content)

    monkeypatch.setattr(Run, "write_checkpoint", slow)
    words = [*WORDS, "--learning-seconds", "0.5", "--no-progress", "--out", str(tmp_path)]
    assert main(words) == 0
    seconds = [point["seconds"] for point in points(tmp_path)]
    assert 0.5 <= seconds[-1] < 1.0
    assert len(seconds) > 2
