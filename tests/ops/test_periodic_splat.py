"""Pictures of periodic worlds: seams, shifts, gradients."""

import pytest
import torch
from worlds import relative_error

from npa_envs import NPAError
from npa_envs.ops import periodic_splat, splat

OPTIONS = {"resolution": 24, "pixel_size": 0.11, "sigma": 0.9}

# Worst relative error measured, then the bound.
BOUND = {torch.float32: 1e-5, torch.float64: 3e-14}  # 2.0e-6, 3.3e-15


def worlds(world_count, particle_count, dtype, device, seed=0):
    """Particles all over the box, some of them almost on its edges."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(world_count, particle_count, 2, generator=generator) * 2.0 - 1.0
    x[:, 0], x[:, 1], x[:, 2, 0] = -0.9999, 0.9999, -0.9999
    colour = torch.rand(world_count, particle_count, 3, generator=generator)
    return x.to(device, dtype), colour.to(device, dtype)


def oracle(x, colour, *, resolution, pixel_size, sigma, lo=-1.0, hi=1.0):
    """Every particle with its eight images, each over the whole picture, in plain torch."""
    spread = sigma * resolution * pixel_size / (hi - lo)
    radius = -(-3.0 * spread // 1.0)
    place = (x - lo) / (hi - lo) * resolution - 0.5
    pixel = torch.arange(resolution, dtype=x.dtype, device=x.device)
    weights = []
    for d in range(2):
        centre = (place[..., d] + 0.5).floor().detach()
        patch = centre[..., None] + torch.arange(-radius, radius + 1).to(x)
        total = torch.exp(-((patch - place[..., d, None]) ** 2) / (2 * spread**2)).sum(-1)
        row = 0.0
        for turn in range(-3, 4):
            away = pixel + turn * resolution
            inside = (away - centre[..., None]).abs() <= radius
            value = torch.exp(-((away - place[..., d, None]) ** 2) / (2 * spread**2))
            row = row + torch.where(inside, value, torch.zeros_like(value))
        weights.append(row / total[..., None])
    painted = torch.cat((colour, torch.ones_like(colour[..., :1])), dim=-1)
    area = (resolution * pixel_size / (hi - lo)) ** 2
    return area * torch.einsum("bnq,bnp,bnc->bpqc", *weights, painted)


@pytest.mark.parametrize("options", [{}, {"sigma": 0.4}, {"sigma": 9.0}, {"lo": -1.0, "hi": 0.5}])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=("float32", "float64"))
def test_picture_and_gradients_equal_a_sum_over_images(dtype, options, device):
    options = OPTIONS | options
    x, colour = worlds(3, 61, dtype, device)
    x = torch.where(x > options.get("hi", 1.0), x - 1.47, x)
    exact = [t.cpu().double().clone().requires_grad_() for t in (x, colour)]
    expected = oracle(*exact, **options)
    generator = torch.Generator().manual_seed(1)
    cotangent = torch.randn(expected.shape, dtype=torch.float64, generator=generator)
    expected.backward(cotangent)
    x.requires_grad_()
    colour.requires_grad_()
    picture = periodic_splat(x, colour, **options)
    picture.backward(cotangent.to(picture))
    assert relative_error(picture, expected) < BOUND[dtype]
    assert relative_error(x.grad, exact[0].grad) < BOUND[dtype]
    assert relative_error(colour.grad, exact[1].grad) < BOUND[dtype]


def test_gradients_pass_gradcheck_across_the_seam(device):
    x = torch.tensor([[[-0.99, 0.97], [0.98, -0.31], [0.12, 0.23], [3.05, -2.96]]])
    colour = torch.rand(1, 4, 3, generator=torch.Generator().manual_seed(0))
    x, colour = (t.to(device, torch.float64).requires_grad_() for t in (x, colour))
    assert torch.autograd.gradcheck(
        lambda x, c: periodic_splat(x, c, resolution=10, pixel_size=0.2), (x, colour)
    )


@pytest.mark.parametrize("shift", [(12, 12), (0, 7), (23, -5)])
def test_moving_all_particles_rolls_the_picture(shift, device):
    x, colour = worlds(2, 200, torch.float64, device)
    picture = periodic_splat(x, colour, **OPTIONS)
    moved = x + torch.tensor(shift, dtype=x.dtype, device=device) * (2.0 / 24)
    rolled = periodic_splat(moved, colour, **OPTIONS)
    expected = picture.roll((shift[1], shift[0]), dims=(1, 2))
    torch.testing.assert_close(rolled, expected, rtol=0.0, atol=1e-12)


def test_every_particle_has_its_whole_weight_wherever_it_is(device):
    x, colour = worlds(1, 300, torch.float64, device)
    picture = periodic_splat(3.0 * x, colour, **OPTIONS)
    area = (24 * 0.11 / 2.0) ** 2
    expected = torch.cat((colour, torch.ones_like(colour[..., :1])), dim=-1).sum((0, 1)) * area
    torch.testing.assert_close(picture.sum((0, 1, 2)), expected)


def test_away_from_the_seam_it_is_the_open_picture(device):
    x, colour = worlds(1, 50, torch.float64, device)
    x = 0.5 * x
    # The open picture's first and last pixels are centred on the window's edges.
    half = 1.0 / 24
    h = OPTIONS["pixel_size"] * 23 / 24
    expected = splat(x, colour, **OPTIONS | {"pixel_size": h}, lo=-1.0 + half, hi=1.0 - half)
    picture = periodic_splat(x, colour, **OPTIONS)
    torch.testing.assert_close(picture, expected, rtol=1e-11, atol=1e-13)


def test_pictures_are_independent_of_the_batch(device):
    x, colour = worlds(4, 500, torch.float32, device)
    pictures = periodic_splat(x, colour, **OPTIONS)
    for k in range(4):
        alone = periodic_splat(x[k : k + 1], colour[k : k + 1], **OPTIONS)
        assert torch.equal(pictures[k], alone[0])


def test_particles_that_are_not_finite_leave_the_picture_alone(device):
    x, colour = worlds(1, 20, torch.float32, device)
    expected = periodic_splat(x, colour, **OPTIONS)
    for value in (float("inf"), float("nan")):
        hostile = torch.cat((x, torch.full_like(x[:, :1], value)), dim=1)
        colours = torch.cat((colour, colour[:, :1]), dim=1)
        assert torch.equal(periodic_splat(hostile, colours, **OPTIONS), expected)


def test_bad_numbers_are_refused():
    x, colour = torch.zeros(1, 2, 2), torch.zeros(1, 2, 3)
    with pytest.raises(NPAError, match="resolution must be at least 2"):
        periodic_splat(x, colour, resolution=1, pixel_size=0.1)
