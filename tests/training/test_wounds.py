"""The loss near a world's last wound: which pixels count, how much, and for how long."""

import pytest
import torch
from support.training_runs import make_cycle
from support.worlds import assert_same

from npa_envs.errors import NPAError
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import preset, train
from npa_envs.world.brushes import cut, wipe_state
from npa_envs.world.particles import Particles

AGED = {"max_age_range": (8, 64), "damage_share": 0.0, "wound_weight": 0.5}


def grown(task):
    """Two worlds that are the target, not in its place, as rules grow it."""
    points, colours = task.target.points, task.target.colours
    x = (points + torch.tensor([0.2, -0.1])).expand(2, -1, -1).clone()
    s = x.new_zeros(*x.shape[:2], task.config.state_dim)
    s[..., -3:] = colours - 0.5
    return Particles(x, s)


@pytest.fixture(scope="module")
def task():
    fields = {"target": "heart", "resolution": 64, "particle_count": 512}
    return Morphogenesis2D(preset("tiny", **fields, target_point_count=512).task)


def distances(task, centre):
    """How far the pixels of a picture lie from a point of the target, shape [R, R]."""
    at = torch.linspace(-1.0, 1.0, task.config.resolution)
    return ((at[None, :] - centre[0]).square() + (at[:, None] - centre[1]).square()).sqrt()


def test_wounds_are_the_pixels_of_the_centred_picture_that_a_damage_changes(task):
    before = grown(task)
    centre = before.x[:, 100]
    s = wipe_state(*before[:2], centre=centre, radius=0.2)
    s[1] = before.s[1]
    wounds = task.wounds_between(before, before._replace(s=s))
    assert wounds.shape == (2, 64, 64)
    assert wounds.dtype == torch.uint8
    away = distances(task, task.target.points[100])
    inside = (task.target_picture[..., 3] > 0.5) & (away < 0.15)
    assert int(inside.sum()) > 30
    assert bool(wounds[0][inside].all())
    assert not wounds[0][away > 0.2 + 0.5 * task.eps + 0.15].any()
    assert not wounds[1].any()
    # A world that is elsewhere as a whole has no place that hurts.
    assert not task.wounds_between(before, before._replace(x=before.x + 0.3)).any()
    normal = torch.tensor([[1.0, 0.0]]).expand(2, 2)
    slit = Particles(*cut(*before[:2], centre=before.x.mean(1), normal=normal, gap=0.1))
    assert 0.05 < float(task.wounds_between(before, slit).float().mean()) < 0.35


def test_the_loss_adds_the_mean_over_the_wound(task):
    worlds = grown(task)
    x = worlds.x.clone().requires_grad_()
    s = worlds.s + 0.1
    wounds = torch.zeros(2, 64, 64, dtype=torch.uint8)
    wounds[0, 20:40, 24:40] = 1
    plain, parts = task.compare(Particles(x, s))
    total, terms = task.with_wounds(wounds, 0.5).compare(Particles(x, s))
    density, colour = task.splat_errors(x, s)
    errors = density + task.config.colour_weight * colour
    expected = 0.5 * errors[0, 20:40, 24:40].mean()
    torch.testing.assert_close(terms["wound"], expected)
    torch.testing.assert_close(total, plain + task.config.splat_weight * 0.5 * expected)
    torch.testing.assert_close(terms["density"], parts["density"])
    (gradient,) = torch.autograd.grad(terms["wound"], x)
    assert bool((gradient[0] != 0.0).any())
    assert not gradient[1].any()


def test_the_pool_remembers_a_wound_until_the_world_is_replaced(tmp_path):
    fields = AGED | {"wound_chance": 0.3, "wound_min_age": 8, "damage_radius": 0.3}
    config = preset("tiny", out=tmp_path, **fields, steps=(4, 5), learning_rate=1e-9)
    cycle, _ = make_cycle(config, Morphogenesis2D(config.task))
    new = kept = 0
    for iteration in range(80):
        stored = cycle.pool.wounds.clone()
        cycle.run(iteration)
        index, age = cycle._index, cycle._age
        for old, now, start, years in zip(
            stored[index], cycle.pool.wounds[index], cycle.batch.start.s, age, strict=True
        ):
            hit = bool((start == 0.0).all(dim=-1).any()) and int(years) > 0
            if int(years) < 8:
                assert not now.any()
            elif not hit:
                assert torch.equal(now, old)
                kept += bool(old.any())
            else:
                new += not torch.equal(now, old)
        assert torch.equal(cycle.pool.wounds[index], cycle.batch.wounds)
    assert new > 5
    assert kept > 5


def test_a_resumed_run_remembers_wounds(tmp_path):
    wounded = AGED | {"damage_share": 0.5, "iterations": 12, "milestones": (3,)}
    fields = wounded | {"checkpoint_interval": 6}
    whole = train(preset("tiny", out=tmp_path / "whole", **fields), progress=False)
    parts = preset("tiny", out=tmp_path / "parts", **fields)
    train(parts, progress=False, max_seconds=0.0)
    resumed = train(parts, progress=False, resume=True)
    assert resumed.finished
    assert_same(resumed.rule.state_dict(), whole.rule.state_dict())


@pytest.mark.parametrize(
    ("name", "fields"),
    [("morphogenesis3d", {}), ("texture", {}), ("morphogenesis2d", {"equivariant": True})],
)
def test_worlds_without_an_upright_picture_have_no_wounds(tmp_path, name, fields):
    config = preset("tiny", name, out=tmp_path, **AGED, **fields)
    with pytest.raises(NPAError, match="wound_weight needs worlds that grow one upright picture"):
        train(config, name, progress=False)
