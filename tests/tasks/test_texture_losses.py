"""Texture losses: plain arithmetic, what they ignore and distinguish, VGG16 of random weights."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.tasks.losses.texture import (
    MATCHED_PATCH,
    TEXTURE_LOSSES,
    VARIANCE_FLOOR,
    WEIGHTS_FILE,
    LossOptions,
    VGGTransport,
    in_order,
    load_vgg_weights,
    make_texture_loss,
    moment_distance,
    pyramid,
    quantiles,
    relaxed_transport,
)
from npa_envs.tasks.targets.textures import load_texture
from npa_envs.tasks.texture import Texture, TextureConfig
from npa_envs.world.particles import Particles

JOINT = tuple(name for name, entry in TEXTURE_LOSSES.items() if entry.joint)
SLICED = "patch_swd"
VGG = "vgg_ot"
WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of VGG16's convolutions; a pooling layer follows each group."""
SMALL = TextureConfig(target="hearts", particle_count=300, resolution=24, hidden_dim=8, eps=0.3)


@pytest.fixture(scope="module")
def vgg16():
    """Return VGG16 as torchvision builds it, with average pooling and random weights."""
    layers, channels = [], 3
    torch.manual_seed(0)
    for group in WIDTHS:
        for width in group:
            layer = torch.nn.Conv2d(channels, width, 3, padding=1, padding_mode="circular")
            torch.nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            layers += [layer, torch.nn.ReLU()]
            channels = width
        layers.append(torch.nn.AvgPool2d(2))
    return torch.nn.Sequential(*layers).requires_grad_(False)


@pytest.fixture(scope="module")
def vgg_weights(vgg16):
    return {f"features.{name}": weight for name, weight in vgg16.state_dict().items()}


@pytest.fixture(scope="module")
def vgg_file(vgg_weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("vgg") / "weights.pth"
    torch.save(vgg_weights, path)
    return str(path)


@pytest.fixture
def make_loss(request):
    """`make_texture_loss`, which finds VGG's weights."""

    def make(name, target, **options):
        if name == VGG:
            options["vgg_weights"] = request.getfixturevalue("vgg_file")
        return make_texture_loss(name, target, LossOptions(**options))

    return make


def texture(name, resolution=32, dtype=torch.float32, density=False):
    picture = load_texture(name, resolution=resolution).picture.movedim(-1, 0).to(dtype)
    return picture[3:] if density else picture[:3]


def drawable(name, resolution=48, dtype=torch.float64):
    """Return a texture as sharp as particles can draw it: colours and density."""
    task = Texture(TextureConfig(target=name, particle_count=1024, resolution=resolution))
    return task.joint_image(task.drawable.movedim(-1, 0)).to(dtype)


def target_of(loss, name, resolution, dtype=torch.float64):
    return (drawable if loss in JOINT else texture)(name, resolution, dtype)


def noise(*shape, dtype=torch.float64, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def rolled_patches(image, size):
    """Return all patches of a periodic image as rows: channel, then row, then column."""
    reach = size // 2
    shifts = [(r, c) for r in range(-reach, reach + 1) for c in range(-reach, reach + 1)]
    columns = [
        np.roll(channel, (-r, -c), axis=(0, 1)).ravel() for channel in image for r, c in shifts
    ]
    return np.stack(columns, axis=1)


def halves(image, count):
    images = [image]
    while len(images) < count:
        channels, side, _ = images[-1].shape
        images.append(images[-1].reshape(channels, side // 2, 2, side // 2, 2).mean(axis=(2, 4)))
    return images


def plain_distance(tables, expected_tables):
    """Return the sum over sizes of mean squared differences of sorted columns over the variance."""
    total = 0.0
    for actual, expected in zip(tables, expected_tables, strict=True):
        difference = np.sort(actual, axis=0) - np.sort(expected, axis=0)
        scale = expected.var(axis=0, ddof=1).mean() + VARIANCE_FLOOR
        total += (difference**2).mean() / scale
    return total


@pytest.mark.parametrize("channels", [1, 3])
def test_patch_distance_equals_plain_arithmetic(channels):
    target = texture("dots", 48, torch.float64)[:channels]
    image = noise(channels, 48, 48)
    loss = make_texture_loss("patch_swd", target, LossOptions(seed=5))
    directions = [d.numpy() for d in loss.bases]
    assert len(directions) == 3
    for d in directions:
        np.testing.assert_allclose(d.T @ d, np.eye(25 * channels), rtol=0.0, atol=1e-12)
    tables = [
        [
            rolled_patches(level, 5) @ d
            for level, d in zip(halves(i.numpy(), 3), directions, strict=True)
        ]
        for i in (image, target)
    ]
    assert float(loss(image[None])) == pytest.approx(plain_distance(*tables), rel=1e-12)


def test_patch_transport_equals_plain_arithmetic():
    target, image = drawable("hearts", 24), noise(4, 24, 24)
    total = 0.0
    for actual, expected in zip(pyramid(image[None], 2), pyramid(target[None], 2), strict=True):
        ours, theirs = (rolled_patches(p[0].numpy(), MATCHED_PATCH) for p in (actual, expected))
        costs = ((ours[:, None] - theirs[None]) ** 2).mean(axis=2)
        spread = theirs.var(axis=0).mean() + VARIANCE_FLOOR
        total += max(costs.min(axis=1).mean(), costs.min(axis=0).mean()) / spread
    loss = make_texture_loss("patch_ot", target)
    assert float(loss(image[None])) == pytest.approx(total / 2, rel=1e-10)
    # Here one of both is larger, there the other one.
    flat = target.mean(dim=(1, 2), keepdim=True).expand(-1, 24, 24)
    assert float(loss(flat[None])) > 0.3


@pytest.mark.parametrize(
    ("name", "density"),
    [
        *((name, False) for name in (*JOINT, SLICED, VGG)),
        *((name, True) for name in (SLICED, VGG)),
    ],
)
def test_a_texture_is_like_itself_wherever_it_lies(name, density, make_loss):
    target = target_of(name, "bubbles", 32)
    if density:
        target = texture("bubbles", 32, torch.float64, density=True)
    if name == VGG:
        target = target.float()
    loss = make_loss(name, target)
    away = float(loss(noise(*target.shape, dtype=target.dtype)[None]))
    # Smaller sizes are means of two by two pixels; VGG's deepest layer has places of 16 pixels.
    shift = (8, -16) if name in JOINT else (16, 16) if name == VGG else (4, -8)
    images = torch.stack([target, target.roll(shift, (1, 2)), target.roll(16, 1)])
    bound = 1e-6 * away if name in JOINT else 1e-4 if name == VGG else 1e-25
    assert float(loss(images).abs().max()) < bound
    assert away > (0.05 if name in JOINT else 0.1)


@pytest.mark.parametrize("name", [*JOINT, SLICED, VGG])
def test_loss_falls_as_a_picture_comes_nearer_and_tells_others_apart(name, make_loss):
    target = target_of(name, "hearts" if name in JOINT else "cells", 48)
    loss = make_loss(name, target)
    weight = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)[:, None, None, None]
    values = loss(weight * target + (1.0 - weight) * noise(*target.shape))
    assert (values.diff() < 0.0).all(), values
    # Shuffled pixels have the target's colours, but not its structure.
    order = torch.randperm(48 * 48, generator=torch.Generator().manual_seed(0))
    shuffled = target.flatten(1)[:, order].reshape_as(target)
    if name in JOINT:
        flat = target.mean(dim=(1, 2), keepdim=True).expand_as(target)
        for other in (shuffled, target.flip(1), flat, drawable("stars", 48)):
            assert float(loss(other[None])) > 4.0 * float(values[-1].abs()) + 1e-3
    else:
        assert abs(float(values[-1])) < (1e-4 if name == VGG else 1e-10)
        for other in (shuffled, texture("stripes", 48, torch.float64)):
            assert float(loss(other[None])) > 0.2


@pytest.mark.parametrize(
    ("name", "resolution"),
    [
        *((name, side) for name in (*JOINT, SLICED) for side in (13, 24)),
        (SLICED, 128),
        (VGG, 48),
    ],
)
def test_losses_do_not_depend_on_the_batch_and_on_nothing_random(
    name, resolution, device, make_loss
):
    target = target_of(name, "cells", resolution, torch.float32).to(device)
    images = noise(3, *target.shape, dtype=torch.float32).to(device)
    values = make_loss(name, target, seed=4)(images)
    again = make_loss(name, target, seed=4)
    assert torch.equal(values, again(images))
    for k in range(3):
        assert torch.equal(values[k : k + 1], again(images[k : k + 1]))
    batched = again(images.clone().requires_grad_()).detach()
    torch.testing.assert_close(batched, values, rtol=1e-4, atol=1e-6)
    if name == SLICED:
        other = make_loss(name, target, seed=5)(images)
        assert not torch.equal(values, other)
        torch.testing.assert_close(values, other, rtol=0.2, atol=0.0)


def test_a_thinned_out_fine_size_is_like_the_whole():
    target = texture("bubbles", 128)
    loss = make_texture_loss(SLICED, target)
    whole = float(loss(noise(*target.shape, dtype=torch.float32)[None]))
    # 2e-3 and 5e-3 of it were seen.
    assert float(loss(target[None])) < 0.02 * whole


def test_nothing_is_read_across_the_edges_of_a_target_that_does_not_tile():
    image = noise(3, 16, 16)
    loss = make_texture_loss(SLICED, image)
    (actual,) = loss.coordinates(image[None], wrap=False, thinned=False)
    every = rolled_patches(image.numpy(), 5) @ loss.bases[0].numpy()
    inside = every.reshape(16, 16, -1)[2:-2, 2:-2].reshape(144, -1)
    np.testing.assert_allclose(actual[0].numpy(), inside, rtol=0.0, atol=1e-14)


def test_values_without_a_gradient_are_in_the_order_that_torch_gives_them():
    generator = torch.Generator().manual_seed(0)
    for count in (1, 2, 31, 1024, 4095):
        values = torch.randn(count, 3, generator=generator).T
        values[1] = (2.0 * values[1]).round()
        values[2, : count // 2] = torch.nan
        before = values.clone()
        found, expected = in_order(values), before.clone().requires_grad_().sort().values
        same = {"rtol": 0.0, "atol": 0.0, "equal_nan": True}
        torch.testing.assert_close(found, expected.detach(), **same)
        # The argument is not changed.
        torch.testing.assert_close(values, before, **same)


def test_quantiles_resolve_a_distribution_as_finely_as_asked_for():
    values = torch.tensor([[4.0, 1.0, 3.0, 2.0]], dtype=torch.float64)
    assert torch.equal(quantiles(values, 4), torch.tensor([[1.0, 2.0, 3.0, 4.0]]).double())
    torch.testing.assert_close(quantiles(values, 2), torch.tensor([[1.5, 3.5]]).double())
    torch.testing.assert_close(
        quantiles(values, 8),
        torch.tensor([[1.0, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 4.0]]).double(),
    )


@pytest.mark.parametrize("name", JOINT)
def test_grey_starts_and_empty_places_have_finite_slopes(name):
    for fields in ({}, {"colour_weight": 0.0, "density_weight": 0.0}):
        task = Texture(replace(SMALL, loss=name, **fields))
        x, s, *_ = task.seed(2, generator=torch.Generator().manual_seed(0))
        for positions in (x, torch.zeros_like(x)):
            leaves = positions.clone().requires_grad_(), s.clone().requires_grad_()
            loss, _ = task.loss(Particles(*leaves, torch.zeros(x.shape[:2])))
            slopes = torch.autograd.grad(loss, leaves)
            assert all(torch.isfinite(value).all() for value in (loss, *slopes))
            assert (float(slopes[1].abs().max()) > 0.0) == (not fields)


@pytest.mark.parametrize("name", [*JOINT, VGG])
def test_worlds_may_be_of_another_precision_than_the_target(name, make_loss):
    target = target_of(name, "hearts", 32, torch.float32)
    images = noise(2, *target.shape).requires_grad_()
    loss = make_loss(name, target)
    values = loss(images)
    (slopes,) = torch.autograd.grad(values.sum(), images)
    assert values.dtype == torch.float64
    # Worst error measured: 4e-7.
    torch.testing.assert_close(loss(images.float()).double(), values, rtol=1e-5, atol=0.0)
    assert torch.isfinite(slopes).all()


@pytest.mark.parametrize("name", JOINT)
def test_slopes_of_pictures_without_structure_are_finite(name):
    empty, full = torch.zeros(1, 4, 24, 24), noise(1, 4, 24, 24).float()
    grey = torch.full_like(empty, 0.5)
    values = []
    for target, image in (
        (drawable("stripes", 24).float(), grey),
        *((empty[0], image) for image in (empty, full, 100.0 * full)),
    ):
        image = image.clone().requires_grad_()
        value = make_texture_loss(name, target)(image)
        (slope,) = torch.autograd.grad(value.sum(), image)
        assert torch.isfinite(value).all()
        # What optimisers normalise by.
        assert torch.isfinite(slope.norm())
        values.append(float(value.detach()))
    assert values[2] > values[1] >= 0.0


@pytest.mark.parametrize("name", JOINT)
def test_joint_losses_weigh_colours_and_density(name):
    x, s, *_ = Texture(SMALL).seed(1, generator=torch.Generator().manual_seed(1))
    s[..., -3:] = 0.4 * torch.sin(9.0 * x[..., :1] + torch.tensor([0.0, 1.0, 2.0]))
    task = Texture(replace(SMALL, loss=name))
    colour, density = task.texture_losses(x, s)
    assert float(density) == 0.0
    assert torch.equal(task.metric(x, s), colour)
    # Right colours, but twice as dense: only the density tells, and only as much as it weighs.
    drawing = task.drawing(3)
    image = task.joint_image(drawing.movedim(-1, 1))
    light = Texture(replace(SMALL, loss=name, colour_weight=4.0, density_weight=1e-12))
    dense = light.joint_image(2.0 * drawing.movedim(-1, 1))
    assert float(dense[:, 3].max()) < 1e-5
    twice = light.joint_image(drawing.movedim(-1, 1))[:, :3]
    torch.testing.assert_close(twice, 2.0 * image[:, :3])
    worse, right = (task.compare_pictures(factor * drawing)[0] for factor in (2.0, 1.0))
    assert float(worse) > float(right)


def test_a_joint_target_is_what_particles_can_draw():
    task = Texture(replace(SMALL, particle_count=1024, resolution=64))
    assert task.drawing(0).shape == (1, 64, 64, 4)
    torch.testing.assert_close(
        task.drawable.mean((0, 1)), task.target_picture.mean((0, 1)), rtol=0.03, atol=0.003
    )
    # Edges are as soft as splats: 0.047 was seen.
    assert 0.01 < float((task.drawable - task.target_picture).abs().mean()) < 0.1
    assert torch.equal(task.drawing(4), task.drawing(4))
    assert not torch.equal(task.drawing(4), task.drawing(5))


def test_names_joined_by_a_plus_are_summed():
    target = drawable("bubbles", 24)
    images = noise(2, *target.shape)
    parts = [make_texture_loss(name, target)(images) for name in ("patch_ot", "joint_swd")]
    together = make_texture_loss("patch_ot+joint_swd", target)(images)
    torch.testing.assert_close(together, parts[0] + parts[1], rtol=1e-12, atol=0.0)


def test_features_are_those_of_the_layers_as_torchvision_counts_them(vgg16, vgg_file):
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    expected = []
    mean, deviation = torch.tensor([(0.485, 0.456, 0.406), (0.229, 0.224, 0.225)])
    field = (images - mean[:, None, None]) / deviation[:, None, None]
    for number, layer in enumerate(vgg16):
        field = layer(field)
        if number in (1, 6, 11, 18, 25):
            expected.append(field.flatten(2).mT)
    features = VGGTransport(images[0], LossOptions(vgg_weights=vgg_file)).features
    actual = features(images, wrap=True)
    shapes = [tuple(f.shape[1:]) for f in actual]
    assert shapes == [(1024, 64), (256, 128), (64, 256), (16, 512), (4, 512)]
    for a, b in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
    # A density stands for all three colours.
    density = images[:, :1]
    grey = features(density.expand(2, 3, 32, 32), wrap=True)[0]
    assert torch.equal(features(density, wrap=True)[0], grey)


def test_transport_and_moments_equal_plain_arithmetic():
    generator = torch.Generator().manual_seed(3)
    a = torch.randn(1, 7, 4, generator=generator, dtype=torch.float64)
    b = torch.randn(1, 9, 4, generator=generator, dtype=torch.float64)
    cost = [[1.0 - float(u @ v / (u.norm() * v.norm())) for v in b[0]] for u in a[0]]
    there = sum(min(row) for row in cost) / 7
    back = sum(min(column) for column in zip(*cost, strict=True)) / 9
    assert float(relaxed_transport(a, b)) == pytest.approx(max(there, back), rel=1e-9)
    means = (a[0].mean(0) - b[0].mean(0)).abs().mean()
    covariances = (torch.cov(a[0].T) - torch.cov(b[0].T)).abs().mean()
    assert float(moment_distance(a, b)) == pytest.approx(float(means + covariances), rel=1e-12)


def test_gradients_of_vgg_lower_the_loss(make_loss):
    loss = make_loss(VGG, texture("cells"))
    image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1)).requires_grad_()
    value = loss(image)
    (gradient,) = torch.autograd.grad(value.sum(), image)
    assert torch.isfinite(gradient).all()
    with torch.no_grad():
        step = 1e-3 * float(value) / float(gradient.square().sum())
        lower = loss(image - step * gradient)
    assert float(lower) < float(value.detach())
    assert float(lower) == pytest.approx(float(value.detach()) * (1.0 - 1e-3), rel=3e-4)


def test_vgg_sees_no_seam_of_a_target_that_does_not_tile(make_loss):
    density = texture("dots", density=True)
    assert float(make_loss(VGG, density, tiles=False)(density[None])) > 1e-3


def test_weights_are_looked_for_in_the_folder_of_downloads(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    path = tmp_path / "checkpoints" / WEIGHTS_FILE
    with pytest.raises(NPAError) as caught:
        make_texture_loss(VGG, texture("cells"))
    for part in (
        str(path),
        f"https://download.pytorch.org/models/{WEIGHTS_FILE}",
        "torch.hub.load_state_dict_from_url",
        "vgg_weights",
        "loss='patch_swd'",
    ):
        assert part in str(caught.value)
    path.parent.mkdir()
    torch.save({"features.0.bias": torch.ones(64)}, path)
    assert torch.equal(load_vgg_weights()["features.0.bias"], torch.ones(64))


def test_damaged_and_foreign_weights_are_refused(tmp_path, vgg_weights):
    path = tmp_path / "bad.pth"
    short = {name: weight for name, weight in vgg_weights.items() if name != "features.7.weight"}
    for content, message in (
        (None, "damaged or no torch file"),
        ([1, 2], "must be a state dict, got list"),
        (short, "must hold features.7.weight"),
    ):
        torch.save(content, path) if content else path.write_bytes(b"no weights")
        with pytest.raises(NPAError, match=message):
            make_texture_loss(VGG, texture("cells"), LossOptions(vgg_weights=str(path)))
