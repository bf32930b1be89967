"""Texture losses: what they are against plain arithmetic, what they ignore, what they see."""

import numpy as np
import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.tasks.losses.texture import (
    FILTERS,
    FLOOR,
    TEXTURE_LOSSES,
    FilterDescriptor,
    LossOptions,
    PatchDescriptor,
    SlicedWasserstein,
    make_texture_loss,
    quantiles,
)
from npa_envs.tasks.targets.textures import load_texture

SLICED = ("patch_swd", "filter_swd")


def texture(name, resolution=32, dtype=torch.float32, density=False):
    picture = load_texture(name, resolution=resolution).picture.movedim(-1, 0).to(dtype)
    return picture[3:] if density else picture[:3]


def noise(*shape, dtype=torch.float32, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def rolled_patches(image, size):
    """Every patch of a torus as a row, in NumPy: channel, then row, then column."""
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
    """The sum over sizes of the mean squared difference of sorted columns, over the variance."""
    total = 0.0
    for found, expected in zip(tables, expected_tables, strict=True):
        difference = np.sort(found, axis=0) - np.sort(expected, axis=0)
        scale = expected.var(axis=0, ddof=1).mean() + FLOOR
        total += (difference**2).mean() / scale
    return total


@pytest.mark.parametrize("channels", [1, 3])
def test_patch_distance_equals_plain_arithmetic(channels):
    target = texture("dots", 48, torch.float64)[:channels]
    image = noise(channels, 48, 48, dtype=torch.float64)
    descriptor = PatchDescriptor(target, seed=5)
    directions = [d.numpy() for d in descriptor.directions]
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
    loss = SlicedWasserstein(target, descriptor, tiles=True)(image[None])
    assert float(loss) == pytest.approx(plain_distance(*tables), rel=1e-12)


def test_filter_distance_equals_plain_arithmetic():
    target = texture("grid", 24, torch.float64)
    image = noise(3, 24, 24, dtype=torch.float64)
    descriptor = FilterDescriptor(target, seed=2)
    first, _ = descriptor.levels[0]
    torch.testing.assert_close(first.norm(dim=0), torch.ones(FILTERS).double())
    torch.testing.assert_close(first[:, 3:].sum(0), torch.zeros(FILTERS - 3).double())

    def tables(image):
        result = []
        for level, (first, second) in zip(halves(image, 2), descriptor.levels, strict=True):
            signed = rolled_patches(level, 5) @ first.numpy()
            features = np.maximum(np.concatenate([signed, -signed], axis=1), 0.0)
            side = level.shape[-1]
            field = features.T.reshape(-1, side, side)
            result += [features, rolled_patches(field, 3) @ second.numpy()]
        return result

    loss = SlicedWasserstein(target, descriptor, tiles=True)(image[None])
    expected = plain_distance(tables(image.numpy()), tables(target.numpy()))
    assert float(loss) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", SLICED)
@pytest.mark.parametrize("density", [False, True], ids=("colour", "density"))
def test_a_texture_is_like_itself_wherever_it_lies(name, density):
    target = texture("bubbles", 32, torch.float64, density)
    loss = make_texture_loss(name, target)
    # Even shifts: the smaller sizes are means of two by two pixels.
    images = torch.stack([target, target.roll((4, -8), dims=(1, 2)), target.roll(16, dims=1)])
    assert float(loss(images).abs().max()) < 1e-25
    assert float(loss(noise(*target.shape, dtype=torch.float64)[None])) > 0.1


@pytest.mark.parametrize("name", SLICED)
def test_loss_falls_as_a_picture_comes_nearer_and_tells_others_apart(name):
    target = texture("cells", 48)
    loss = make_texture_loss(name, target)
    share = torch.linspace(0.0, 1.0, 6)[:, None, None, None]
    values = loss(share * target + (1.0 - share) * noise(*target.shape))
    assert (values.diff() < 0.0).all(), values
    assert float(values[-1]) < 1e-10
    assert float(loss(texture("stripes", 48)[None])) > 0.2
    # Shuffled pixels have the target's colours, but not its structure.
    order = torch.randperm(48 * 48, generator=torch.Generator().manual_seed(0))
    shuffled = target.flatten(1)[:, order].reshape_as(target)
    assert float(loss(shuffled[None])) > 0.3


@pytest.mark.parametrize("name", SLICED)
@pytest.mark.parametrize("resolution", [13, 24, 128])
def test_losses_do_not_depend_on_the_batch_and_on_nothing_random(name, resolution):
    target = texture("cells", resolution)
    images = noise(3, *target.shape)
    values = make_texture_loss(name, target, LossOptions(seed=4))(images)
    again = make_texture_loss(name, target, LossOptions(seed=4))
    assert torch.equal(values, again(images))
    for k in range(3):
        assert torch.equal(values[k : k + 1], again(images[k : k + 1]))
    other = make_texture_loss(name, target, LossOptions(seed=5))(images)
    assert not torch.equal(values, other)
    torch.testing.assert_close(values, other, rtol=0.2, atol=0.0)


@pytest.mark.parametrize("name", SLICED)
def test_a_thinned_out_fine_size_is_like_the_whole(name):
    target = texture("bubbles", 128)
    loss = make_texture_loss(name, target)
    whole = float(loss(noise(*target.shape)[None]))
    # 2e-3 and 5e-3 of it were seen.
    assert float(loss(target[None])) < 0.02 * whole


def test_nothing_is_read_across_the_edges_of_a_target_that_does_not_tile():
    image = noise(3, 16, 16, dtype=torch.float64)
    descriptor = PatchDescriptor(image, seed=0)
    (found,) = descriptor(image[None], wrap=False, thinned=False)
    every = rolled_patches(image.numpy(), 5) @ descriptor.directions[0].numpy()
    inside = every.reshape(16, 16, -1)[2:-2, 2:-2].reshape(144, -1)
    np.testing.assert_allclose(found[0].numpy(), inside, rtol=0.0, atol=1e-14)

    edges = image.clone()
    edges[:, 0], edges[:, -1], edges[:, :, 0], edges[:, :, -1] = 9.0, 9.0, -9.0, -9.0
    filters = FilterDescriptor(image, seed=0)
    first, second = filters(image[None], wrap=False, thinned=False)
    changed, _ = filters(edges[None], wrap=False, thinned=False)
    assert (first.shape[1], second.shape[1]) == (144, 100)
    middle = np.arange(144).reshape(12, 12)[1:-1, 1:-1].ravel()
    assert torch.equal(first[0, middle], changed[0, middle])


def test_quantiles_resolve_a_distribution_as_finely_as_asked_for():
    values = torch.tensor([[4.0, 1.0, 3.0, 2.0]], dtype=torch.float64)
    assert torch.equal(quantiles(values, 4), torch.tensor([[1.0, 2.0, 3.0, 4.0]]).double())
    torch.testing.assert_close(quantiles(values, 2), torch.tensor([[1.5, 3.5]]).double())
    torch.testing.assert_close(
        quantiles(values, 8),
        torch.tensor([[1.0, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 4.0]]).double(),
    )


@pytest.mark.parametrize("name", SLICED)
def test_bad_shapes_and_names_are_refused(name):
    loss = make_texture_loss(name, texture("dots", 24))
    for images, message in (
        (noise(3, 24, 24), r"images must have shape \[B, K, R, R\]"),
        (noise(2, 3, 16, 16), "at the target's resolution"),
    ):
        with pytest.raises(NPAError, match=message):
            loss(images)
    for asked, target, message in (
        (name, noise(3, 10, 10), "resolution must be at least 12"),
        (name, noise(24, 24, 3), r"shape \[K, R, R\]"),
        ("patch_sdw", noise(3, 24, 24), "did you mean 'patch_swd'"),
    ):
        with pytest.raises(NPAError, match=message):
            make_texture_loss(asked, target)
    separate = {name for name, entry in TEXTURE_LOSSES.items() if not entry.joint}
    assert separate == {"vgg_ot", "patch_swd", "filter_swd"}
