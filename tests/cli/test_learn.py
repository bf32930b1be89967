"""`npa-envs learn`: a run that is kept, and goes on; by one process and by two."""

import json

import pytest

from npa_envs.cli import main

WORDS = [
    "learn",
    "ppo",
    "npa/Morphogenesis2DSmall-v0",
    "--keywords",
    "target=ring",
    "--worlds",
    "2",
]
WORDS += ["--episode-steps", "4", "--episodes", "2", "--entries", "2", "--options", "steps=4"]
ROUND = 4 * 2 * 64


def learned(out, rounds, *words):
    """The exit code, and the particle-steps of the curve's points."""
    budget = ["--particle-steps", str(rounds * ROUND), "--out", str(out)]
    code = main([*WORDS, *budget, *words])
    lines = (out / "log.jsonl").read_text().splitlines()
    return code, [json.loads(line)["particle_steps"] // ROUND for line in lines]


def test_a_run_begins_and_goes_on_with_the_same_words(tmp_path, capsys):
    assert learned(tmp_path, 2, "--resume", "auto") == (0, [0, 1, 2])
    assert learned(tmp_path, 4, "--resume", "auto") == (0, [0, 1, 2, 4])
    told = capsys.readouterr().out
    assert told.count("return") == 4
    assert f"finished: rules, curve and checkpoint are in {tmp_path}/" in told


@pytest.mark.slow
def test_two_processes_share_a_run(tmp_path, capfd):
    assert learned(tmp_path, 2, "--processes", "2") == (0, [0, 1, 2])
    assert capfd.readouterr().out.count("return") == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--options", "tempo=3"], "has no option 'tempo'"),
        (["--keywords", "heart"], "keywords must be NAME=VALUE, got 'heart'"),
        (["--gpus", "2", "--processes", "2"], "gpus stands for --device cuda and --processes"),
        (["--resume", "now"], "invalid choice: 'now'"),
    ],
)
def test_mistakes_are_told(words, message, tmp_path, capsys):
    assert main([*WORDS, "--particle-steps", "9", "--out", str(tmp_path), *words]) == 2
    assert message in capsys.readouterr().err


def test_a_run_needs_a_budget(tmp_path, capsys):
    assert main([*WORDS, "--out", str(tmp_path)]) == 2
    assert "learn needs a budget: give --particle-steps" in capsys.readouterr().err
