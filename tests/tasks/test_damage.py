import math

import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.tasks.damage import random_particle
from npa_envs.world.brushes import clump, cut, wipe_state

B, N, C = 3, 257, 5


@pytest.fixture(params=[(2, torch.float32), (3, torch.float64)], ids=["2d", "3d"])
def world(request, device) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    space_dim, dtype = request.param
    g = torch.Generator().manual_seed(3)
    x = 2 * torch.rand(B, N, space_dim, generator=g, dtype=dtype) - 1
    s = torch.randn(B, N, C, generator=g, dtype=dtype)
    centre = 0.6 * torch.rand(B, space_dim, generator=g, dtype=dtype) - 0.3
    return x.to(device), s.to(device), centre.to(device)


def test_states_inside_the_ball_are_zero_and_the_others_untouched(world):
    x, s, centre = world
    before = s.clone()
    wiped = wipe_state(x, s, centre=centre, radius=0.4)
    counted = 0
    for b in range(B):
        for i in range(N):
            if math.dist(x[b, i].tolist(), centre[b].tolist()) <= 0.4:
                assert (wiped[b, i] == 0).all()
                counted += 1
            else:
                assert torch.equal(wiped[b, i], s[b, i])
    assert counted > 10
    assert torch.equal(s, before)
    # Each world may have a radius of its own.
    radius = torch.tensor([0.0, 0.4, 9.0], dtype=x.dtype, device=x.device)
    by_world = wipe_state(x, s, centre=centre, radius=radius)
    assert torch.equal(by_world[0], s[0])
    assert torch.equal(by_world[1], wiped[1])
    assert (by_world[2] == 0).all()


def test_cut_opens_a_slit_of_the_gap_and_leaves_the_rest_alone(world):
    x, s, centre = world
    normal = torch.randn(B, x.shape[-1], generator=torch.Generator().manual_seed(1)).to(x)
    moved, states = cut(x, s, centre=centre, normal=normal, gap=0.2)
    unit = normal / normal.norm(dim=-1, keepdim=True)
    before = ((x - centre[:, None]) * unit[:, None]).sum(dim=-1)
    after = ((moved - centre[:, None]) * unit[:, None]).sum(dim=-1)
    assert after.abs().min() >= 0.1 - 1e-6
    near = before.abs() < 0.2
    assert near.any()
    assert torch.equal(moved[~near], x[~near])
    torch.testing.assert_close(after[near].abs(), 0.1 + before[near].abs() / 2.0)
    assert torch.equal(after[near] < 0, before[near] < 0)
    across = (moved - x) - (after - before)[..., None] * unit[:, None]
    assert across.abs().max() < 1e-6
    assert states is s
    moved, _ = cut(x, s, centre=centre, normal=torch.zeros_like(centre), gap=0.2)
    assert torch.equal(moved, x)


def test_clump_shortens_the_distance_inside_and_moves_nothing_outside(world):
    x, s, centre = world
    moved, states = clump(x, s, centre=centre, radius=0.5, factor=0.75)
    distance = (x - centre[:, None]).norm(dim=-1)
    inside = distance <= 0.5
    assert 10 < inside.sum() < B * N
    shortened = (moved - centre[:, None]).norm(dim=-1)
    torch.testing.assert_close(shortened[inside], 0.25 * distance[inside])
    assert torch.equal(moved[~inside], x[~inside])
    assert states is s
    collected, _ = clump(x, s, centre=centre, radius=9.0, factor=1.0)
    torch.testing.assert_close(collected, centre[:, None].expand_as(x))
    same, _ = clump(x, s, centre=centre, radius=9.0, factor=0.0)
    assert torch.equal(same, x)


def test_random_particle_is_one_of_its_own_world(world):
    x, _, _ = world
    chosen = random_particle(x, torch.Generator(x.device).manual_seed(0))
    for b in range(B):
        assert (x[b] == chosen[b]).all(dim=-1).any()


def test_wrong_arguments_are_clear_errors():
    x, s, centre = torch.zeros(2, 4, 2), torch.zeros(2, 4, 3), torch.zeros(2, 2)
    with pytest.raises(NPAError, match=r"add a world dimension with x\[None\]"):
        random_particle(x[0])
    with pytest.raises(NPAError, match="at least one particle"):
        random_particle(x[:, :0])
    with pytest.raises(NPAError, match=r"x must be float32 or float64, got torch\.int64"):
        random_particle(x.long())
    with pytest.raises(NPAError, match="x and s must agree in worlds and particles"):
        wipe_state(x, s[:, :3], centre=centre, radius=0.1)
    with pytest.raises(NPAError, match=r"centre must have shape \[B, D\] = \(2, 2\), got \(2,\)"):
        wipe_state(x, s, centre=centre[0], radius=0.1)
    with pytest.raises(NPAError, match=r"centre must be torch\.float32"):
        wipe_state(x, s, centre=centre.double(), radius=0.1)
    with pytest.raises(NPAError, match=r"normal must have shape"):
        cut(x, s, centre=centre, normal=torch.zeros(2, 3), gap=0.1)
    with pytest.raises(NPAError, match=r"radius must be a number or a tensor of shape \[B\]"):
        wipe_state(x, s, centre=centre, radius=torch.zeros(3))
    for radius in (-0.1, math.nan, math.inf):
        with pytest.raises(NPAError, match="radius must be finite and at least 0"):
            clump(x, s, centre=centre, radius=radius, factor=0.5)
    with pytest.raises(NPAError, match=r"factor must be in \[0, 1\], got 1\.5"):
        clump(x, s, centre=centre, radius=0.1, factor=1.5)


@pytest.mark.gpu
def test_generator_of_another_device_is_a_clear_error():
    with pytest.raises(NPAError, match=r"generator must be on the worlds' device"):
        random_particle(torch.zeros(1, 4, 2, device="cuda"), torch.Generator())
