"""Training in worlds of several radii: how large their seeds are, and resumed runs."""

import json

import pytest
import torch

import npa_envs
from npa_envs.cli import main
from npa_envs.errors import NPAError
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.tasks.texture import Texture
from npa_envs.training import Trainer, preset


def trainer_of(folder, **fields):
    options = {"target": "ring", "iterations": 12, "milestones": (8,), "picture_interval": 0}
    options |= {"vary_eps": (0.5, 2.0)} | fields
    resume = options.pop("resume", False)
    config = preset("tiny", out=folder, particle_count=32, target_point_count=32, **options)
    task = Morphogenesis2D(config.task)
    return Trainer(task, config, task_name="morphogenesis2d", resume=resume)


def test_eps_of_one_factor_is_as_one_of_nearly_one(tmp_path):
    radii = []
    for lo in (1.999, 2.0):
        cycle = trainer_of(tmp_path / str(lo), vary_eps=(lo, 2.0))._cycle
        radii.append(cycle._seeds(4, cycle.random.worlds).x.norm(dim=-1).amax().item())
    assert radii[0] == pytest.approx(radii[1], rel=2e-3)


def test_seeds_are_as_large_as_eps_makes_them(tmp_path):
    plain, varied = (
        trainer_of(tmp_path / name, **fields, pool_size=64)
        for name, fields in (("plain", {"vary_eps": (1.0, 1.0)}), ("varied", {}))
    )
    radius = plain.config.task.seed_radius
    largest = [t.pool.worlds.x.norm(dim=-1).amax(dim=1) / radius for t in (plain, varied)]
    assert float(largest[0].max()) <= 1.0
    assert float(largest[0].min()) > 0.8
    assert 0.4 < float(largest[1].min()) < 0.7
    assert 1.5 < float(largest[1].max()) <= 2.0


def test_a_resumed_run_is_the_same_run(tmp_path):
    straight = trainer_of(tmp_path / "straight")
    straight.run(progress=False)
    stopped = trainer_of(tmp_path / "stopped")
    for _ in range(7):
        stopped.iterate()
    stopped.save()
    resumed = trainer_of(tmp_path / "stopped", resume=True)
    assert resumed.iteration == 7
    resumed.run(progress=False)
    for ours, theirs in zip(resumed.rule.parameters(), straight.rule.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_eps_is_not_varied_in_a_box(tmp_path):
    config = preset("tiny", "texture", out=tmp_path, vary_eps=(0.5, 2.0))
    with pytest.raises(NPAError, match="vary_eps needs particles that move in open space"):
        Trainer(Texture(config.task), config, task_name="texture")


def test_eps_is_not_varied_where_a_world_starts_with_one_particle(tmp_path):
    with pytest.raises(NPAError, match="vary_eps needs seeds of more than one particle"):
        trainer_of(tmp_path, division=True)


def test_eps_is_not_varied_where_several_rules_learn(tmp_path):
    config = preset("tiny", "co_morphogenesis2d", out=tmp_path, vary_eps=(0.5, 2.0))
    with pytest.raises(NPAError, match="vary_eps is for runs of one rule"):
        npa_envs.training.train(config, "co_morphogenesis2d", progress=False)


def test_the_command_line_takes_a_range_and_robustness_takes_the_run(tmp_path, capsys):
    out = str(tmp_path / "run")
    words = ["train", "morphogenesis2d", "--preset", "tiny", "--iterations", "2", "--no-report"]
    words += ["--milestones", "1", "--vary-eps", "0.5", "2"]
    assert main([*words, "--no-progress", "--out", out]) == 0
    capsys.readouterr()
    assert main(["robustness", out, "--quick", "--no-progress", "--out", str(tmp_path / "r")]) == 0
    assert "| run |" in capsys.readouterr().out
    assert json.loads((tmp_path / "r" / "robustness_run.json").read_text(encoding="utf-8"))["done"]
    npa_envs.save_rule(npa_envs.NPARule(), tmp_path / "own.safetensors")
    assert main(["robustness", str(tmp_path / "own.safetensors"), "--quick"]) == 2
    assert "must say on which task it was trained" in capsys.readouterr().err
