"""Pictures of open and of periodic worlds, and their adjoints, against plain torch."""

import pytest
import torch
from support.worlds import assert_same, exact, relative_error, with_gradients

from npa_envs import reference as oracle
from npa_envs.ops import periodic_splat, splat

# Worst relative error measured, then the bound, of open pictures and of periodic ones.
BOUND = {torch.float32: 5e-6, torch.float64: 1e-13}  # 8e-7, 4e-16
PERIODIC_BOUND = {torch.float32: 1e-5, torch.float64: 3e-14}  # 2.0e-6, 3.3e-15

OPTIONS = {"resolution": 24, "pixel_size": 0.11, "sigma": 0.9}


def scattered(world_count, particle_count, dtype, device):
    """Return particles inside the window, on its edge and outside, and their colours."""
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(world_count, particle_count, 2, generator=generator) * 2.6 - 1.3
    colour = torch.rand(world_count, particle_count, 3, generator=generator)
    return x.to(device, dtype), colour.to(device, dtype)


def in_the_box(world_count, particle_count, dtype, device):
    """Return particles all over the box, some almost on its edges, and their colours."""
    x, colour = scattered(world_count, particle_count, dtype, device)
    x = x / 1.3
    x[:, 0], x[:, 1], x[:, 2, 0] = -0.9999, 0.9999, -0.9999
    return x, colour


def periodic_oracle(x, colour, *, resolution, pixel_size, sigma, lo=-1.0, hi=1.0):
    """Return the pictures of `periodic_splat` in plain torch: each particle with its images."""
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


OPEN = {"resolution": 37, "pixel_size": 0.09}
VARIANTS = [
    *((splat, OPEN | more) for more in ({}, {"sigma": 0.6}, {"lo": -1.5, "hi": 0.5})),
    *(
        (periodic_splat, OPTIONS | more)
        for more in ({}, {"sigma": 0.4}, {"sigma": 9.0}, {"lo": -1.0, "hi": 0.5})
    ),
]


@pytest.mark.parametrize(
    ("draw", "options", "count"),
    # On CUDA a block sorts a small world, and several launches a large one.
    [*((*variant, 61) for variant in VARIANTS), (*VARIANTS[0], 5000), (*VARIANTS[3], 5000)],
)
def test_picture_and_adjoints_equal_the_oracle(dtype, draw, options, count, device):
    plain, bounds = oracle.splat, [BOUND[dtype] * factor for factor in (1, 4, 1)]
    worlds = scattered(3, count, dtype, device)
    if draw is periodic_splat:
        # A sum over images.
        plain, bounds = periodic_oracle, [PERIODIC_BOUND[dtype]] * 3
        x, colour = in_the_box(3, count, dtype, device)
        worlds = torch.where(x > options.get("hi", 1.0), x - 1.47, x), colour
    results = with_gradients(lambda *worlds: draw(*worlds, **options), *worlds)
    expected = with_gradients(lambda *worlds: plain(*worlds, **options), *exact(*worlds))
    for value, answer, bound in zip(results, expected, bounds, strict=True):
        assert relative_error(value, answer) < bound


HOSTILE = [(draw, value) for draw in (splat, periodic_splat) for value in ("inf", "nan")]


@pytest.mark.parametrize(("draw", "value"), [*HOSTILE, *((splat, far) for far in (3, 1e30, -1e8))])
def test_particles_far_away_or_not_finite_are_left_out_and_have_no_gradient(draw, value, device):
    x, colour = scattered(1, 20, torch.float32, device)
    hostile = torch.cat((x, torch.full_like(x[:, :1], float(value))), dim=1)
    colours = torch.cat((colour, colour[:, :1]), dim=1)
    picture, *bars = with_gradients(lambda *world: draw(*world, **OPTIONS), hostile, colours)
    expected = with_gradients(lambda *world: draw(*world, **OPTIONS), x, colour)
    assert_same((picture, [bar[:, :-1] for bar in bars]), expected)
    assert not any(bar[:, -1].any() for bar in bars)


@pytest.mark.parametrize("sigma", [0.3, 0.04, 1e-3])
def test_narrow_gaussians_keep_their_area(sigma, device):
    x, colour = scattered(1, 40, torch.float32, device)
    x = 0.6 * x
    picture = splat(x, colour, resolution=64, pixel_size=0.03125, sigma=sigma)
    assert torch.isfinite(picture).all()
    assert float(picture[..., 3].sum()) == pytest.approx(40.0, rel=1e-5)
