"""The splat renderer and its adjoint against plain torch."""

import pytest
import torch
from worlds import relative_error

from npa_envs import NPAError
from npa_envs import reference as oracle
from npa_envs.kernels.pictures.splat import make_lens
from npa_envs.ops import splat
from npa_envs.ops.launch import launch, scalar_type
from npa_envs.ops.pictures.splat import (
    Splats,
    device_kernels,
    gather_threads,
    scatter_splats,
    sort_splats,
)

# Worst error measured, then the bound.
BOUND = {torch.float32: 5e-6, torch.float64: 1e-13}  # 8e-7, 4e-16


def scattered(world_count, particle_count, dtype, device, seed=0):
    """Particles inside the window, on its edge and outside."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(world_count, particle_count, 2, generator=generator) * 2.6 - 1.3
    colour = torch.rand(world_count, particle_count, 3, generator=generator)
    return x.to(device, dtype), colour.to(device, dtype)


@pytest.mark.parametrize("options", [{}, {"sigma": 0.6}, {"lo": -1.5, "hi": 0.5}])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=("float32", "float64"))
def test_picture_and_adjoints_equal_the_oracle(dtype, options, device):
    x, colour = scattered(3, 61, dtype, device)
    exact = [t.cpu().double().clone().requires_grad_() for t in (x, colour)]
    expected = oracle.splat(*exact, resolution=37, pixel_size=0.09, **options)
    cotangent = torch.randn(
        expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    expected.backward(cotangent)
    x.requires_grad_()
    colour.requires_grad_()
    picture = splat(x, colour, resolution=37, pixel_size=0.09, **options)
    picture.backward(cotangent.to(picture))
    assert relative_error(picture, expected) < BOUND[dtype]
    assert relative_error(x.grad, exact[0].grad) < BOUND[dtype] * 4
    assert relative_error(colour.grad, exact[1].grad) < BOUND[dtype]


def test_gradients_pass_gradcheck(device):
    x, colour = scattered(1, 11, torch.float64, device)
    assert torch.autograd.gradcheck(
        lambda x, c: splat(x, c, resolution=12, pixel_size=0.2),
        (x.requires_grad_(), colour.requires_grad_()),
    )


@pytest.mark.parametrize("pixel_size", [0.02, 0.09, 0.25])
@pytest.mark.parametrize("resolution", [8, 13, 33, 38])
def test_gathered_and_scattered_pictures_are_the_same(resolution, pixel_size, device):
    x, colour = scattered(2, 61, torch.float64, device)
    x[1, 3] = torch.nan
    lens = make_lens(scalar_type(x.dtype), resolution, pixel_size, 1.0, -1.0, 1.0)
    expected, *_ = scatter_splats(Splats(x, colour), lens)
    starts, footprints, source = sort_splats(Splats(x, colour), lens)
    assert sorted(source.tolist()) == list(range(122))
    picture = torch.full_like(expected, torch.nan)
    launch(
        device_kernels(x).gather_splats,
        gather_threads(2, resolution, x.device),
        x.device,
        lens,
        starts,
        footprints,
        picture.view(-1, 4),
    )
    torch.testing.assert_close(picture, expected, rtol=1e-12, atol=1e-13)


def test_hidden_particles_have_no_gradient(device):
    x, colour = scattered(1, 20, torch.float32, device)
    x[0, :4, 0] = torch.tensor([3.0, 1e30, torch.inf, torch.nan])
    x.requires_grad_()
    colour.requires_grad_()
    (splat(x, colour, resolution=40, pixel_size=0.06) ** 2).sum().backward()
    assert float(x.grad[0, :4].abs().max()) == 0.0
    assert float(colour.grad[0, :4].abs().max()) == 0.0
    assert float(x.grad[0, 4:].abs().max()) > 1.0


def test_cotangents_may_lie_anywhere_in_memory(device):
    x, colour = scattered(1, 20, torch.float32, device)
    x.requires_grad_()
    picture = splat(x, colour, resolution=10, pixel_size=0.2)
    generator = torch.Generator().manual_seed(2)
    shifted = torch.randn(401, generator=generator).to(device)[1:].view(1, 10, 10, 4)
    (expected,) = torch.autograd.grad(picture, x, shifted.clone(), retain_graph=True)
    assert torch.equal(torch.autograd.grad(picture, x, shifted)[0], expected)


def test_a_particle_inside_the_window_has_the_area_of_a_target_pixel(device):
    x = torch.tensor([[[0.123, -0.234]]], dtype=torch.float64, device=device)
    colour = torch.tensor([[[0.2, 0.4, 0.8]]], dtype=torch.float64, device=device)
    picture = splat(x, colour, resolution=64, pixel_size=0.1)
    area = (64 * 0.1 / 2.0) ** 2
    expected = torch.tensor([0.2, 0.4, 0.8, 1.0], dtype=torch.float64) * area
    torch.testing.assert_close(picture.sum(dim=(0, 1, 2)).cpu(), expected)


def test_rows_point_up_and_columns_right(device):
    x = torch.tensor([[[0.5, -0.75]]], device=device)
    picture = splat(x, torch.ones(1, 1, 3, device=device), resolution=65, pixel_size=0.05)
    row, column = divmod(int(picture[0, ..., 3].argmax()), 65)
    assert (row, column) == (8, 48)


def test_pictures_are_bit_identical_and_independent_of_the_batch(device):
    x, colour = scattered(4, 500, torch.float32, device)
    pictures = splat(x, colour, resolution=50, pixel_size=0.06)
    assert torch.equal(pictures, splat(x, colour, resolution=50, pixel_size=0.06))
    for k in range(4):
        alone = splat(x[k : k + 1], colour[k : k + 1], resolution=50, pixel_size=0.06)
        assert torch.equal(pictures[k], alone[0])


def test_particles_far_away_or_not_finite_leave_the_picture_alone(device):
    x, colour = scattered(1, 20, torch.float32, device)
    expected = splat(x, colour, resolution=40, pixel_size=0.06)
    for value in (1e30, -1e8, float("inf"), float("nan")):
        hostile = torch.cat((x, torch.full_like(x[:, :1], value)), dim=1)
        colours = torch.cat((colour, colour[:, :1]), dim=1)
        assert torch.equal(splat(hostile, colours, resolution=40, pixel_size=0.06), expected)


@pytest.mark.parametrize("sigma", [0.3, 0.04, 1e-3])
def test_narrow_gaussians_keep_their_area(sigma, device):
    x, colour = scattered(1, 40, torch.float32, device)
    x = 0.6 * x
    picture = splat(x, colour, resolution=64, pixel_size=0.03125, sigma=sigma)
    assert torch.isfinite(picture).all()
    assert float(picture[..., 3].sum()) == pytest.approx(40.0, rel=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": 1}, "resolution must be at least 2"),
        ({"pixel_size": 0.0}, "pixel_size must be positive"),
        ({"sigma": float("nan")}, "sigma must be positive"),
        ({"lo": 1.0}, "lo < hi"),
    ],
)
def test_bad_numbers_are_refused(change, message):
    options = {"resolution": 16, "pixel_size": 0.1} | change
    with pytest.raises(NPAError, match=message):
        splat(torch.zeros(1, 2, 2), torch.zeros(1, 2, 3), **options)


def test_bad_shapes_are_refused():
    with pytest.raises(NPAError, match=r"x and colour must have shapes"):
        splat(torch.zeros(1, 2, 3), torch.zeros(1, 2, 3), resolution=16, pixel_size=0.1)
    with pytest.raises(NPAError, match=r"x\[None\]"):
        splat(torch.zeros(2, 2), torch.zeros(1, 2, 3), resolution=16, pixel_size=0.1)
