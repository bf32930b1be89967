"""Brushes: what they hold, where particles go, and their derivatives."""

from __future__ import annotations

import pytest
import torch

from npa_envs import NPAError
from npa_envs.world.brushes import (
    clump,
    cut,
    inject,
    inside_ball,
    offsets_from,
    push,
    removed,
    softness,
    state_around,
    wipe_state,
)

BOX = (2.0, 3.0)


def worlds(world_count=2, particle_count=12, space_dim=2, state_dim=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = {"generator": generator, "dtype": torch.float64}
    x = torch.rand(world_count, particle_count, space_dim, **draw) * 2.0 - 1.0
    return x, torch.randn(world_count, particle_count, state_dim, **draw)


def places(x, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(len(x), x.shape[2], generator=generator, dtype=x.dtype) - 0.5


def test_offsets_are_to_the_nearest_image():
    x = torch.tensor([[[0.9, -1.4], [0.0, 0.1]]], dtype=torch.float64)
    offset = offsets_from(x, torch.tensor([[-0.9, 1.4]], dtype=torch.float64), BOX)
    torch.testing.assert_close(offset, torch.tensor([[[-0.2, 0.2], [0.9, -1.3]]], dtype=x.dtype))


@pytest.mark.parametrize("space_dim", [2, 3])
def test_wiped_particles_are_gone_and_the_others_are_as_they_were(space_dim):
    x, s = worlds(1, 200, space_dim)
    centre, radius = places(x), 0.6
    gone = inside_ball(x, centre=centre, radius=radius)
    left_x, left_s = removed(x, s, gone=gone)
    assert 0 < int(gone.sum()) < 200
    assert left_x.shape == (1, 200 - int(gone.sum()), space_dim)
    assert (left_x - centre[:, None]).norm(dim=-1).min() > radius
    assert torch.equal(left_x[0], x[0, ~gone[0]])
    assert torch.equal(left_s[0], s[0, ~gone[0]])


def test_all_particles_may_go():
    x, s = worlds(1)
    left_x, left_s = removed(x, s, gone=torch.ones(1, 12, dtype=torch.bool))
    assert left_x.shape == (1, 0, 2)
    assert left_s.shape == (1, 0, 3)


def test_worlds_of_a_batch_must_lose_as_many_particles():
    x, s = worlds()
    gone = torch.zeros(2, 12, dtype=torch.bool)
    gone[0, 3] = True
    with pytest.raises(NPAError, match=r"as many particles from each world, got \[1, 0\]"):
        removed(x, s, gone=gone)
    with pytest.raises(NPAError, match=r"gone must be a bool tensor of shape \[B, N\] = \[2, 12\]"):
        removed(x, s, gone=gone.float())


def test_a_ball_reaches_across_the_edges_of_a_box():
    x = torch.tensor([[[0.95, 0.0], [-0.95, 0.0], [0.5, 0.0]]], dtype=torch.float64)
    centre = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    assert inside_ball(x, centre=centre, radius=0.1).tolist() == [[True, False, False]]
    assert inside_ball(x, centre=centre, radius=0.1, box=BOX).tolist() == [[True, True, False]]


def test_push_carries_its_middle_by_its_share_and_nothing_outside():
    x = torch.tensor([[[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.5, 0.5]]], dtype=torch.float64)
    move = torch.tensor([[0.3, -0.1]], dtype=torch.float64)
    moved = push(x, centre=x[:, 0], move=move, radius=0.2, strength=0.5) - x
    torch.testing.assert_close(moved[0, 0], 0.5 * move[0])
    # Half-way out the brush holds (1 - 1/4)² of it.
    torch.testing.assert_close(moved[0, 1], 0.5 * 0.5625 * move[0])
    assert torch.equal(moved[0, 2:], torch.zeros(2, 2, dtype=x.dtype))


def test_a_brush_of_no_size_does_nothing_and_has_a_derivative():
    x, _ = worlds()
    x[0, 0] = 0.0
    x.requires_grad_()
    held = softness(x, centre=torch.zeros(2, 2, dtype=x.dtype), radius=0.0)
    assert torch.equal(held, torch.zeros_like(held))
    (gradient,) = torch.autograd.grad(held.sum(), x)
    assert torch.equal(gradient, torch.zeros_like(x))


def test_inject_draws_states_towards_the_given_one():
    x, s = worlds(1, 30)
    state = torch.tensor([[1.0, -2.0, 0.5]], dtype=x.dtype)
    after = inject(x, s, centre=x[:, 4], radius=0.5, state=state)
    torch.testing.assert_close(after[0, 4], state[0])
    outside = ~inside_ball(x, centre=x[:, 4], radius=0.5)
    assert bool(outside.any())
    assert torch.equal(after[outside], s[outside])
    with pytest.raises(NPAError, match=r"state must have shape \[B, C\] = \(1, 3\)"):
        inject(x, s, centre=x[:, 4], radius=0.5, state=state[:, :2])


def test_the_state_around_a_place_is_the_mean_of_what_a_soft_brush_holds():
    x, s = worlds()
    centre = places(x)
    share = softness(x, centre=centre, radius=0.9)
    mean, holds = state_around(x, s, centre=centre, radius=0.9)
    torch.testing.assert_close(mean, (share * s).sum(1) / share.sum(1))
    assert holds.tolist() == [True, True]
    centre[1] = 50.0
    mean, holds = state_around(x, s, centre=centre, radius=0.9)
    assert holds.tolist() == [True, False]
    assert float(mean[1].abs().max()) == 0.0


def test_a_cut_with_ends_opens_only_between_them():
    x = torch.tensor([[[0.0, 0.01], [0.0, -0.01], [0.9, 0.01]]], dtype=torch.float64)
    centre, normal = torch.zeros(1, 2, dtype=x.dtype), torch.tensor([[0.0, 2.0]], dtype=x.dtype)
    along = torch.tensor([[0.5, 0.0]], dtype=x.dtype)
    after, _ = cut(x, x, centre=centre, normal=normal, gap=0.1, along=along)
    torch.testing.assert_close(after[0, :2, 1], torch.tensor([0.055, -0.055], dtype=x.dtype))
    assert torch.equal(after[0, 2], x[0, 2])
    whole, _ = cut(x, x, centre=centre, normal=normal, gap=0.1)
    torch.testing.assert_close(whole[0, 2, 1], torch.tensor(0.055, dtype=x.dtype))
    nothing, _ = cut(x, x, centre=centre, normal=normal, gap=0.1, along=torch.zeros_like(centre))
    assert torch.equal(nothing, x)


def test_clump_and_wipe_reach_across_the_edges_of_a_box():
    x = torch.tensor([[[-0.98, 0.0], [0.0, 0.0]]], dtype=torch.float64)
    s = torch.ones(1, 2, 3, dtype=x.dtype)
    centre = torch.tensor([[0.98, 0.0]], dtype=x.dtype)
    pulled, _ = clump(x, s, centre=centre, radius=0.1, factor=1.0, box=BOX)
    # To the image of the place on its own side.
    torch.testing.assert_close(pulled[0, 0, 0], torch.tensor(-1.02, dtype=x.dtype))
    assert torch.equal(pulled[0, 1], x[0, 1])
    blank = wipe_state(x, s, centre=centre, radius=0.1, box=BOX)
    assert blank[0].tolist() == [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]


@pytest.mark.parametrize("box", [None, BOX], ids=["open", "periodic"])
def test_brushes_are_differentiable(box):
    x, s = worlds()
    centre = places(x)
    move, state = places(x, seed=2), s[:, 0] + 0.3
    radius, strength = torch.tensor([0.4, 0.7], dtype=x.dtype), torch.tensor([0.3, 0.8]).to(x)
    inputs = (x, s, centre, move, state, radius, strength)
    inputs = tuple(value.clone().requires_grad_() for value in inputs)

    def brushed(x, s, centre, move, state, radius, strength):
        pushed = push(
            x, centre=centre, move=move, radius=radius, strength=strength, box=box
        )  # fmt: skip
        filled = inject(
            x, s, centre=centre, radius=radius, state=state, strength=strength, box=box
        )  # fmt: skip
        together, _ = clump(x, s, centre=centre, radius=0.5, factor=strength, box=box)
        opened, _ = cut(x, s, centre=centre, normal=move, gap=0.2, along=2.0 * move, box=box)
        return pushed, filled, together, opened

    assert torch.autograd.gradcheck(brushed, inputs)


def test_each_world_of_a_batch_is_brushed_as_it_is_alone():
    x, s = worlds(3)
    centre, move = places(x), places(x, seed=2)
    radius = torch.tensor([0.2, 0.5, 0.9], dtype=x.dtype)
    together = push(x, centre=centre, move=move, radius=radius)
    filled = inject(x, s, centre=centre, radius=radius, state=s[:, 0])
    for k in range(3):
        one = slice(k, k + 1)
        told = {"centre": centre[one], "radius": float(radius[k])}
        assert torch.equal(together[one], push(x[one], move=move[one], **told))
        assert torch.equal(filled[one], inject(x[one], s[one], state=s[one, 0], **told))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"radius": -1.0}, r"radius must be finite and at least 0, got -1\.0"),
        ({"strength": 1.5}, r"strength must be in \[0, 1\], got 1\.5"),
        ({"move": torch.zeros(2, 3)}, r"move must have shape \[B, D\] = \(2, 2\), got \(2, 3\)"),
        ({"centre": torch.zeros(2, 2)}, r"centre must be torch\.float64 on cpu like x"),
    ],
)
def test_wrong_numbers_of_a_brush_are_named(wrong, message):
    x, _ = worlds()
    right = {"centre": places(x), "move": places(x), "radius": 0.1, "strength": 1.0}
    with pytest.raises(NPAError, match=message):
        push(x, **(right | wrong))


def test_a_state_of_another_dtype_is_refused_as_places_are():
    x, s = worlds()
    with pytest.raises(NPAError, match=r"state must be torch\.float64 on cpu like s"):
        inject(x, s, centre=places(x), radius=0.1, state=s[:, 0].float())


def test_what_goes_must_be_a_tensor():
    with pytest.raises(NPAError, match=r"gone must be a bool tensor of shape .* got None"):
        removed(*worlds(), gone=None)


@pytest.mark.parametrize("box", [2.0, (2.0, 2.0, 2.0)])
def test_a_box_has_a_side_for_each_coordinate(box):
    x, _ = worlds()
    with pytest.raises(NPAError, match="box must have 2 sides"):
        inside_ball(x, centre=places(x), radius=0.1, box=box)
    with pytest.raises(NPAError, match=r"x must have shape \[B, N, D\]"):
        inside_ball(x[0], centre=places(x), radius=0.1)
