"""The comparison of training apart and together: its runs, and what it measures of them."""

import json
import runpy
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

from npa_envs import WorldRandom, load_rule, rollout
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2D
from npa_envs.training import RunFolder, preset
from npa_envs.training.checkpoint import load_checkpoint

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "joint_training.py"


@pytest.fixture
def compare(tmp_path, monkeypatch):
    """Run the script with tiny worlds and further words."""

    def run(*words):
        usual = "--preset tiny --iterations 4 --particle-count 48 --worlds 2 --steps 4 2 --frozen"
        places = {"runs": tmp_path, "output": tmp_path / "r.json", "picture": tmp_path / "p.png"}
        told = [word for name, place in places.items() for word in (f"--{name}", str(place))]
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *usual.split(), *told, *words])
        threads = torch.get_num_threads()
        try:
            runpy.run_path(str(SCRIPT), run_name="__main__")
        finally:
            torch.set_num_threads(threads)

    return run


def test_every_way_to_live_is_measured_from_runs_that_may_be_made_apart(tmp_path, compare, capsys):
    compare("--only", "together")
    assert not (tmp_path / "r.json").exists()
    made = RunFolder(tmp_path / "together").rule_of(1)
    before = made.stat().st_mtime_ns
    with pytest.raises(SystemExit, match="frozen-0 needs the rule of separate-0"):
        compare("--only", "frozen-0")
    with pytest.raises(SystemExit, match="separate-0 stopped at iteration 0"):
        compare("--only", "separate-0", "--max-seconds", "1e-9")
    compare("--commit", "abc")
    assert made.stat().st_mtime_ns == before

    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["commit"], report["iterations"]) == ("abc", 4)
    assert report["particle_counts"] == [48, 48]
    configs = {}
    for name in ("separate-0", "separate-1", "together", "frozen-0", "frozen-1"):
        content = load_checkpoint(tmp_path / name / "checkpoint.pt")
        assert content["iteration"] == 4
        assert report["training_seconds"][name] == content["seconds"]
        configs[name] = content["config"]
    own = configs["together"]["task"]["species"]
    assert [configs[f"separate-{k}"]["task"] for k in (0, 1)] == own
    for name in ("learning_rate", "milestones", "steps", "seed", "world_count", "pool_size"):
        assert len({str(config[name]) for config in configs.values()}) == 1

    rows = {(row["rules"], row["species"]): row for row in report["rows"]}
    shared = ("separate, shared world", "together, shared world", "frozen-0", "frozen-1")
    assert list(rows) == [(name, k) for name in ("separate, alone", *shared) for k in (0, 1)]
    with Image.open(tmp_path / "p.png") as strip:
        assert strip.width > 3 * 192
        assert strip.height > 4 * 192
    assert "separate, shared world  heart" in capsys.readouterr().out

    # The second species alone, from its seed in the shared world, beside nobody.
    config = preset("tiny", "co_morphogenesis2d", species=own).task
    task = CoMorphogenesis2D(config)
    random = WorldRandom(range(1_000_000, 1_000_002))
    x, s = task.seed(2, generator=random)
    rule = load_rule(tmp_path / "separate-1" / "rule.safetensors")
    with torch.no_grad():
        grown = rollout(rule, x[:, 48:], s[:, 48:], 4, generator=random, update_prob=0.5)
    expected = task.tasks[1].metric(*grown)
    found = rows["separate, alone", 1]
    assert found["loss_of_worlds"]["4"] == pytest.approx(expected.tolist(), rel=1e-4)
    assert found["loss"]["4"] == pytest.approx(expected.mean().item(), rel=1e-4)
    # Whoever is frozen is who was trained alone, and the other one is not.
    for stays in (0, 1):
        for k in (0, 1):
            learned = load_rule(RunFolder(tmp_path / f"frozen-{stays}").rule_of(k))
            alone = load_rule(tmp_path / f"separate-{k}" / "rule.safetensors")
            assert torch.equal(learned.output.weight, alone.output.weight) == (k == stays)


def test_runs_of_other_settings_are_refused(compare):
    compare("--only", "separate-1")
    with pytest.raises(Exception, match=r"of another configuration \(seed: 0 there, 1 here\)"):
        compare("--only", "separate-1", "--seed", "1")
