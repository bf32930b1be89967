"""The benchmark of PPO: what it counts, and when a GPU is at work."""

import json
import runpy
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "ppo.py"


def test_time_that_several_kernels_share_is_counted_once():
    covered = runpy.run_path(str(SCRIPT))["covered"]
    assert covered([]) == 0.0
    assert covered([(3.0, 4.0), (0.0, 1.0), (0.5, 2.0), (0.6, 0.7), (3.2, 3.5)]) == 3.0


def test_every_form_is_measured(tmp_path, monkeypatch, capsys, device):
    pytest.importorskip("stable_baselines3")
    path = tmp_path / "ppo.json"
    words = f"--worlds 3 --particles 32 --seconds 0.2 --rounds 2 --commit abc --device {device}"
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *words.split(), "--output", str(path)])
    threads = torch.get_num_threads()
    try:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    finally:
        torch.set_num_threads(threads)
    report = json.loads(path.read_text())
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in told[1:4]] == ["ppo", "ppo_rows", "ppo_world"]
    assert (report["worlds"], report["particles"], report["commit"]) == (3, 32, "abc")
    assert [row["form"] for row in report["rows"]] == ["ppo", "ppo_rows", "ppo_world"]
    for row in report["rows"]:
        # Whole rounds of 16 steps.
        assert row["particle_steps"] % (16 * 3 * 32) == 0
        assert row["particle_steps_per_second"] * row["seconds"] == pytest.approx(
            row["particle_steps"]
        )
    if device.type == "cuda":
        assert 0.0 < report["device_share"]["share_busy_profiled"] <= 1.0
    else:
        assert report["device_share"] is None
