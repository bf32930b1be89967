"""Worlds in one object: what is done to all fields at once."""

import pytest
import torch
from support.worlds import assert_same

from npa_envs.world.particles import Particles, combined


def worlds(count, offset=0.0):
    x = offset + torch.arange(count * 6.0).view(count, 3, 2)
    return Particles(x, -x[..., :1], goal=torch.arange(count))


@pytest.mark.parametrize("with_path", [True, False])
def test_worlds_are_taken_put_chosen_and_combined_field_by_field(with_path):
    three, two = worlds(3), worlds(2, 100.0)
    if with_path:
        three, two = (own._replace(path_length=own.x[..., 0].clone()) for own in (three, two))
    assert (three.take(torch.tensor([2])).path_length is not None) == with_path
    assert_same(three.take(torch.tensor([2, 0])).tensors(), [v[[2, 0]] for v in three.tensors()])
    changed = three.map(torch.clone)
    changed.put_(torch.tensor([2, 1]), two)
    expected = [
        torch.stack((v[0], w[1], w[0])) for v, w in zip(three.tensors(), two.tensors(), strict=True)
    ]
    assert_same(changed.tensors(), expected)
    chosen = three.where(torch.tensor([True, False, False]), changed)
    assert_same(chosen.tensors(), changed.tensors())
    changed.copy_(three)
    assert_same(changed.tensors(), three.tensors())
    assert combined(torch.cat, [three, two]).goal.tolist() == [0, 1, 2, 0, 1]


def test_gathered_particles_keep_the_goals_of_their_worlds():
    two = worlds(2)
    order = torch.tensor([2, 0, 1, 3, 5, 4])
    result = two.gather(order)
    assert_same(result.s, two.s.view(6, 1)[order].view(2, 3, 1))
    assert result.goal is two.goal


@pytest.mark.parametrize("path", [None, torch.arange(6.0).view(2, 3)])
def test_species_have_their_particles_and_the_goals_of_their_worlds(path):
    two = worlds(2)._replace(path_length=path)
    for species, some in zip(two.split([1, 2]), (slice(0, 1), slice(1, 3)), strict=True):
        fields = [value[:, some] for value in two.per_particle() if value is not None]
        assert_same(species.tensors(), [*fields, two.goal])
        assert (species.path_length is None) == (path is None)
