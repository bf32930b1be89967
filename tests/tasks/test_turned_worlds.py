"""The loss of 2D morphogenesis that is blind to turns: the best angle counts."""

import math

import pytest
import torch

import npa_envs
from npa_envs.cli import main
from npa_envs.errors import NPAError
from npa_envs.rule.files import save_rule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig, turned, turns
from npa_envs.training import preset
from npa_envs.training.trainer import initial_rule
from npa_envs.world.particles import Particles

SMALL = {"target": "octopus", "target_point_count": 300, "particle_count": 300, "resolution": 48}
ANGLES = (0.0, 0.5 * math.pi, 1.234, 3.0)


def task_of(**fields):
    return Morphogenesis2D(Morphogenesis2DConfig(**{"equivariant": True, **SMALL, **fields}))


def grown(task, angle=None, hand=1.0):
    """Return one world that is the target, moved aside, and turned."""
    x = task.target.points[None].double() + 0.1
    s = torch.zeros(1, x.shape[1], 16, dtype=x.dtype)
    s[..., -3:] = task.target.colours - 0.5
    return x if angle is None else turned(x, turn_of(angle, hand)), s


def turn_of(angle, hand=1.0):
    return turns(torch.tensor([angle]).double(), torch.tensor([hand]).double())


def test_a_turned_target_is_recognised_and_a_plain_loss_sees_another():
    task, plain = task_of(), task_of(equivariant=False)
    for angle in ANGLES:
        x, s = grown(task, angle)
        turn = task.best_turn(x, s)
        assert turn.det().item() == pytest.approx(1.0)
        back = torch.atan2(turn[0, 1, 0], turn[0, 0, 0]).item()
        assert abs(math.remainder(back + angle, 2.0 * math.pi)) < math.radians(0.4)
        assert task.metric(x, s).item() < 0.06
        if angle > 0.0:
            assert plain.metric(x, s).item() > 0.3
    # Worst value measured: 4.1e-7.
    assert plain.metric(*grown(task)).item() < 2e-6


def test_mirrored_worlds_are_as_good_where_the_rule_is_not_chiral():
    # The gecko is no mirror image of itself, turned or not.
    both, one = task_of(chiral=False, target="gecko"), task_of(target="gecko")
    x, s = grown(one, 0.7, -1.0)
    assert both.best_turn(x, s).det().item() == pytest.approx(-1.0)
    assert both.metric(x, s).item() < 0.06 < 0.2 < one.metric(x, s).item()


def test_the_gradient_is_that_at_the_angle_chosen():
    task, plain = task_of(), task_of(equivariant=False)
    x, s = grown(task, 1.0)
    x += 0.02 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1))
    (ours,) = torch.autograd.grad(task.metric(leaf := x.clone().requires_grad_(), s).sum(), leaf)
    turn = task.best_turn(x, s)
    upright = turned(x, turn).requires_grad_()
    (theirs,) = torch.autograd.grad(plain.metric(upright, s).sum(), upright)
    assert torch.allclose(ours, turned(theirs, turn.mT), atol=1e-12)


def seeds(**fields):
    return task_of(**fields).seed(3, generator=npa_envs.WorldRandom((1, 2, 3)))


def test_seeds_have_a_head_and_a_left_in_directions_of_their_own():
    x, s, *_ = seeds(seed_axis=0.25, seed_across=0.5)
    # Two channels are projections on a direction each, all others are blank.
    along, across = torch.linalg.lstsq(x, s[..., :2]).solution.unbind(dim=-1)
    for channel, direction in enumerate((along, across)):
        projection = (x @ direction[..., None])[..., 0]
        assert torch.allclose(projection, s[..., channel], atol=1e-6)
    assert s[..., 2:].abs().max() == 0.0
    length = along.norm(dim=1) * task_of().config.seed_radius
    assert torch.allclose(length, torch.tensor(0.25), atol=1e-6)
    assert torch.allclose(across, 2.0 * along @ turn_of(0.5 * math.pi).to(x).mT, atol=1e-5)
    assert torch.cdist(along, along).sort(dim=1).values[:, 1].min() > 0.01
    for axis, across in ((0.25, 0.0), (0.0, 0.5), (0.0, 0.0)):
        plain = seeds(seed_axis=axis, seed_across=across)
        assert torch.equal(plain.x, x)
        scale = torch.tensor([axis / 0.25, across / 0.5])
        assert torch.equal(plain.s[..., :2], s[..., :2] * scale)
        assert plain.s[..., 2:].abs().max() == 0.0
    assert seeds(equivariant=False).s.abs().max() == 0.0


def test_without_angles_seeds_point_one_way_and_worlds_are_compared_as_they_lie():
    task, plain = task_of(angles=0, seed_across=0.25), task_of(equivariant=False)
    x, s, *_ = task.seed(3, generator=torch.Generator().manual_seed(0))
    radius = task.config.seed_radius
    assert torch.allclose(s[..., :2], x * torch.tensor([0.5, 0.25]) / radius)
    for angle in ANGLES:
        x, s = grown(task, angle)
        x.requires_grad_()
        assert torch.equal(task.metric(x, s), plain.metric(x, s))
        assert torch.equal(task.bounded(x), x)
        assert torch.equal(task.best_turn(x, s), torch.eye(2)[None].double())


def test_penalties_know_no_direction_either():
    task = task_of(escape_weight=1.0, bound_weight=1.0)
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 300, 2, generator=generator).double()
    path = torch.rand(2, 300, generator=generator).double()
    s = torch.zeros(2, 300, 16).double()
    turn = turn_of(0.8).expand(2, 2, 2)
    terms, others = (task.penalties(Particles(y, s, path)) for y in (x, turned(x, turn)))
    for name, (weight, term) in terms.items():
        assert torch.allclose(term, others[name][1]), name
        assert weight >= 0.0
    assert terms["bound"][1] > 0.0
    assert terms["stray"][1] > 0.0


def test_a_rule_without_direction_is_refused_by_pages(tmp_path, capsys):
    save_rule(task_of().make_rule(torch.Generator()), tmp_path / "rule.safetensors")
    words = ["export-web", str(tmp_path / "rule.safetensors"), "--out"]
    assert main([*words, str(tmp_path / "page.html")]) == 2
    assert "is equivariant: watch it with npa-envs view" in capsys.readouterr().err


def test_a_preset_that_begins_with_a_first_rule_begins_untrained():
    config = preset("best", equivariant=True)
    assert config.initial_rule
    untrained = Morphogenesis2D(config.task).make_rule(torch.Generator().manual_seed(0))
    assert initial_rule(config, untrained) is untrained
    other = preset("fast", equivariant=True, initial_rule="gecko")
    untrained = Morphogenesis2D(other.task).make_rule(torch.Generator().manual_seed(0))
    with pytest.raises(NPAError, match=r"differs in .*equivariant"):
        initial_rule(other, untrained)
