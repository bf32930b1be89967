"""Pictures of open and of periodic worlds, their adjoints against plain torch, and their errors."""

import functools

import pytest
import torch
from support.worlds import assert_same, exact, relative_error, tensors, with_gradients

from npa_envs import WorldRandom
from npa_envs import reference as oracle
from npa_envs.ops import periodic_splat, splat
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig

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


# Errors of a task's pictures: in one pass as by the differentiable path, alone as in a batch.


ERRORS = {torch.float32: 3e-6, torch.float64: 1e-13}
"""Largest relative difference between both paths (worst seen 3e-7 and 4e-16)."""


@functools.cache
def task_of(particle_count, resolution, device):
    """A task, drawn once for all tests: its target takes longer than they do."""
    sizes = {"particle_count": particle_count, "resolution": resolution}
    return Morphogenesis2D(Morphogenesis2DConfig(target_point_count=200, **sizes), device=device)


@pytest.fixture(params=[(333, 33), (77, 101), (500, 64)], ids=("33px", "101px", "64px"))
def worlds(request, dtype, device):
    task = task_of(*request.param, device)
    random = WorldRandom(range(5), device=device)
    x, s, *_ = task.seed(5, generator=random, device=device)
    x = 3.0 * x + 0.2 * random.normal(*x.shape[1:])
    s = s + 0.3 * random.normal(*s.shape[1:])
    return task, x.to(dtype), s.to(dtype)


def test_losses_are_the_same_with_and_without_gradient(worlds, dtype):
    task, x, s = worlds
    losses = task.splat_losses(x, s)
    x, s = x.clone().requires_grad_(), s.clone().requires_grad_()
    for value, expected in zip(losses, task.splat_losses(x, s), strict=True):
        assert expected.requires_grad
        assert not value.requires_grad
        assert value.dtype == dtype
        assert float(expected.detach().min()) > 1e-3
        torch.testing.assert_close(value, expected.detach(), rtol=ERRORS[dtype], atol=0.0)
    with torch.no_grad():
        assert_same(task.splat_losses(x, s), losses)


def test_nothing_depends_on_the_run_the_batch_or_the_memory(worlds):
    task, x, s = worlds
    functions = (task.splat_losses, task.splat_errors, task.picture, task.metric)
    for function in functions:
        together = function(x, s)
        assert_same(function(x, s), together)
        assert_same(function(x.mT.contiguous().mT, s.mT.contiguous().mT), together)
        for world in range(5):
            alone = function(x[world : world + 1].clone(), s[world : world + 1].clone())
            for value, expected in zip(tensors(alone), tensors(together), strict=True):
                assert torch.equal(value[0], expected[world])


def test_errors_are_what_their_formula_says_and_losses_are_their_means(worlds):
    task, x, s = worlds
    difference = (task.picture(x, s) - task.target_picture.to(x)).double()
    growth = difference.abs() + difference**2
    density, colour = task.splat_errors(x, s)
    expected = growth[..., :3].mean(dim=-1) * torch.exp(-growth[..., 3])
    torch.testing.assert_close(density.double(), growth[..., 3], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(colour.double(), expected, rtol=1e-5, atol=1e-9)
    for loss, errors in zip(task.splat_losses(x, s), (density, colour), strict=True):
        assert errors.shape == (5, task.config.resolution, task.config.resolution)
        torch.testing.assert_close(loss, errors.mean(dim=(1, 2)))


def test_a_centred_picture_has_the_targets_mean(worlds):
    task, x, s = worlds
    moved = task.picture(x + 0.25, s)
    torch.testing.assert_close(moved, task.picture(x, s), rtol=0.0, atol=2e-3)


def test_a_world_that_is_not_finite_leaves_the_others_alone(worlds):
    task, x, s = worlds
    losses = task.splat_losses(x, s)
    x = x.clone()
    x[2, 3] = torch.nan
    others = [0, 1, 3, 4]
    for value, expected in zip(task.splat_losses(x, s), losses, strict=True):
        assert torch.equal(value[others], expected[others])
        assert bool(torch.isfinite(value).all())


def test_a_target_drawn_from_itself_has_no_error(device):
    task = Morphogenesis2D(Morphogenesis2DConfig(target_point_count=200), device=device)
    colours = task.target.colours[None] - 0.5
    density, colour = task.splat_losses(task.target.points[None], colours)
    assert float(density) < 1e-5
    assert float(colour) < 1e-5
