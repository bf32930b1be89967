"""Losses that see shapes: against plain arithmetic, what they ignore, what they see."""

import dataclasses

import numpy as np
import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.tasks.losses.pieces import (
    EVEN,
    MATCHED_PATCH,
    PatchTransport,
    RandomFilters,
    pyramid,
)
from npa_envs.tasks.losses.texture import TEXTURE_LOSSES, make_texture_loss
from npa_envs.tasks.texture import Texture, TextureConfig

JOINT = tuple(name for name, entry in TEXTURE_LOSSES.items() if entry.joint)
SMALL = TextureConfig(target="hearts", particle_count=300, resolution=24, hidden_dim=8, eps=0.3)


def target_of(name, resolution=48, dtype=torch.float64):
    task = Texture(TextureConfig(target=name, particle_count=1024, resolution=resolution))
    return task.joint_image(task.drawable.movedim(-1, 0)).to(dtype)


def noise(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def test_patch_transport_equals_plain_arithmetic():
    target, image = target_of("hearts", 24), noise(4, 24, 24)
    total = 0.0
    levels = zip(pyramid(image[None], 2), pyramid(target[None], 2), strict=True)
    for found, expected in levels:
        reach = MATCHED_PATCH // 2
        tables = []
        for picture in (found[0].numpy(), expected[0].numpy()):
            shifts = [(r, c) for r in range(-reach, reach + 1) for c in range(-reach, reach + 1)]
            columns = [np.roll(ch, (-r, -c), (0, 1)).ravel() for ch in picture for r, c in shifts]
            tables.append(np.stack(columns, axis=1))
        costs = ((tables[0][:, None] - tables[1][None]) ** 2).mean(axis=2)
        spread = tables[1].var(axis=0).mean() + EVEN
        total += max(costs.min(axis=1).mean(), costs.min(axis=0).mean()) / spread
    loss = PatchTransport(target, tiles=True)(image[None])
    assert float(loss) == pytest.approx(total / 2, rel=1e-10)
    # Here one of both is larger, there the other one.
    flat = target.mean(dim=(1, 2), keepdim=True).expand(-1, 24, 24)
    assert float(PatchTransport(target, tiles=True)(flat[None])) > 0.3


def test_random_filters_answer_as_sums_over_patches_do():
    image = noise(2, 16, 16)
    filters = RandomFilters(image, seed=1)
    fields = filters(image[None], wrap=True)[0]
    kernel = torch.fft.irfft2(filters.filter_waves.conj(), s=(16, 16))[40]
    by_hand = sum(
        kernel[channel, r, c] * image[channel].roll((-r, -c), (0, 1))
        for channel in range(2)
        for r in range(16)
        for c in range(16)
    )
    torch.testing.assert_close(fields[2 + 40], by_hand.relu()[::2, ::2], rtol=1e-9, atol=1e-9)
    assert float(kernel.sum(dim=(1, 2)).abs().max()) < 1e-6


@pytest.mark.parametrize("name", JOINT)
def test_a_texture_is_like_itself_wherever_it_lies(name):
    target = target_of("bubbles", 32)
    loss = make_texture_loss(name, target)
    away = float(loss(noise(*target.shape)[None]))
    shifted = torch.stack([target, target.roll((8, -16), (1, 2)), target.roll(16, 1)])
    assert float(loss(shifted).abs().max()) < 1e-6 * away
    assert away > 0.05


@pytest.mark.parametrize("name", JOINT)
def test_loss_falls_as_a_picture_comes_nearer_and_tells_others_apart(name):
    target = target_of("hearts", 48)
    loss = make_texture_loss(name, target)
    share = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)[:, None, None, None]
    values = loss(share * target + (1.0 - share) * noise(*target.shape))
    assert (values.diff() < 0.0).all(), values
    order = torch.randperm(48 * 48, generator=torch.Generator().manual_seed(0))
    shuffled = target.flatten(1)[:, order].reshape_as(target)
    turned = target.flip(1)
    flat = target.mean(dim=(1, 2), keepdim=True).expand_as(target)
    for other in (shuffled, turned, flat, target_of("stars", 48)):
        assert float(loss(other[None])) > 4.0 * float(values[-1].abs()) + 1e-3


@pytest.mark.parametrize("name", JOINT)
def test_gradients_are_those_of_differences(name):
    target = target_of("droplets", 16)
    loss = make_texture_loss(name, target)
    image = noise(1, *target.shape).requires_grad_()
    (slope,) = torch.autograd.grad(loss(image).sum(), image)
    direction = noise(1, *target.shape, seed=2) - 0.5
    with torch.no_grad():
        ahead, behind = (float(loss(image + step * direction)) for step in (1e-6, -1e-6))
    assert float((slope * direction).sum()) == pytest.approx((ahead - behind) / 2e-6, rel=2e-4)


@pytest.mark.parametrize("name", JOINT)
def test_grey_starts_and_empty_places_have_finite_slopes(name):
    task = Texture(dataclasses.replace(SMALL, loss=name))
    x, s, _ = task.seed(2, generator=torch.Generator().manual_seed(0))
    for places in (x, torch.zeros_like(x)):
        x, s = places.clone().requires_grad_(), s.detach().clone().requires_grad_()
        loss, _ = task.loss(x, s, torch.zeros(x.shape[:2]))
        slopes = torch.autograd.grad(loss, (x, s))
        assert all(torch.isfinite(slope).all() for slope in slopes)
        assert float(slopes[1].abs().max()) > 0.0
    target = target_of("stripes", 24)
    grey = torch.full_like(target, 0.5)[None].requires_grad_()
    (slope,) = torch.autograd.grad(make_texture_loss(name, target)(grey).sum(), grey)
    assert torch.isfinite(slope).all()


@pytest.mark.parametrize("name", JOINT)
def test_worlds_may_be_of_another_precision_than_the_target(name):
    target, images = target_of("hearts", 24, torch.float32), noise(2, 4, 24, 24).requires_grad_()
    loss = make_texture_loss(name, target)
    values = loss(images)
    (slopes,) = torch.autograd.grad(values.sum(), images)
    assert values.dtype == torch.float64
    # Worst error measured: 4e-7.
    torch.testing.assert_close(loss(images.float()).double(), values, rtol=1e-5, atol=0.0)
    assert torch.isfinite(slopes).all()
    task = Texture(dataclasses.replace(SMALL, loss=name))
    x, s, _ = task.seed(1, generator=torch.Generator().manual_seed(0))
    found = task.metric(x.double(), s.double())
    torch.testing.assert_close(found, task.metric(x, s).double(), rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("name", JOINT)
def test_an_empty_target_can_be_compared_with(name):
    loss = make_texture_loss(name, torch.zeros(4, 24, 24))
    empty, full = torch.zeros(1, 4, 24, 24), noise(1, 4, 24, 24).float()
    for images in (empty, full, 100.0 * full):
        images.requires_grad_()
        value = loss(images)
        (slope,) = torch.autograd.grad(value.sum(), images)
        assert torch.isfinite(value).all()
        # What optimisers normalise by.
        assert torch.isfinite(slope.norm())
    assert float(loss(full).detach()) > float(loss(empty).detach()) >= 0.0
    weightless = Texture(
        dataclasses.replace(SMALL, loss=name, colour_weight=0.0, density_weight=0.0)
    )
    x, s, _ = weightless.seed(1, generator=torch.Generator().manual_seed(0))
    metric = weightless.metric(x.requires_grad_(), s)
    (slope,) = torch.autograd.grad(metric.sum(), x)
    assert torch.isfinite(metric).all()
    assert torch.isfinite(slope).all()


@pytest.mark.parametrize("name", JOINT)
@pytest.mark.parametrize("resolution", [13, 24])
def test_losses_do_not_depend_on_the_batch(name, resolution, device):
    target = target_of("cells", resolution, torch.float32).to(device)
    images = noise(3, *target.shape).float().to(device)
    loss = make_texture_loss(name, target)
    values = loss(images)
    assert torch.equal(values, make_texture_loss(name, target)(images))
    for k in range(3):
        assert torch.equal(values[k : k + 1], loss(images[k : k + 1]))
    with torch.enable_grad():
        batched = loss(images.requires_grad_()).detach()
    torch.testing.assert_close(batched, values, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", JOINT)
def test_joint_losses_weigh_colours_and_density(name):
    x, s, _ = Texture(SMALL).seed(1, generator=torch.Generator().manual_seed(1))
    s[..., -3:] = 0.4 * torch.sin(9.0 * x[..., :1] + torch.tensor([0.0, 1.0, 2.0]))
    task = Texture(dataclasses.replace(SMALL, loss=name))
    colour, density = task.texture_losses(x, s)
    assert float(density) == 0.0
    assert torch.equal(task.metric(x, s), colour)
    # Right colours, but twice as dense: only the density tells, and only as much as it weighs.
    image = task.joint_image(task.drawing(3).movedim(-1, 1))
    light = Texture(dataclasses.replace(SMALL, loss=name, colour_weight=4.0, density_weight=1e-12))
    dense = light.joint_image(2.0 * task.drawing(3).movedim(-1, 1))
    assert float(dense[:, 3].max()) < 1e-5
    torch.testing.assert_close(
        light.joint_image(task.drawing(3).movedim(-1, 1))[:, :3], 2.0 * image[:, :3]
    )
    worse = (
        task.compare_pictures(2.0 * task.drawing(3))[0] - task.compare_pictures(task.drawing(3))[0]
    )
    assert float(worse) > 0.0


def test_a_joint_target_is_what_particles_can_draw():
    task = Texture(dataclasses.replace(SMALL, particle_count=1024, resolution=64))
    assert task.drawing(0).shape == (1, 64, 64, 4)
    torch.testing.assert_close(
        task.drawable.mean((0, 1)), task.target_picture.mean((0, 1)), rtol=0.03, atol=0.003
    )
    # Edges are as soft as splats: 0.047 was seen.
    assert 0.01 < float((task.drawable - task.target_picture).abs().mean()) < 0.1
    assert torch.equal(task.drawing(4), task.drawing(4))
    assert not torch.equal(task.drawing(4), task.drawing(5))


@pytest.mark.parametrize("name", JOINT)
def test_targets_that_are_too_small_are_refused(name):
    with pytest.raises(NPAError, match="resolution must be at least 12"):
        make_texture_loss(name, noise(4, 10, 10))
    with pytest.raises(NPAError, match=r"images must have shape \[B, K, R, R\]"):
        make_texture_loss(name, noise(4, 16, 16))(noise(1, 3, 16, 16))
    with pytest.raises(NPAError, match=r"a tensor of shape \[K, R, R\], got ndarray"):
        make_texture_loss(name, np.zeros((4, 16, 16), np.float32))


def test_names_joined_by_a_plus_are_summed():
    target = target_of("bubbles", 24)
    images = noise(2, *target.shape)
    parts = [make_texture_loss(name, target)(images) for name in ("patch_ot", "filter_ot")]
    together = make_texture_loss("patch_ot+filter_ot", target)(images)
    torch.testing.assert_close(together, parts[0] + parts[1], rtol=1e-12, atol=0.0)
    for name, message in (
        ("patch_ot+filter_op", "did you mean 'filter_ot'"),
        ("patch_ot+patch_swd", "summed must be joint ones.*joint_swd"),
        ("patch_ot+", "must be a texture loss that exists"),
        (["patch_ot"], r"must be a texture loss that exists, got \['patch_ot'\]: known"),
    ):
        with pytest.raises(NPAError, match=message):
            TextureConfig(loss=name)
