"""2D morphogenesis of particles that divide: seeds, pictures of the living, damage, rules, runs."""

import pytest
import torch

from npa_envs.rule.rule import FIRST_FATES, LIFE
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.training import Trainer, optimiser, preset
from npa_envs.training.iteration import EagerIteration
from npa_envs.world.division import living
from npa_envs.world.particles import Particles
from npa_envs.world.rollout import rollout_particles

SMALL = {"target": "ring", "target_point_count": 64, "particle_count": 64, "resolution": 32}


def make_task(**fields):
    return Morphogenesis2D(Morphogenesis2DConfig(**SMALL, **{"division": True, **fields}))


def half_alive(task, seed=0):
    """Return two worlds of 64 particles, of which the first 32 live; the dead are in the middle."""
    x = task.places(2, torch.Generator().manual_seed(seed), torch.device("cpu"))
    s = torch.rand(2, 64, task.config.state_dim, generator=torch.Generator().manual_seed(1)) - 0.5
    s[:, :32, LIFE], s[:, 32:] = 1.0, 0.0
    x[:, 32:] = x[:, :32].mean(dim=1, keepdim=True)
    return x, s


def test_seeds_are_one_living_particle():
    x, s, *_ = make_task().seed(3, generator=torch.Generator().manual_seed(0))
    assert x.shape == (3, 64, 2)
    assert living(s).sum(dim=1).tolist() == [1, 1, 1]
    assert s.sum() == 3.0


def test_pictures_and_losses_are_those_of_the_living():
    task = make_task()
    few = Morphogenesis2DConfig(**SMALL | {"particle_count": 32})
    alone = Morphogenesis2D(few, target=task.target)
    x, s = half_alive(task)
    wanted = alone.picture(x[:, :32], s[:, :32])
    assert (task.picture(x, s) - wanted).abs().max() < 1e-5
    metric = alone.metric(x[:, :32], s[:, :32])
    assert (task.metric(x, s) - metric).abs().max() < 1e-5


def test_pictures_change_with_life_as_if_particles_were_taken_away():
    task = make_task()
    x, s = half_alive(task)
    s.requires_grad_()
    picture = task.picture(x, s, centred=False)
    weights = torch.randn(picture.shape, generator=torch.Generator().manual_seed(2))
    (gradient,) = torch.autograd.grad((weights * picture).sum(), s)
    without = s.detach().clone()
    without[0, 5] = 0.0
    change = (weights * (picture - task.picture(x, without, centred=False))).sum().item()
    # Pictures are linear in life.
    assert abs(gradient[0, 5, LIFE].item() - change) < 1e-4


def test_damage_takes_about_half_of_the_particles_and_never_the_last():
    x, s = (value.repeat(50, 1, 1) for value in half_alive(make_task()))

    def damaged(s, radius=0.1):
        task = make_task(damage_radius=radius)
        return task.damage(Particles(x, s), torch.Generator().manual_seed(0)).s

    after = damaged(s)
    gone = living(s) & ~living(after)
    # Of 3200, with a standard deviation of 28; wherever they are.
    assert abs(int(gone.sum()) - 1600) < 120
    assert 20 < int(gone[:, :32].sum(dim=0).min()) < int(gone[:, :32].sum(dim=0).max()) < 80
    assert torch.equal(after[~gone], s[~gone])
    assert not after[gone].any()
    assert torch.equal(damaged(s, radius=0.0), s)
    s[:, 1:] = 0.0
    assert torch.equal(damaged(s), s)


def test_births_are_no_unrest(tmp_path):
    config = preset(
        "tiny", "morphogenesis2d", division=True, particle_count=64, target_point_count=64,
        world_count=1, max_age_range=(12, 48), stillness_weight=1.0, out=tmp_path,
    )  # fmt: skip
    task = Morphogenesis2D(config.task)
    rule = task.make_rule(torch.Generator().manual_seed(0))
    torch.nn.init.zeros_(rule.output.weight)
    x, s, *_ = task.seed(1, generator=torch.Generator().manual_seed(0))
    s[:, 0, LIFE + 1 :] = 0.5
    batch = EagerIteration(
        task, rule, config, Particles(x, s), torch.Generator().manual_seed(0), rollout_particles
    )
    batch.past_min_age.fill_(True)
    batch.run(12)
    assert int(living(batch.end.s).sum()) > 8
    stillness = dict(zip(batch.term_names, batch.terms.tolist(), strict=True))["stillness"]
    # Nobody moves, and children are born without states.
    assert (batch.end.s[0, 0, LIFE + 1 :] == 0.5).all()
    assert not batch.end.s[0, 1:, LIFE + 1 :].any()
    assert stillness < 1e-6


def test_fates_learn_at_their_share_of_the_learning_rate(tmp_path, monkeypatch):
    options = {
        "particle_count": 32, "target_point_count": 32, "steps": (12, 13), "pool_size": 4,
        "learning_rate": 1e-3, "picture_interval": 0,
    }  # fmt: skip
    changes = []
    for rate in (1.0, 0.01):
        monkeypatch.setattr(optimiser, "FATE_RATE", rate)
        folder = tmp_path / str(rate)
        config = preset("tiny", "morphogenesis2d", division=True, out=folder, **options)
        trainer = Trainer(Morphogenesis2D(config.task), config, task_name="morphogenesis2d")
        trainer.iterate()
        changes.append((trainer.rule.fate.bias - torch.tensor(FIRST_FATES)).abs().max().item())
    # AdamW's first step is the learning rate.
    assert changes[0] == pytest.approx(1e-3, rel=0.01)
    assert changes[1] == pytest.approx(1e-5, rel=0.05)
