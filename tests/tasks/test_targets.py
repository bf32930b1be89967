from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from npa_envs.errors import NPAError
from npa_envs.tasks.targets.points import (
    PointTarget,
    builtin_targets,
    load_target,
    target_from_image,
)

RED, GREEN, BLUE = (255, 0, 0), (0, 160, 0), (0, 0, 255)


@pytest.fixture(scope="module")
def builtins() -> dict[str, PointTarget]:
    return {name: load_target(name) for name in builtin_targets()}


def disk_picture(
    mode: str = "RGBA", background: object = (0, 0, 0, 0), side: int = 200
) -> Image.Image:
    image = Image.new(mode, (side, side), background)
    ImageDraw.Draw(image).ellipse((0.2 * side, 0.2 * side, 0.8 * side, 0.8 * side), fill=RED)
    return image


def raster(target: PointTarget) -> np.ndarray:
    """The target's pixels as a boolean grid, first row lowest, with a margin of one."""
    index = (
        (target.points - target.points.amin(dim=0)) / target.pixel_size
    ).round().long().numpy() + 1
    grid = np.zeros(index.max(axis=0)[::-1] + 2, dtype=bool)
    grid[index[:, 1], index[:, 0]] = True
    return grid


def spread(grid: np.ndarray) -> np.ndarray:
    wide = grid.copy()
    wide[1:] |= grid[:-1]
    wide[:-1] |= grid[1:]
    wide[:, 1:] |= grid[:, :-1]
    wide[:, :-1] |= grid[:, 1:]
    return wide


def test_the_promised_builtin_targets_exist():
    assert {"gecko", "heart", "letter-a", "ring", "butterfly"} <= set(builtin_targets())
    assert list(builtin_targets()) == sorted(builtin_targets())


@pytest.mark.parametrize("name", builtin_targets())
def test_builtin_target_lies_on_a_centred_grid_inside_its_extent(builtins, name):
    target = builtins[name]
    assert abs(target.point_count - 4096) <= 24
    assert target.points.mean(dim=0).abs().max() < 1e-5
    assert target.points.abs().max() + target.pixel_size / 2 == pytest.approx(0.9, abs=1e-5)
    steps = (target.points - target.points[0]).double() / target.pixel_size
    assert (steps - steps.round()).abs().max() < 1e-3
    assert len(torch.unique(steps.round(), dim=0)) == target.point_count


@pytest.mark.parametrize("name", builtin_targets())
def test_builtin_target_is_one_piece_with_parts_at_least_three_pixels_thick(builtins, name):
    grid = raster(builtins[name])
    opened = spread(~spread(~grid))
    assert (opened & grid).sum() >= 0.98 * grid.sum()
    seen = np.zeros_like(grid)
    seen[tuple(np.argwhere(grid)[0])] = True
    while (grown := spread(seen) & grid).sum() > seen.sum():
        seen = grown
    assert seen.sum() == grid.sum()


@pytest.mark.parametrize("name", builtin_targets())
def test_builtin_target_is_colourful(builtins, name):
    colours = builtins[name].colours
    assert colours.min() >= 0
    assert colours.max() <= 1
    saturation = colours.amax(dim=1) - colours.amin(dim=1)
    assert (saturation > 0.4).float().mean() > 0.5
    assert colours.std(dim=0).max() > 0.15


def test_gecko_has_four_feet_apart_from_its_body(builtins):
    x, y = builtins["gecko"].points.T
    head_y = y.max()
    for side_x, side_y in ((-1, 1), (1, 1), (-1, -1), (1, -1)):
        foot = (x * side_x > 0.3) & (y * side_y > 0.05) & (y < 0.9 * head_y)
        assert foot.sum() > 100


def test_flower_blooms_at_the_top(builtins):
    target = builtins["flower"]
    red, green, _ = target.colours.T
    y = target.points[:, 1]
    assert (red > green)[y > 0.2].float().mean() > 0.9
    assert (green > red)[y < -0.6].float().mean() > 0.9


def test_ring_runs_around_the_colour_wheel(builtins):
    target = builtins["ring"]
    radius = target.points.norm(dim=1)
    band = (radius > 0.7) & (radius < 0.82)
    angle = torch.atan2(target.points[band, 1], target.points[band, 0])
    for channel, peak in ((0, 0.0), (1, 2.0944), (2, -2.0944)):
        near = torch.cos(angle - peak) > 0.9
        assert target.colours[band][near, channel].min() > 0.9


@pytest.mark.parametrize("point_count", [64, 500, 1024, 4096, 16384])
def test_point_count_is_met_within_one_percent(point_count):
    target = target_from_image(disk_picture(), name="disk", point_count=point_count)
    assert abs(target.point_count - point_count) <= max(4, 0.01 * point_count)


def test_pixel_size_follows_from_the_extent():
    target = target_from_image(disk_picture(), name="disk", point_count=4096, extent=1.0)
    diameter = 2 * (4096 / np.pi) ** 0.5
    assert target.pixel_size == pytest.approx(1.0 / diameter, rel=0.02)
    wider = target_from_image(disk_picture(), name="disk", point_count=4096, extent=2.0)
    torch.testing.assert_close(wider.points, 2 * target.points)


def test_top_of_the_picture_has_high_y_and_its_left_low_x(tmp_path):
    image = Image.new("RGBA", (60, 60), RED)
    image.paste(BLUE, (0, 30, 60, 60))
    image.paste(GREEN, (0, 0, 30, 30))
    image.putpixel((59, 59), (0, 0, 0, 0))
    image.save(tmp_path / "corners.png")
    target = load_target(tmp_path / "corners.png", point_count=900)
    x, y = target.points.T
    for colour, chosen in ((0, (x > 0.1) & (y > 0.1)), (1, (x < -0.1) & (y > 0.1)), (2, y < -0.1)):
        assert (target.colours[chosen].argmax(dim=1) == colour).all()
    assert target.name == "corners"


def test_wide_picture_keeps_its_proportions():
    target = target_from_image(Image.new("RGBA", (300, 100), RED), name="bar", point_count=1200)
    width, height = (target.points.amax(dim=0) - target.points.amin(dim=0)) + target.pixel_size
    assert width / height == pytest.approx(3.0, rel=0.06)
    assert width == pytest.approx(1.8, abs=1e-4)


def test_unknown_name_suggests_the_nearest():
    with pytest.raises(NPAError, match=r"did you mean 'gecko'\?.*known: .*ring"):
        load_target("gekco")
    with pytest.raises(NPAError, match="built-in name"):
        load_target("")
    with pytest.raises(NPAError, match="string or a Path, got int"):
        load_target(7)


def test_a_path_object_is_never_a_builtin_name():
    with pytest.raises(NPAError, match="does not exist"):
        load_target(Path("gecko"))


def test_an_existing_file_without_suffix_is_a_path(tmp_path, monkeypatch):
    disk_picture().save(tmp_path / "picture", format="PNG")
    monkeypatch.chdir(tmp_path)
    assert load_target("picture", point_count=100).name == "picture"


@pytest.mark.parametrize("point_count", [0, -5, 2.5, True])
def test_bad_point_count_is_a_clear_error(point_count):
    with pytest.raises(NPAError, match="point_count must be an integer"):
        load_target("heart", point_count=point_count)


@pytest.mark.parametrize("extent", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_extent_is_a_clear_error(extent):
    with pytest.raises(NPAError, match="extent must be finite"):
        load_target("heart", extent=extent)


def test_loading_twice_gives_the_same_target(builtins):
    again = load_target("heart")
    assert torch.equal(again.points, builtins["heart"].points)
    assert torch.equal(again.colours, builtins["heart"].colours)
    assert again.pixel_size == builtins["heart"].pixel_size
    assert torch.equal(again.to("cpu").points, again.points)
