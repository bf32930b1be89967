"""What is done to worlds of the pool before a rollout: to some of them, to each its own."""

import pytest
import torch

from npa_envs.tasks.damage import FARTHEST, NEAREST, SHARE, PoolDamage, damage_pool, tear_off
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.randomness import WorldRandom


def worlds(count, space_dim=2, particles=200):
    generator = torch.Generator().manual_seed(1)
    x = uniform_ball(count, particles, space_dim, 0.8, generator=generator)
    return x, torch.ones(count, particles, 3)


def changed(before, after):
    return (before != after).flatten(1).any(dim=1)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_ball_of_states_is_wiped_in_every_world(space_dim):
    x, s = worlds(40, space_dim)
    generator = torch.Generator().manual_seed(2)
    found, states = damage_pool(x, s, PoolDamage(damage_radius=0.3), generator=generator)
    assert found is x
    for places, blank in zip(x, (states == 0.0).all(dim=-1), strict=True):
        assert 0 < int(blank.sum()) < 150
        assert float(torch.cdist(places[blank], places[blank]).max()) <= 0.6


@pytest.mark.parametrize("what", ["clump_radius", "cut_gap", "flake_radius"])
@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_quarter_of_the_worlds_is_hit(what, space_dim):
    x, s = worlds(400, space_dim, 60)
    generator = torch.Generator().manual_seed(2)
    found, states = damage_pool(x, s, PoolDamage(**{what: 0.5}), generator=generator)
    # Five standard deviations of a share of 400 worlds; some are hit where nobody is.
    share = float(changed(x, found).float().mean())
    assert SHARE - 0.13 < share < SHARE + 0.11
    assert torch.equal(states, s)


def test_as_many_worlds_are_cut_as_asked_for():
    x, s = worlds(400, particles=60)
    generator = torch.Generator().manual_seed(2)
    found, _ = damage_pool(x, s, PoolDamage(cut_gap=0.5, cut_share=0.7), generator=generator)
    assert 0.57 < float(changed(x, found).float().mean()) < 0.82


def test_a_clump_is_one_point():
    x, s = worlds(40)
    generator = torch.Generator().manual_seed(2)
    found, _ = damage_pool(x, s, PoolDamage(clump_radius=0.3), generator=generator)
    hit = changed(x, found)
    assert hit.any()
    for before, after in zip(x[hit], found[hit], strict=True):
        moved = (before != after).any(dim=1)
        middle = after[moved].mean(dim=0)
        at_one_point = (after - middle).norm(dim=1) < 1e-6
        assert torch.equal(at_one_point, (before - middle).norm(dim=1) <= 0.3)
        assert int(at_one_point.sum()) > 1


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_flake_leaves_as_it_is(space_dim):
    x, _ = worlds(60, space_dim)
    found = tear_off(x, radius=0.3, chance=0.5, generator=torch.Generator().manual_seed(3))
    hit = changed(x, found)
    assert 15 <= int(hit.sum()) <= 45
    sizes = []
    for before, after in zip(x[hit], found[hit], strict=True):
        torn = (before != after).any(dim=1)
        shift = (after - before)[torn]
        torch.testing.assert_close(shift, shift[:1].expand_as(shift), rtol=0.0, atol=1e-6)
        distance = after[torn].norm(dim=1)
        assert (distance > NEAREST - 0.3).all()
        assert (distance < FARTHEST + 0.3).all()
        sizes.append(int(torn.sum()))
    # Some are single particles, some are not.
    assert min(sizes) <= 3 < max(sizes)


def test_each_world_suffers_what_it_would_suffer_alone(device):
    every = PoolDamage(
        damage_radius=0.1, clump_radius=0.3, cut_gap=0.2, flake_radius=0.3, escape_share=0.05
    )
    x, s = (tensor.to(device) for tensor in worlds(6))
    together = damage_pool(x, s, every, generator=WorldRandom(range(6), device=device))
    for k in range(6):
        alone = damage_pool(
            x[k : k + 1], s[k : k + 1], every, generator=WorldRandom([k], device=device)
        )
        torch.testing.assert_close(alone[0], together[0][k : k + 1], rtol=0.0, atol=2e-7)
        assert torch.equal(alone[1], together[1][k : k + 1])


def test_nothing_is_done_unless_asked_for():
    x, s = worlds(3)
    found = damage_pool(x, s, PoolDamage(), generator=torch.Generator())
    assert found[0] is x
    assert found[1] is s
    assert Morphogenesis2DConfig().clump_radius == Morphogenesis2DConfig().flake_radius == 0.0
