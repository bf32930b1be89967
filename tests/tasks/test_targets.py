"""Targets of points: drawings, emoji, and pictures cut out, scaled and read from files."""

import io
import os

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw, ImageFont

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.tasks.targets import images
from npa_envs.tasks.targets.images import read_image, resample
from npa_envs.tasks.targets.notes import left_out
from npa_envs.tasks.targets.picture_points import builtin_targets, load_target, target_from_image

RED, GREEN, BLUE = (255, 0, 0), (0, 160, 0), (0, 0, 255)


def disk_picture(mode="RGBA", background=(0, 0, 0, 0), side=200):
    image = Image.new(mode, (side, side), background)
    ImageDraw.Draw(image).ellipse((0.2 * side, 0.2 * side, 0.8 * side, 0.8 * side), fill=RED)
    return image


@pytest.mark.parametrize("name", builtin_targets())
def test_builtin_target_is_colourful_and_on_a_centred_grid(name):
    target = load_target(name)
    assert abs(len(target.points) - 4096) <= 24
    assert target.points.mean(dim=0).abs().max() < 1e-5
    assert target.points.abs().max() + target.pixel_size / 2 == pytest.approx(0.9, abs=1e-5)
    steps = (target.points - target.points[0]).double() / target.pixel_size
    assert (steps - steps.round()).abs().max() < 1e-3
    assert len(torch.unique(steps.round(), dim=0)) == len(target.points)
    assert 0 <= target.colours.min() <= target.colours.max() <= 1
    assert target.colours.std(dim=0).max() > 0.15


@pytest.mark.parametrize("point_count", [64, 500, 1024, 4096, 16384])
def test_point_count_is_met_within_one_percent(point_count):
    target = target_from_image(disk_picture(), name="disk", point_count=point_count)
    assert abs(len(target.points) - point_count) <= max(4, 0.01 * point_count)
    diameter = 2 * (point_count / np.pi) ** 0.5
    assert 1.8 / target.pixel_size == pytest.approx(diameter, abs=1.4)


def test_top_of_the_picture_has_high_y_and_its_left_low_x(tmp_path, monkeypatch):
    image = Image.new("RGBA", (60, 60), RED)
    image.paste(BLUE, (0, 30, 60, 60))
    image.paste(GREEN, (0, 0, 30, 30))
    image.putpixel((59, 59), (0, 0, 0, 0))
    # A file that is there is a path, also without a suffix.
    image.save(tmp_path / "corners", format="PNG")
    monkeypatch.chdir(tmp_path)
    target = load_target("corners", point_count=900)
    x, y = target.points.T
    for colour, chosen in ((0, (x > 0.1) & (y > 0.1)), (1, (x < -0.1) & (y > 0.1)), (2, y < -0.1)):
        assert (target.colours[chosen].argmax(dim=1) == colour).all()
    assert target.name == "corners"


def encoded(image, codec="PNG", fraction=1.0):
    """Return the first `fraction` of the bytes of a picture's file."""
    buffer = io.BytesIO()
    image.save(buffer, codec)
    return buffer.getvalue()[: int(fraction * buffer.tell())]


LINE = Image.new("RGBA", (1000, 3), (0, 0, 0, 0))
LINE.paste(RED, (0, 1, 1000, 2))
NOISE = Image.fromarray(np.random.default_rng(0).integers(0, 255, (50, 50, 3), dtype=np.uint8))
BAD_PICTURES = {
    "empty": (b"", "empty file"),
    "text": (b"this is no picture, only text", "none of these"),
    **{
        codec: (encoded(disk_picture("RGB", "white"), codec, 0.5), "truncated or damaged")
        for codec in ("PNG", "JPEG", "WEBP")
    },
    "transparent": (
        encoded(Image.new("RGBA", (20, 20), (255, 0, 0, 100))),
        r"alpha above 0.5, the highest is 0.39",
    ),
    "busy border": (
        encoded(NOISE),
        "one colour.*no part to cut out: --keep-background.*transparent background",
    ),
    "thin line": (encoded(LINE), "'bad' is too thin to be resampled to 100 points"),
    "plain": (encoded(Image.new("RGB", (50, 50), "white")), "one colour all over"),
}


@pytest.mark.parametrize("case", BAD_PICTURES)
def test_pictures_that_are_no_targets_are_clear_errors(tmp_path, case):
    content, message = BAD_PICTURES[case]
    path = tmp_path / "bad.png"
    path.write_bytes(content)
    with pytest.raises(NPAError, match=message) as caught:
        load_target(path, point_count=100)
    assert (path.stem if case == "thin line" else str(path)) in str(caught.value)


def test_a_picture_without_pixels_is_a_clear_error():
    with pytest.raises(NPAError, match="0 x 5 pixels"):
        target_from_image(Image.new("RGBA", (0, 5)), name="nothing")


def test_colours_are_means_of_opaque_pixels():
    image = Image.new("RGBA", (400, 400), (255, 0, 255, 0))
    ImageDraw.Draw(image).ellipse((50, 50, 350, 350), fill=(0, 255, 0, 255))
    target = target_from_image(image, name="disk", point_count=700)
    assert (target.colours - torch.tensor([0.0, 1, 0])).abs().max() < 0.02
    board = (np.indices((1500, 1500)).sum(axis=0) % 2 * 255).astype(np.uint8)
    image = Image.fromarray(np.stack([board] * 3 + [np.full_like(board, 255)], axis=-1))
    target = target_from_image(image, name="board", point_count=2500)
    assert (target.colours - 0.5).abs().max() < 0.03


@pytest.mark.parametrize("side", [1, 2, 5])
def test_tiny_picture_is_enlarged(side):
    target = target_from_image(Image.new("RGBA", (side, side), BLUE), name="dot", point_count=1000)
    assert abs(len(target.points) - 1000) <= 60
    assert (target.colours == torch.tensor([0.0, 0, 1])).all()


def test_thin_lines_of_a_large_picture_survive():
    image = Image.new("RGBA", (1200, 1200), (0, 0, 0, 0))
    draw = ImageDraw.Draw(image)
    for k in range(10):
        draw.line((20, 60 + 120 * k, 1180, 60 + 120 * k), fill=RED, width=1)
    opaque = np.asarray(resample(image, 500))[..., 3] >= 128
    assert 250 < opaque.sum() < 20000
    assert len(target_from_image(LINE, name="line", point_count=1000).points) == 1000


@pytest.mark.parametrize("suffix", ["jpg", "webp", "bmp", "png"])
def test_picture_without_transparency_is_cut_out_of_its_background(tmp_path, suffix):
    path = tmp_path / f"disk.{suffix}"
    options = {"quality": 90} if suffix == "jpg" else {}
    # An opaque alpha channel counts as none.
    disk_picture("RGBA" if suffix == "png" else "RGB", (255,) * (3 + (suffix == "png"))).save(
        path, **options
    )
    target = load_target(str(path), point_count=1000)
    reference = target_from_image(disk_picture(), name="disk", point_count=1000)
    assert target.pixel_size == pytest.approx(reference.pixel_size, rel=0.03)
    assert (target.colours[:, 0] > 0.85).all()
    assert (target.colours[:, 1:] < 0.25).float().mean() > 0.97


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_whole_rectangle_is_grown_where_the_background_is_kept(tmp_path, mode):
    """Opaque pictures as they are, transparent ones on white."""
    image = Image.new("RGB", (120, 60), "white")
    ImageDraw.Draw(image).rectangle((0, 0, 59, 59), fill=BLUE)
    if mode == "RGBA":
        image.putalpha(Image.new("L", image.size, 0))
        image.paste((*BLUE[:3], 255), (0, 0, 60, 60))
    image.save(tmp_path / "photo.png")
    target = load_target(tmp_path / "photo.png", point_count=800, keep_background=True)
    assert len(target.points) == 800
    sides = target.points.amax(0) - target.points.amin(0) + target.pixel_size
    torch.testing.assert_close(sides, torch.tensor([1.8, 0.9]), rtol=0.0, atol=1e-5)
    left = target.points[:, 0] < -2 * target.pixel_size
    right = target.points[:, 0] > 2 * target.pixel_size
    blue = torch.tensor(BLUE[:3]) / 255
    # Filters ring beside the edge, by a level or two of 255.
    assert (target.colours[left] - blue).abs().max() < 2.5 / 255
    assert (target.colours[right] - 1.0).abs().max() < 2.5 / 255
    fields = {"target": str(tmp_path / "photo.png"), "target_point_count": 800}
    task = Morphogenesis2D(Morphogenesis2DConfig(**fields, keep_background=True))
    assert torch.equal(task.target.points, target.points)


def test_the_background_is_what_is_connected_with_the_border(tmp_path):
    image = Image.new("RGB", (100, 100), "white")
    ImageDraw.Draw(image).ellipse((10, 10, 90, 90), fill="white", outline=RED, width=10)
    image.save(tmp_path / "ring.png")
    alpha = np.asarray(read_image(tmp_path / "ring.png")[0])[..., 3]
    assert (alpha[50, 50], alpha[2, 2]) == (255, 0)
    image = Image.new("RGB", (90, 90), "white")
    draw = ImageDraw.Draw(image)
    combs = [(10 + 20 * k, 8, 14 + 20 * k, 80) for k in range(4)]
    for box in (*combs, (10, 76, 74, 80), (70, 8, 86, 12), (82, 8, 86, 60)):
        draw.rectangle(box, fill=BLUE)
    image.save(tmp_path / "maze.png")
    alpha = np.asarray(read_image(tmp_path / "maze.png")[0])[..., 3]
    assert (alpha[np.asarray(image)[..., 0] == 255] == 0).all()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads everything")
def test_unreadable_picture_is_a_clear_error(tmp_path):
    disk_picture().save(tmp_path / "secret.png")
    (tmp_path / "secret.png").chmod(0)
    with pytest.raises(NPAError, match="permissions"):
        load_target(tmp_path / "secret.png")


def test_emoji_are_distinguished_from_words():
    for text in ("🦎", "❤", "❤️", "👩‍🚀", "🇨🇭", "1️⃣", "👍🏽", "☀"):
        assert images.is_emoji(text), text
    for text in ("", "gecko", "gëcko", "1", "守宫", "🦎" * 20):
        assert not images.is_emoji(text), text


@pytest.mark.parametrize(
    ("fonts", "error", "message"),
    [
        ([], MissingDependencyError, "apt install fonts-noto-color-emoji"),
        ([ImageFont.load_default(100)], NPAError, "draws in colour, but none of Aileron does"),
    ],
)
def test_emoji_that_no_font_draws_in_colour_are_clear_errors(monkeypatch, fonts, error, message):
    monkeypatch.setattr(images, "find_emoji_fonts", lambda: fonts)
    with pytest.raises(error, match=message):
        load_target("☀")


needs_emoji_font = pytest.mark.skipif(
    not images.find_emoji_fonts(), reason="no colour-emoji font is installed"
)


@needs_emoji_font
def test_lizard_emoji_is_green():
    target = load_target("🦎")
    red, green, blue = target.colours.mean(dim=0)
    assert green > max(red, blue) + 0.1
    assert abs(len(target.points) - 4096) <= 40
    assert target.name == "🦎"


@needs_emoji_font
def test_joined_emoji_is_one_picture_and_two_emoji_are_a_clear_error():
    assert len(load_target("👩‍🚀", point_count=1000).points) > 900
    with pytest.raises(NPAError, match="must be one emoji"):
        load_target("🦎🦎")


def test_what_was_left_out_of_a_file_is_told_once(caplog):
    for text in ("2 more pages", "2 more pages", "its mask"):
        left_out("scan.tif", text)
    assert caplog.messages == [
        "scan.tif: left out: 2 more pages",
        "scan.tif: left out: its mask",
    ]
