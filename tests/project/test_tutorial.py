"""The programs of the tutorials: they run as they stand there, and learn what the pages say."""

import math
import re
import time
from pathlib import Path

import pytest
from PIL import Image

TUTORIAL = Path(__file__).resolve().parents[2] / "docs" / "tutorial.md"
ROUNDS = "model.learn(100 * 16"

pytest.importorskip("stable_baselines3")


def program(page: Path = TUTORIAL) -> str:
    """Return the page's last block of Python."""
    text = page.read_text(encoding="utf-8")
    *_, block = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return block


def run(code: str) -> None:
    exec(compile(code, TUTORIAL.name, "exec"), {})


def printed(text: str) -> dict[str, tuple[float, float]]:
    """Return mean returns and their standard errors, by policy, of what the program prints."""
    rows = re.findall(r"^(\w+): (-?[\d.]+) ± ([\d.]+)$", text, re.MULTILINE)
    return {name: (float(mean), float(error)) for name, mean, error in rows}


def told() -> dict[str, float]:
    """Return the mean returns that the page says the program prints, by policy."""
    return {name: mean for name, (mean, _) in printed(TUTORIAL.read_text(encoding="utf-8")).items()}


def test_the_program_runs_and_gives_the_returns_that_need_no_training(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    code = program()
    assert code.count(ROUNDS) == 1
    assert len([line for line in code.splitlines() if line.strip()]) <= 30
    run(code.replace(ROUNDS, "model.learn(16"))
    returns = printed(capsys.readouterr().out)
    assert returns.keys() == told().keys()
    for name in ("RandomPolicy", "ZeroPolicy", "RulePolicy"):
        assert returns[name][0] == pytest.approx(told()[name], abs=0.02)
    with Image.open(tmp_path / "ppo.png") as picture:
        assert picture.width >= 5 * 256


@pytest.mark.slow
def test_ppo_beats_random_actions_by_three_standard_errors_in_five_minutes(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    start = time.process_time()
    run(program())
    assert time.process_time() - start < 300.0
    returns = printed(capsys.readouterr().out)
    (mean, error), (random_mean, random_error) = returns["RowPolicy"], returns["RandomPolicy"]
    assert mean - random_mean > 3.0 * math.hypot(error, random_error)
    # Not by doing nothing, either.
    assert mean > 3.0 * error
    assert mean == pytest.approx(told()["RowPolicy"], abs=0.2)


def test_the_program_for_a_graphics_card_runs_on_any_device(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = program(TUTORIAL.with_name("gpu.md"))
    for usual, small in {
        "particle_count=512": "particle_count=16",
        "episode_steps=48": "episode_steps=2",
        "num_envs=32": "num_envs=2",
        "30_000_000": "500",
        "10_000_000": "500",
    }.items():
        assert code.count(usual) == 1
        code = code.replace(usual, small)
    run(code)
    told = re.findall(r"^([\w, ']+): -?[\d.]+", capsys.readouterr().out, re.MULTILINE)
    assert told == ["zero", "ppo", "gradient", "ppo, begun with the gradient's rule"]
    for method in ("ppo", "gradient"):
        assert (tmp_path / "runs" / method / "rule-0.safetensors").is_file()
