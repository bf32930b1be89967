"""One rule of many pictures: targets, goals, what is compared, training, files, the command."""

import json
import re

import pytest
import torch
from PIL import Image
from support.training_runs import make_cycle
from support.worlds import seeded

import npa_envs
from npa_envs.cli import final_report, main
from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule
from npa_envs.rule.picture_codes import Codes
from npa_envs.tasks.many_pictures import ManyPictures, named_targets
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.training import preset, train
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.particles import Particles

SMALL = {
    "particle_count": 48, "target_point_count": 48, "state_dim": 5, "hidden_dim": 8,
    "resolution": 16, "eps": 0.4, "code_dim": 3,
}  # fmt: skip
TARGETS = ("heart", "ring", "letter-a")


def config_of(**fields):
    return Morphogenesis2DConfig(**{"targets": TARGETS, **SMALL, **fields})


def task_of(device="cpu", **fields):
    return ManyPictures(config_of(**fields), device=device)


def test_a_folder_stands_for_its_pictures(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for name in ("b.png", "a.webp"):
        Image.new("RGBA", (8, 8), "red").save(folder / name)
    (folder / "notes.txt").write_text("no picture", encoding="utf-8")
    named = named_targets(("heart", str(folder)))
    assert list(named) == ["heart", "a", "b"]
    assert named["b"] == str(folder / "b.png")
    with pytest.raises(NPAError, match=r"different names, got 'a' twice"):
        named_targets((str(folder), str(folder / "a.webp")))
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(NPAError, match="a folder of targets must hold pictures"):
        named_targets((str(empty),))


def test_each_world_is_compared_with_its_own_target(device):
    task = task_of(device)
    alone = [config_of(target=name, targets=()) for name in TARGETS]
    singles = [Morphogenesis2D(config, device=device) for config in alone]
    goal = torch.tensor([2, 0, 1], device=device)
    aimed = task.with_goal(goal)
    worlds = [singles[k].target for k in goal.tolist()]
    for number, target in enumerate(worlds):
        x = target.points[None].expand(3, -1, -1)
        s = torch.zeros(3, len(target.points), 8, device=device)
        s[..., -3:] = target.colours - 0.5
        losses = aimed.metric(x, s)
        assert int(losses.argmin()) == number
        assert float(losses[number]) < 0.2 * float(losses.sum()) / 3
        # The target itself has the density that it has alone, whatever its size.
        together, alone = aimed.target_picture[number], singles[int(goal[number])].target_picture
        assert float(together[..., 3].sum()) == pytest.approx(float(alone[..., 3].sum()), rel=0.1)


def test_gradients_of_the_loss_reach_the_worlds_codes_alone(device):
    task = task_of(device)
    rule = task.make_rule(seeded()).to(device)
    task = task.for_rule(rule)
    x, s, *_, goal = task.seed(2, generator=seeded(1, device), device=device)
    goal.fill_(1)
    aimed = task.with_goal(goal)
    s = aimed.with_target_code(s)
    assert torch.equal(s[..., :3], rule.codes.table[1].expand(2, 48, 3))
    x, s, path = npa_envs.rollout(rule, x, s, 3, eps=task.eps, return_path_length=True)
    total, parts = aimed.loss(Particles(x, s, path))
    (gradient,) = torch.autograd.grad(total, rule.codes.table)
    assert float(gradient[1].abs().min()) > 0.0
    assert float(gradient[[0, 2]].abs().max()) == 0.0
    assert {"density", "colour", "overflow"} <= parts.keys()


def test_switched_worlds_get_another_goal_and_its_code(device):
    task = task_of(device, switch_share=1.0, targets=("heart", "ring"))
    task = task.for_rule(task.make_rule(seeded()).to(device))
    x, s, *_, goal = task.seed(16, generator=seeded(1, device), device=device)
    _, hurt, _, switched = task.damage(Particles(x, s, goal=goal), seeded(2, device))
    assert 0 < int((switched != goal).sum()) < 16
    after = task.with_goal(switched).with_target_code(hurt)
    codes = after[..., :3].unique(dim=1)[:, 0]
    assert len(codes.unique(dim=0)) == 2
    steady = task_of(device, switch_share=0.0)
    assert torch.equal(steady.damage(Particles(x, s, goal=goal), seeded(2, device)).goal, goal)


@pytest.mark.parametrize("encoder", [False, True])
def test_training_changes_codes_and_keeps_them_with_their_worlds(encoder, monkeypatch):
    encode, calls = Codes.encode, []
    monkeypatch.setattr(Codes, "encode", lambda *args: calls.append(1) or encode(*args))
    task = task_of(encoder=encoder)
    fields = {"targets": TARGETS, "encoder": encoder, "steps": (2, 4), "pool_size": 6, "seed": 3}
    config = preset("tiny", **SMALL, **fields)
    cycle, rule = make_cycle(config, task)
    before = rule.codes.table.detach().clone()
    if encoder:
        # Fresh worlds carry what the encoder says, also of a rule that nobody has trained.
        assert torch.equal(before, encode(rule.codes, task._target_pictures))
    calls.clear()
    for iteration in range(3):
        cycle.run(iteration)
    # An encoder reads the pictures once in an iteration.
    assert len(calls) == 3 * encoder
    moved = (rule.codes.table.detach() - before).abs().sum(dim=1)
    assert int((moved > 0.0).sum()) >= (3 if encoder else 1)
    goal, x0, s0 = cycle.batch.start.goal, cycle.batch.start.s, cycle.batch.end.s
    assert torch.equal(x0[..., :3], s0[..., :3])
    assert x0[..., :3].unique(dim=1).shape[1] == 1
    assert goal.shape == (2,)


def test_a_rule_that_is_kept_has_the_codes_of_its_own_encoder(tmp_path):
    config = preset("tiny", **SMALL, targets=TARGETS, encoder=True, out=tmp_path, iterations=3)
    codes = train(config, progress=False).rule.codes
    pictures = ManyPictures(config.task)._target_pictures
    assert torch.allclose(codes.table, codes.encode(pictures), atol=1e-6)
    assert torch.equal(load_rule(tmp_path / "rule.safetensors").codes.table, codes.table)


def test_the_command_trains_and_evaluates_by_name(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(final_report, "CHECKPOINTS", (8, 128))
    monkeypatch.setattr(final_report, "FILM_STEPS", 6)
    out = str(tmp_path / "many")
    small = [f"--{name.replace('_', '-')}={value}" for name, value in SMALL.items()]
    words = ["--preset=tiny", *small, "--iterations=2", "--no-progress"]
    assert main(["train", "morphogenesis2d", "--targets", *TARGETS, f"--out={out}", *words]) == 0
    assert "learns heart and ring and letter-a" in capsys.readouterr().out
    card = (tmp_path / "many" / "report" / "rule.md").read_text(encoding="utf-8")
    assert "for `heart`, one of 3 pictures" in card
    assert len(re.findall(r"\| letter-a \|", card)) == 3
    rule = npa_envs.load_rule(f"{out}/rule.safetensors")
    assert rule.codes.names == TARGETS
    assert rule.state_dim == 8
    task = task_of_rule(f"{out}/rule.safetensors", rule, torch.device("cpu"), target="ring").task
    assert task.target.name == "ring"
    _, s, *_ = task.seed(1, generator=seeded())
    assert torch.equal(s[0, :, :3], rule.codes["ring"].expand(48, 3))
    first = task_of_rule(f"{out}/rule.safetensors", rule, torch.device("cpu")).task
    assert first.target.name == "heart"
    options = ["--no-progress", "--seed-count=1", "--checkpoints", "4"]
    assert main(["evaluate", out, "--target=letter-a", *options, "--json", f"{out}/one.json"]) == 0
    one = json.loads((tmp_path / "many" / "one.json").read_text(encoding="utf-8"))
    assert one["growth"][0]["step"] == 4
    assert main(["evaluate", out, *options, "--json", f"{out}/all.json"]) == 0
    rows = json.loads((tmp_path / "many" / "all.json").read_text(encoding="utf-8"))["pictures"]
    assert [row["target"] for row in rows] == [*TARGETS, "(median)"]
    assert rows[3]["loss"] == sorted(row["loss"] for row in rows[:3])[1]
    assert one["growth"][0]["loss"] == pytest.approx(rows[2]["loss"], rel=0.1)
    assert "3 pictures, 1 worlds each" in capsys.readouterr().out
    assert main(["evaluate", out, "--healing", *options]) == 2
    assert "measured of one picture at a time" in capsys.readouterr().err
    assert main(["evaluate", out, "--target=gecko", *options]) == 2
    assert "unknown code 'gecko'" in capsys.readouterr().err
