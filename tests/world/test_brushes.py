"""Brushes: what they hold, where particles go, and their derivatives."""

import pytest
import torch

from npa_envs import NPAError
from npa_envs.world.brushes import (
    clump,
    cut,
    inject,
    inside_ball,
    push,
    softness,
    state_around,
    sums_under_brushes,
    wipe_state,
)

BOX = (2.0, 3.0)


def worlds(world_count=2, particle_count=12, space_dim=2, state_dim=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = {"generator": generator, "dtype": torch.float64}
    x = torch.rand(world_count, particle_count, space_dim, **draw) * 2.0 - 1.0
    return x, torch.randn(world_count, particle_count, state_dim, **draw)


def points(x, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(len(x), x.shape[2], generator=generator, dtype=x.dtype) - 0.5


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_ball_holds_the_particles_within_its_radius(space_dim):
    x, _ = worlds(1, 200, space_dim)
    centre, radius = points(x), 0.6
    inside = inside_ball(x, centre=centre, radius=radius)
    assert 0 < int(inside.sum()) < 200
    assert torch.equal(inside, (x - centre[:, None]).norm(dim=-1) <= radius)


def test_brushes_reach_across_the_edges_of_a_box():
    x = torch.tensor([[[0.95, 0.0], [-0.98, 0.0], [0.5, 0.0]]], dtype=torch.float64)
    s = torch.ones(1, 3, 3, dtype=x.dtype)
    ball = {"centre": torch.tensor([[0.98, 0.0]], dtype=x.dtype), "radius": 0.1}
    assert inside_ball(x, **ball).tolist() == [[True, False, False]]
    assert inside_ball(x, **ball, box=BOX).tolist() == [[True, True, False]]
    pulled, _ = clump(x, s, **ball, factor=1.0, box=BOX)
    # To the image of the place on its own side.
    torch.testing.assert_close(pulled[0, :, 0], torch.tensor([0.98, -1.02, 0.5], dtype=x.dtype))
    assert wipe_state(x, s, **ball, box=BOX)[0].sum(1).tolist() == [0.0, 0.0, 3.0]


def test_push_carries_its_middle_by_its_share_and_nothing_outside():
    x = torch.tensor([[[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.5, 0.5]]], dtype=torch.float64)
    move = torch.tensor([[0.3, -0.1]], dtype=torch.float64)
    moved = push(x, centre=x[:, 0], move=move, radius=0.2, strength=0.5) - x
    torch.testing.assert_close(moved[0, 0], 0.5 * move[0])
    # Half-way out the brush holds (1 - 1/4)² of it.
    torch.testing.assert_close(moved[0, 1], 0.5 * 0.5625 * move[0])
    assert torch.equal(moved[0, 2:], torch.zeros(2, 2, dtype=x.dtype))


@pytest.mark.parametrize("box", [None, (1.2, 1.2)], ids=["open", "box"])
@pytest.mark.parametrize("moments", [False, True])
def test_sums_under_brushes_are_those_of_soft_weights_in_every_batch(moments, box):
    x, values = worlds(3, 300)
    centres, options = worlds(3, 7, seed=2)[0], {"radius": 0.5, "box": box, "moments": moments}
    sums = sums_under_brushes(centres, x, values, **options)
    with_gradient = sums_under_brushes(centres, x, values.requires_grad_(), **options)
    torch.testing.assert_close(sums, with_gradient)
    held = softness(x, centre=centres[:, 3], radius=0.5, box=box)
    torch.testing.assert_close(sums[:, 3, 3 * moments :], (held * values).sum(dim=1))
    if moments:
        torch.testing.assert_close(sums[:, 3, 0], held.sum(dim=(1, 2)))
    single = [v.detach().float() for v in (centres, x, values)]
    alone = sums_under_brushes(*(v[1:2] for v in single), **options)
    assert torch.equal(alone, sums_under_brushes(*single, **options)[1:2])
    torch.testing.assert_close(alone.double(), sums[1:2], rtol=1e-5, atol=1e-4)


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


def test_the_state_around_a_place_is_the_mean_of_what_a_soft_brush_holds():
    x, s = worlds()
    centre = points(x)
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


@pytest.mark.parametrize("box", [None, BOX], ids=["open", "periodic"])
def test_brushes_are_differentiable(box):
    x, s = worlds()
    radius, strength = torch.tensor([[0.4, 0.7], [0.3, 0.8]], dtype=x.dtype)
    inputs = (x, s, points(x), points(x, seed=2), s[:, 0] + 0.3, radius, strength)

    def brushed(x, s, centre, move, state, radius, strength):
        at = {"centre": centre, "box": box}
        pushed = push(x, move=move, radius=radius, strength=strength, **at)
        filled = inject(x, s, radius=radius, state=state, strength=strength, **at)
        together, _ = clump(x, s, radius=0.5, factor=strength, **at)
        opened, _ = cut(x, s, normal=move, gap=0.2, along=2.0 * move, **at)
        return pushed, filled, together, opened

    assert torch.autograd.gradcheck(brushed, [v.clone().requires_grad_() for v in inputs])


def test_each_world_of_a_batch_is_brushed_as_it_is_alone():
    x, s = worlds(3)
    centre, move = points(x), points(x, seed=2)
    radius = torch.tensor([0.2, 0.5, 0.9], dtype=x.dtype)
    together = push(x, centre=centre, move=move, radius=radius)
    filled = inject(x, s, centre=centre, radius=radius, state=s[:, 0])
    for k in range(3):
        one = slice(k, k + 1)
        ball = {"centre": centre[one], "radius": float(radius[k])}
        assert torch.equal(together[one], push(x[one], move=move[one], **ball))
        assert torch.equal(filled[one], inject(x[one], s[one], state=s[one, 0], **ball))


X, S = worlds()
AT = {"centre": points(X), "radius": 0.1}
PUSH = AT | {"move": points(X)}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: push(X, **PUSH | {"radius": -1.0}), "radius must be finite .* at least 0, got -1"),
        (lambda: push(X, **PUSH, strength=1.5), r"strength must be in \[0, 1\], got 1\.5"),
        (lambda: push(X, **PUSH | {"move": points(X)[:, :1]}), r"move must have shape \[B, D\]"),
        (lambda: push(X, **PUSH | {"centre": AT["centre"].float()}), "centre and x must share"),
        (lambda: inject(X, S, **AT, state=S[:, 0].float()), "state and s must share .*32 .*64"),
        (lambda: inject(X, S, **AT, state=S[:, 0, :2]), r"state must have .* \[B, C\] = \(2, 3\)"),
        (lambda: inside_ball(X, **AT, box=(2.0, 2.0, 2.0)), "box must have 2 sides"),
        (lambda: inside_ball(X[0], **AT), r"x must have shape \[B, N, D\]"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(NPAError, match=message):
        call()
