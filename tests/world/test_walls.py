"""Boxes whose walls reflect: trajectories and gradients of the oracle."""

import pytest
import torch
from support.worlds import assert_same, cotangents, lively_rule, random_world, relative_error

from npa_envs import NPAError, at_rest, rollout, rollout_species
from npa_envs import reference as oracle

WALLS = {"wide": (1.5, 1.2, 1.4), "narrow": (0.3, 0.2, 0.25), "below a step": (0.05, 0.3, 1.0)}
"""Sides of boxes; steps are up to 0.6 long."""


def world(space_dim=2, device="cpu", dtype=torch.float64, **options):
    """Return a rule, and worlds of which many particles begin outside of the boxes."""
    rule = lively_rule(device, dtype, space_dim, alpha=3.0, **options)
    x, s = random_world(2, 20, space_dim, 5, dtype=dtype, device=device)
    return rule, 2.0 * x, s


def plain_rollout(rule, x, s, steps, walls):
    """The dynamics with update_prob=1 in plain torch over the oracle."""
    for _ in range(steps):
        y = rule(oracle.perceive(x, s, rule.eps0, rule.eps0))
        delta = y[..., : x.shape[2]]
        step = rule.alpha * rule.eps0 * delta / (1.0 + delta.norm(dim=-1, keepdim=True))
        x, s = oracle.reflected(x + step, walls), s + y[..., x.shape[2] :]
    return x, s


def with_gradients(run, rule, x, s):
    leaves = [x.clone().requires_grad_(), s.clone().requires_grad_(), *rule.parameters()]
    found = run(rule, *leaves[:2])
    return [*found, *torch.autograd.grad(found, leaves, cotangents(found))]


@pytest.mark.device
@pytest.mark.parametrize("name", WALLS)
@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-11), (torch.float32, 2e-3)])
def test_trajectories_and_gradients_are_the_oracles(space_dim, name, dtype, bound, device):
    rule, x, s = world(space_dim, device, dtype)
    walls = WALLS[name][:space_dim]
    options = {"box": walls, "boundary": "reflecting", "update_prob": 1.0}
    found = with_gradients(lambda *world: rollout(*world, 2, **options), rule, x, s)
    expected = with_gradients(
        lambda *world: plain_rollout(*world, 2, walls),
        rule.cpu().double(),
        *(x.cpu().double(), s.cpu().double()),
    )
    for value, answer in zip(found, expected, strict=True):
        assert relative_error(value, answer) < bound
    assert (found[0].abs() <= 0.5 * x.new_tensor(walls)).all()


def test_species_are_reflected_at_the_same_walls():
    rule, x, s = world()
    options = {"box": 0.7, "boundary": "reflecting", "update_prob": 1.0}
    together = rollout_species([rule, rule], x, s, 3, counts=[12, 8], **options)
    for value, answer in zip(together, rollout(rule, x, s, 3, **options), strict=True):
        assert relative_error(value, answer) < 1e-9


def test_particles_of_static_rules_begin_within_the_walls():
    rule, x, s = world(static=True)
    after, _ = rollout(rule, x, s, 40, box=0.7, boundary="reflecting")
    assert relative_error(after, oracle.reflected(x, (0.7, 0.7))) < 1e-12


def test_particles_perceive_no_images_behind_walls():
    rule, x, s = world()
    x = 0.2 * x
    wide = {"box": 10.0, "boundary": "reflecting", "update_prob": 1.0}
    assert_same(rollout(rule, x, s, 1, **wide), rollout(rule, x, s, 1, update_prob=1.0))


def test_worlds_beyond_the_walls_are_not_at_rest():
    rule, x, s = world(dead_zone=1e9)
    box = {"box": 20.0, "boundary": "reflecting"}
    assert at_rest(rule, x, s, **box).all()
    assert not at_rest(rule, x + 15.0, s, **box).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"boundary": ["reflecting"], "box": 2.0}, "boundary must be 'open', 'periodic'"),
        ({"boundary": "closed", "box": 2.0}, "boundary must be 'open', 'periodic' or 'reflecting'"),
        ({"boundary": "open", "box": 2.0}, "box must be None where boundary is 'open'"),
        ({"boundary": "reflecting"}, "box must be given where boundary is 'reflecting'"),
        ({"boundary": "reflecting", "box": 0.0}, "box sides must be finite and positive"),
        ({"boundary": "reflecting", "box": (1.0, 1.0, 1.0)}, "box must have 2 sides"),
    ],
)
def test_what_walls_cannot_be_is_refused(options, message):
    with pytest.raises(NPAError, match=message):
        rollout(*world(), 1, **options)
