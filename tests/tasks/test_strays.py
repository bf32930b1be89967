"""Particles that have lost the others: thrown out on all sides, and taught to rest."""

from dataclasses import replace

import pytest
import torch

from npa_envs.tasks.damage import FARTHEST, NEAREST, displace, escape_motion
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.world.randomness import WorldRandom

TINY = {"state_dim": 6, "hidden_dim": 24, "eps": 0.3, "resolution": 24, "particle_count": 96}
SMALL = Morphogenesis2DConfig(
    target="ring", target_point_count=96, escape_share=0.1, escape_weight=1.0, **TINY
)


def generators(device):
    return [torch.Generator(device).manual_seed(4), WorldRandom([4, 5], device=device)]


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("space_dim", [2, 3])
def test_as_many_are_thrown_out_as_was_said_and_on_all_sides(device, which, space_dim):
    x = torch.zeros(2, 4000, space_dim, device=device)
    found = displace(x, share=0.25, generator=generators(device)[which])
    distance = found.norm(dim=-1)
    out = distance > 0.0
    assert ((distance[out] >= NEAREST) & (distance[out] <= FARTHEST)).all()
    # Five standard deviations of a share of 8000, and of the mean of vectors as long as 4.
    assert float(out.float().mean()) == pytest.approx(0.25, abs=0.025)
    assert found[out].mean(dim=0).abs().max() < 0.4
    assert torch.equal(found[~out], x[~out])


def test_only_the_paths_of_those_outside_count():
    x = torch.tensor([[[0.5, 0.2], [1.5, 0.0], [0.0, -3.0]]])
    path = torch.tensor([[7.0, 1.0, 2.0]], requires_grad=True)
    motion = escape_motion(x, path)
    assert float(motion.detach()) == 1.5
    motion.backward()
    assert path.grad.tolist() == [[0.0, 0.5, 0.5]]
    assert float(escape_motion(x[:, :1], path[:, :1]).detach()) == 0.0


def test_a_share_throws_particles_of_the_pool_out_and_a_weight_counts_their_paths():
    task = Morphogenesis2D(SMALL)
    generator = torch.Generator().manual_seed(1)
    x, s, _ = task.seed(2, generator=generator)
    hurt_x, *_ = task.damage(x, s, None, generator)
    out = hurt_x.norm(dim=-1) > 1.0
    assert 0 < int(out.sum()) < 60
    path = torch.ones(2, 96)
    total, parts = task.loss(hurt_x, s, path)
    plain, without = Morphogenesis2D(replace(SMALL, escape_weight=0.0)).loss(hurt_x, s, path)
    assert float(parts["stray"]) == 1.0
    assert "stray" not in without
    assert float(total) == pytest.approx(float(plain) + 1.0)


def test_the_distance_of_the_centroid_from_where_worlds_begin_is_paid_for():
    task = Morphogenesis2D(replace(SMALL, drift_weight=2.0), device="cpu")
    x, s, _ = task.seed(1, generator=torch.Generator().manual_seed(0), device=torch.device("cpu"))
    moved = (x + torch.tensor([0.3, -0.4])).requires_grad_()
    still = x.new_zeros(x.shape[:2])
    near, there = task.loss(x - x.mean(1, keepdim=True), s, still), task.loss(moved, s, still)
    assert float(near[1]["drift"]) < 2e-6
    assert float(there[1]["drift"].detach()) == pytest.approx(0.5, abs=0.05)
    (pull,) = torch.autograd.grad(there[1]["drift"], moved)
    # Every particle is pulled back along the way that the centroid has gone.
    torch.testing.assert_close(
        pull.sum(1), moved.mean(1) / moved.mean(1).norm(dim=-1), rtol=1e-5, atol=1e-6
    )
    assert "drift" not in Morphogenesis2D(SMALL, device="cpu").loss(x, s, still)[1]
