"""The paper's texture loss, with a VGG16 of random weights."""

import math

import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.tasks.losses.pieces import moment_distance, relaxed_transport
from npa_envs.tasks.losses.texture import (
    WEIGHTS_FILE,
    LossOptions,
    VGGFeatures,
    load_vgg_weights,
    make_texture_loss,
)
from npa_envs.tasks.targets.textures import load_texture

WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of VGG16's convolutions; a pooling layer follows each group."""


@pytest.fixture(scope="module")
def weights():
    generator = torch.Generator().manual_seed(0)
    weights, index, channels = {}, 0, 3
    for group in WIDTHS:
        for width in group:
            scale = math.sqrt(2.0 / (9 * channels))
            shape = (width, channels, 3, 3)
            weights[f"features.{index}.weight"] = scale * torch.randn(shape, generator=generator)
            weights[f"features.{index}.bias"] = 0.1 * torch.randn(width, generator=generator)
            index, channels = index + 2, width
        index += 1
    return weights


@pytest.fixture(scope="module")
def options(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("vgg") / "weights.pth"
    torch.save(weights, path)
    return LossOptions(vgg_weights=str(path))


def colours(name, resolution=32):
    return load_texture(name, resolution=resolution).picture.movedim(-1, 0)[:3]


def plain_vgg16(weights):
    """The network as torchvision builds it, with average pooling."""
    layers = []
    for group in WIDTHS:
        for width in group:
            weight = weights[f"features.{len(layers)}.weight"]
            layer = torch.nn.Conv2d(weight.shape[1], width, 3, padding=1, padding_mode="circular")
            layer.weight.data, layer.bias.data = weight, weights[f"features.{len(layers)}.bias"]
            layers += [layer, torch.nn.ReLU()]
        layers.append(torch.nn.AvgPool2d(2))
    return layers


def test_features_are_those_of_the_layers_as_torchvision_counts_them(weights, options):
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    expected = []
    mean, deviation = torch.tensor([(0.485, 0.456, 0.406), (0.229, 0.224, 0.225)])
    field = (images - mean[:, None, None]) / deviation[:, None, None]
    with torch.no_grad():
        for number, layer in enumerate(plain_vgg16(weights)):
            field = layer(field)
            if number in (1, 6, 11, 18, 25):
                expected.append(field.flatten(2).mT)
    features = VGGFeatures(images[0], options)
    found = features(images, wrap=True)
    shapes = [tuple(f.shape[1:]) for f in found]
    assert shapes == [(1024, 64), (256, 128), (64, 256), (16, 512), (4, 512)]
    for a, b in zip(found, expected, strict=True):
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
    # The order of places does not matter.
    shuffled = a[:, torch.randperm(7, generator=generator)]
    assert float(relaxed_transport(shuffled, a)) < 1e-9
    assert float(moment_distance(shuffled, a)) < 1e-14


def test_loss_sees_a_texture_wherever_it_lies_and_tells_others_apart(options):
    target = colours("cells")
    loss = make_texture_loss("vgg_ot", target, options)
    near = 0.5 * target + 0.5 * colours("stripes")
    # Rolled by the size of a place of the deepest layer.
    images = torch.stack([target, target.roll((16, 16), dims=(1, 2)), near, colours("stripes")])
    same, rolled, nearer, other = loss(images).tolist()
    # 8e-8 was seen, and 1.3 and 2.1.
    assert abs(same) < 1e-4
    assert abs(rolled) < 1e-4
    assert 0.1 < nearer < other


def test_gradients_flow_and_lower_the_loss(options):
    loss = make_texture_loss("vgg_ot", colours("cells"), options)
    image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1)).requires_grad_()
    value = loss(image)
    (gradient,) = torch.autograd.grad(value.sum(), image)
    assert torch.isfinite(gradient).all()
    with torch.no_grad():
        step = 1e-3 * float(value) / float(gradient.square().sum())
        lower = loss(image - step * gradient)
    assert float(lower) < float(value.detach())
    assert float(lower) == pytest.approx(float(value.detach()) * (1.0 - 1e-3), rel=3e-4)


def test_without_gradient_no_image_depends_on_the_others(options):
    images = torch.rand(3, 3, 48, 48, generator=torch.Generator().manual_seed(1))
    loss = make_texture_loss("vgg_ot", colours("cells", 48), options)
    values = loss(images)
    for k in range(3):
        assert torch.equal(loss(images[k : k + 1]), values[k : k + 1])
    with_gradient = loss(images.clone().requires_grad_())
    torch.testing.assert_close(with_gradient.detach(), values, rtol=1e-4, atol=1e-5)
    # Worlds of double precision are compared too.
    double = loss(images.double())
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), values)


def test_densities_and_targets_that_do_not_tile_are_compared_too(options):
    density = load_texture("dots", resolution=32).picture.movedim(-1, 0)[3:]
    loss = make_texture_loss("vgg_ot", density, options)
    assert float(loss(density[None])) < 1e-4 < float(loss(torch.ones(1, 1, 32, 32)))
    edges = LossOptions(tiles=False, vgg_weights=options.vgg_weights)
    edged = make_texture_loss("vgg_ot", density, edges)
    assert float(edged(density[None])) > 1e-3


def test_weights_are_looked_for_in_the_folder_of_downloads(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    path = tmp_path / "checkpoints" / WEIGHTS_FILE
    with pytest.raises(NPAError) as caught:
        make_texture_loss("vgg_ot", colours("cells"))
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


def test_damaged_and_foreign_weights_are_refused(tmp_path, weights):
    path = tmp_path / "bad.pth"
    short = {name: weight for name, weight in weights.items() if name != "features.7.weight"}
    for content, message in (
        (None, "damaged or no torch file"),
        ([1, 2], "must be a state dict, got list"),
        (short, "must hold features.7.weight"),
    ):
        torch.save(content, path) if content else path.write_bytes(b"no weights")
        with pytest.raises(NPAError, match=message):
            make_texture_loss("vgg_ot", colours("cells"), LossOptions(vgg_weights=str(path)))
