"""Errors of a task's pictures: in one pass as by the differentiable path, alone as in a batch."""

import functools

import pytest
import torch
from support.worlds import assert_same, tensors

from npa_envs import WorldRandom
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig

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
