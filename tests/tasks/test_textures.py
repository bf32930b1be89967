"""Built-in textures and those from pictures."""

import numpy as np
import pytest
import torch
from PIL import Image

from npa_envs.errors import NPAError
from npa_envs.tasks.targets.textures import PATTERNS, TextureTarget, draw_pattern, load_texture


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_have_no_seam_and_are_the_same_at_every_resolution(name):
    picture = draw_pattern(name, 96)
    for dim in (0, 1):
        steps = np.abs(picture - np.roll(picture, 1, axis=dim)).mean(axis=(1 - dim, 2))
        assert steps[1:].mean() > 0.005
        assert steps[0] < 1.05 * steps[1:].max()
    coarse = picture.reshape(24, 4, 24, 4, 4).mean(axis=(1, 3))
    # The samples of both lie elsewhere: 0.031 was the largest mean difference seen.
    assert np.abs(coarse - draw_pattern(name, 24)).mean() < 0.05
    assert np.abs(coarse - coarse.mean(axis=(0, 1))).mean() > 0.1


@pytest.mark.parametrize(
    ("name", "scattered"), [("cells", True), ("bubbles", True), ("maze", True), ("grid", False)]
)
def test_seeds_move_what_is_scattered(name, scattered):
    one, again, other = (draw_pattern(name, 16, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(one, other) is not scattered
    assert np.array_equal(one, again)


@pytest.mark.parametrize(
    ("name", "coverage"),
    [("cells", 1.0), ("stripes", 1.0), ("dots", 16 * np.pi * 0.09**2), ("grid", 1 - 0.46**2)],
)
def test_coverage_is_what_the_geometry_says(name, coverage):
    # Dots: 16 in the unit square; bands: 0.54 of a mesh in each direction.
    assert load_texture(name, resolution=96).coverage == pytest.approx(coverage, abs=0.01)


def test_targets_are_colour_sums_and_density():
    target = load_texture("bubbles", resolution=48)
    picture = target.picture
    assert target.tiles
    assert picture.shape == (48, 48, 4)
    assert picture.dtype == torch.float32
    assert (picture[..., :3] <= picture[..., 3:] + 1e-6).all()
    assert float(picture.min()) == 0.0
    assert float(picture[..., 3].max()) == 1.0
    covered = picture[..., 3].double() / picture[..., 3].double().sum()
    colour = picture[..., :3].double() / picture[..., 3:].double().clamp_min(1e-9)
    expected = (colour * covered[..., None]).sum((0, 1)).float()
    torch.testing.assert_close(target.mean_colour, expected)


def test_a_picture_is_cropped_scaled_and_turned_upright(tmp_path):
    image = Image.new("RGB", (60, 40), "white")
    image.paste((255, 0, 0), (10, 0, 50, 20))
    image.save(tmp_path / "flag.png")
    target = load_texture(str(tmp_path / "flag.png"), resolution=20)
    assert (target.name, target.tiles, target.coverage) == ("flag", False, 1.0)
    # The upper half of the picture is the upper half of y, which are the last rows.
    assert (target.picture[10:, :, :3] == torch.tensor([1.0, 0.0, 0.0])).all()
    assert (target.picture[:10, :, :3] == 1.0).all()
    assert load_texture(tmp_path / "flag.png", tiles=True).tiles


def test_transparency_is_the_density_and_colours_do_not_leak(tmp_path):
    pixels = np.zeros((32, 32, 4), dtype=np.uint8)
    pixels[..., 1] = 255
    pixels[:, 16:] = (255, 0, 0, 255)
    Image.fromarray(pixels).save(tmp_path / "half.png")
    target = load_texture(tmp_path / "half.png", resolution=8)
    assert target.coverage == 0.5
    assert float(target.picture[..., 1].max()) == 0.0


def test_a_picture_of_one_column_is_refused(tmp_path):
    Image.new("RGB", (1, 9)).save(tmp_path / "thin.png")
    with pytest.raises(NPAError, match="at least 2 x 2 pixels"):
        load_texture(tmp_path / "thin.png")


def test_gap_is_the_way_between_neighbouring_things():
    # Dots of radius 0.09, a quarter of the side apart.
    assert load_texture("dots", resolution=64).gap == pytest.approx(0.25 - 2 * 0.09, abs=1 / 64)
    assert load_texture("stripes", resolution=32).gap == 0.0
    # It reaches round the edges.
    picture = torch.zeros(16, 16, 4)
    picture[4:8, 0:2, 3] = 1.0
    assert TextureTarget("one", picture, True).gap == 0.0
    # Three empty columns lie between both round the edge, nine the other way.
    picture[4:8, 11:13, 3] = 1.0
    assert TextureTarget("two", picture, True).gap == 3 / 16
    # Touching round the edge, both are one thing.
    picture[4:8, 13:, 3] = 1.0
    assert TextureTarget("joined", picture, True).gap == 0.0
