"""Training in worlds of several kinds: which ones there are, what they share, and resumed runs."""

import itertools
import json
import math

import pytest
import torch

import npa_envs
from npa_envs.cli import main
from npa_envs.errors import NPAError
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import Trainer, preset
from npa_envs.training.run_folder import RunFolder
from npa_envs.training.variation import VariedCycle, variants_of

VARIED = {
    "vary_particles": (0.25, 4.0),
    "vary_eps": (0.5, 2.0),
    "vary_update_prob": (0.5, 2.0),
    "vary_dt": (0.5, 1.5),
    "variants": 5,
}


def trainer_of(folder, **fields):
    options = {"target": "ring", "iterations": 12, "milestones": (8,), "picture_interval": 0}
    options |= VARIED | fields
    resume = options.pop("resume", False)
    config = preset("tiny", out=folder, particle_count=32, target_point_count=32, **options)
    task = Morphogenesis2D(config.task)
    return Trainer(task, config, task_name="morphogenesis2d", resume=resume)


def test_kinds_are_spread_over_the_ranges():
    kinds = variants_of(preset("tiny", **VARIED))
    for name, (lo, hi) in (("particles", (0.25, 4)), ("update_prob", (0.5, 2)), ("dt", (0.5, 1.5))):
        factors = sorted(getattr(kind, name) for kind in kinds)
        steps = [math.log(b / a) for a, b in itertools.pairwise(factors)]
        assert (factors[0], factors[-1]) == pytest.approx((lo, hi))
        assert steps == pytest.approx([math.log(hi / lo) / 4] * 4)
    # No two of them grow together.
    orders = [
        [getattr(kind, name) for kind in kinds] for name in ("particles", "update_prob", "dt")
    ]
    ranks = {tuple(sorted(range(5), key=values.__getitem__)) for values in orders}
    assert len(ranks) == 3


@pytest.mark.parametrize("count", range(1, 10))
def test_each_factor_takes_every_place_of_its_range(count):
    kinds = variants_of(preset("tiny", **VARIED | {"variants": count}))
    for name, (lo, hi) in (("particles", (0.25, 4)), ("update_prob", (0.5, 2)), ("dt", (0.5, 1.5))):
        factors = sorted(getattr(kind, name) for kind in kinds)
        shares = [k / (count - 1) for k in range(count)] if count > 1 else [0.5]
        assert factors == pytest.approx([lo * (hi / lo) ** share for share in shares])


def test_eps_of_one_factor_is_as_one_of_nearly_one(tmp_path):
    radii = []
    for lo in (1.999, 2.0):
        trainer = trainer_of(tmp_path / str(lo), vary_eps=(lo, 2.0))
        (kind, *_) = trainer._cycle._others
        radii.append(kind._seeds(4, kind.random.worlds)[0].norm(dim=-1).amax().item())
    assert radii[0] == pytest.approx(radii[1], rel=2e-3)


def test_there_must_be_room_for_the_pools_of_all_kinds(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(RunFolder, "prepare", lambda self, size: asked.append(size))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "pictures").mkdir()
    trainer = trainer_of(tmp_path / "run", pool_size=64)
    pools = [trainer.pool, *(other.pool for other in trainer._cycle._others)]
    assert asked[0] >= sum(pool.x.nbytes + pool.s.nbytes for pool in pools)


def test_a_batch_of_a_kind_is_a_batch_of_its_worlds(tmp_path, monkeypatch):
    calls = []
    whole = npa_envs.rollout

    def noted(rule, x, s, steps, **options):
        calls.append((x.shape[1], options["update_prob"], options.get("dt", 1.0), steps))
        return whole(rule, x, s, steps, **options)

    monkeypatch.setattr("npa_envs.world.rollout.rollout", noted)
    trainer = trainer_of(tmp_path)
    for _ in range(40):
        trainer.iterate()
    kinds = {call[:3] for call in calls}
    expected = {
        (round(32 * kind.particles), 0.5 * kind.update_prob, kind.dt)
        for kind in variants_of(trainer.config)
    }
    assert kinds == expected | {(32, 0.5, 1.0)}
    assert 10 <= sum(call[:3] == (32, 0.5, 1.0) for call in calls) <= 30
    for count, prob, dt, steps in calls:
        if (count, prob, dt) != (32, 0.5, 1.0):
            # As many updates, and as much time, as in the middle of the range of 8 to 16.
            assert abs(steps * (prob / 0.5) * dt - 12.0) <= 0.5 * (prob / 0.5) * dt + 1e-9


def test_seeds_of_the_kinds_are_as_large_as_eps_makes_them(tmp_path):
    trainer = trainer_of(tmp_path, vary_particles=(1.0, 1.0), variants=1)
    radius = trainer.config.task.seed_radius
    assert isinstance(trainer._cycle, VariedCycle)
    (other,) = trainer._cycle._others
    largest = [pool.x.norm(dim=-1).amax(dim=1) / radius for pool in (trainer.pool, other.pool)]
    assert float(largest[0].max()) <= 1.0
    assert float(largest[0].min()) > 0.8
    assert 0.4 < float(largest[1].min()) < 0.8
    assert 1.2 < float(largest[1].max()) <= 2.0


def test_all_kinds_train_one_rule_and_a_resumed_run_is_the_same_run(tmp_path):
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
    record = json.loads((tmp_path / "straight" / "log.jsonl").read_text().splitlines()[-1])
    assert record["iteration"] == 12
    assert math.isfinite(record["loss"])


def test_a_kind_whose_loss_breaks_is_told(tmp_path):
    trainer = trainer_of(tmp_path)
    for other in trainer._cycle._others:
        other.pool.s.fill_(math.nan)
    with pytest.raises(npa_envs.DivergedError, match="loss"):
        trainer.run(progress=False)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"vary_particles": (2.0, 1.0)}, r"vary_particles must be two factors .*lo <= hi"),
        ({"vary_eps": (0.0, 1.0)}, r"vary_eps must be two factors"),
        ({"vary_dt": (1.0, math.inf)}, r"vary_dt must be two factors"),
        ({"variants": 0}, "variants must be a whole number of at least 1"),
        ({"vary_update_prob": (1.0, 3.0)}, r"leave probabilities in \(0, 1\], got 1.5"),
    ],
)
def test_ranges_that_cannot_be_are_refused(tmp_path, fields, message):
    with pytest.raises(NPAError, match=message):
        trainer_of(tmp_path, **fields)


def test_eps_is_not_varied_in_a_box(tmp_path):
    config = preset("tiny", "texture", out=tmp_path, vary_eps=(0.5, 2.0))
    from npa_envs.tasks.texture import Texture

    with pytest.raises(NPAError, match="vary_eps needs particles that move in open space"):
        Trainer(Texture(config.task), config, task_name="texture")


def test_eps_is_not_varied_where_a_world_starts_with_one_particle(tmp_path):
    with pytest.raises(NPAError, match="vary_eps needs seeds of more than one particle"):
        trainer_of(tmp_path, vary_eps=(0.5, 2.0), division=True)


def test_the_command_line_takes_ranges_and_robustness_takes_the_run(tmp_path, capsys):
    out = str(tmp_path / "run")
    words = ["train", "morphogenesis2d", "--preset", "tiny", "--iterations", "2", "--no-report"]
    words += ["--milestones", "1", "--vary-particles", "0.5", "2", "--vary-eps", "0.5", "2"]
    assert main([*words, "--variants", "2", "--no-progress", "--out", out]) == 0
    capsys.readouterr()
    assert main(["robustness", out, "--quick", "--no-progress", "--out", str(tmp_path / "r")]) == 0
    assert "| run |" in capsys.readouterr().out
    assert json.loads((tmp_path / "r" / "robustness_run.json").read_text())["done"]
    npa_envs.save_rule(npa_envs.NPARule(), tmp_path / "own.safetensors")
    assert main(["robustness", str(tmp_path / "own.safetensors"), "--quick"]) == 2
    assert "must say on which task it was trained" in capsys.readouterr().err
