from __future__ import annotations

import io
import os

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from npa_envs.errors import NPAError
from npa_envs.tasks.targets.images import read_image, resample
from npa_envs.tasks.targets.points import load_target, target_from_image

RED, BLUE = (255, 0, 0), (0, 0, 255)


def disk_picture(
    mode: str = "RGBA", background: object = (0, 0, 0, 0), side: int = 200
) -> Image.Image:
    image = Image.new(mode, (side, side), background)
    ImageDraw.Draw(image).ellipse((0.2 * side, 0.2 * side, 0.8 * side, 0.8 * side), fill=RED)
    return image


def test_colours_of_transparent_pixels_do_not_leak():
    image = Image.new("RGBA", (400, 400), (255, 0, 255, 0))
    ImageDraw.Draw(image).ellipse((50, 50, 350, 350), fill=(0, 255, 0, 255))
    target = target_from_image(image, name="disk", point_count=700)
    torch.testing.assert_close(
        target.colours, torch.tensor([0.0, 1, 0]).expand_as(target.colours), atol=0.02, rtol=0
    )


def test_fine_pattern_of_a_large_picture_is_averaged():
    board = (np.indices((1500, 1500)).sum(axis=0) % 2 * 255).astype(np.uint8)
    image = Image.fromarray(np.stack([board] * 3 + [np.full_like(board, 255)], axis=-1))
    target = target_from_image(image, name="board", point_count=2500)
    assert (target.colours - 0.5).abs().max() < 0.03


@pytest.mark.parametrize("side", [1, 2, 5])
def test_tiny_picture_is_enlarged(side):
    target = target_from_image(Image.new("RGBA", (side, side), BLUE), name="dot", point_count=1000)
    assert abs(target.point_count - 1000) <= 60
    assert (target.colours == torch.tensor([0.0, 0, 1])).all()


def test_thin_lines_of_a_large_picture_survive():
    image = Image.new("RGBA", (1200, 1200), (0, 0, 0, 0))
    draw = ImageDraw.Draw(image)
    for k in range(10):
        draw.line((20, 60 + 120 * k, 1180, 60 + 120 * k), fill=RED, width=1)
    found = np.asarray(resample(image, 500))[..., 3] >= 128
    assert 250 < found.sum() < 20000


@pytest.mark.parametrize("count", [1, 100, 1024])
def test_line_too_thin_for_so_few_points_is_a_clear_error(tmp_path, count):
    image = Image.new("RGBA", (4000, 3), (0, 0, 0, 0))
    ImageDraw.Draw(image).line((0, 1, 3999, 1), fill=RED)
    image.save(tmp_path / "line.png")
    with pytest.raises(NPAError, match=f"'line' is too thin to be resampled to {count} points"):
        load_target(tmp_path / "line.png", point_count=count)
    assert load_target(tmp_path / "line.png", point_count=4000).point_count == 4000


@pytest.mark.parametrize(
    ("suffix", "options"), [("jpg", {"quality": 90}), ("webp", {}), ("bmp", {})]
)
def test_picture_without_transparency_is_cut_out_of_its_background(tmp_path, suffix, options):
    path = tmp_path / f"disk.{suffix}"
    disk_picture("RGB", "white").save(path, **options)
    target = load_target(str(path), point_count=1000)
    reference = target_from_image(disk_picture(), name="disk", point_count=1000)
    assert target.pixel_size == pytest.approx(reference.pixel_size, rel=0.03)
    assert (target.colours[:, 0] > 0.85).all()
    assert (target.colours[:, 1:] < 0.25).float().mean() > 0.97


def test_opaque_alpha_channel_counts_as_none(tmp_path):
    disk_picture("RGBA", (255, 255, 255, 255)).save(tmp_path / "disk.png")
    target = load_target(tmp_path / "disk.png", point_count=1000)
    assert target.colours[:, 1].max() < 0.25


def test_background_enclosed_by_the_object_stays(tmp_path):
    image = Image.new("RGB", (100, 100), "white")
    ImageDraw.Draw(image).ellipse((10, 10, 90, 90), fill="white", outline=RED, width=10)
    image.save(tmp_path / "ring.png")
    alpha = np.asarray(read_image(tmp_path / "ring.png"))[..., 3]
    assert alpha[50, 50] == 255
    assert alpha[2, 2] == 0


def test_background_is_followed_around_corners(tmp_path):
    image = Image.new("RGB", (90, 90), "white")
    draw = ImageDraw.Draw(image)
    for k in range(4):
        draw.rectangle((10 + 20 * k, 8, 14 + 20 * k, 80), fill=BLUE)
    draw.rectangle((10, 76, 74, 80), fill=BLUE)
    draw.rectangle((70, 8, 86, 12), fill=BLUE)
    draw.rectangle((82, 8, 86, 60), fill=BLUE)
    image.save(tmp_path / "maze.png")
    alpha = np.asarray(read_image(tmp_path / "maze.png"))[..., 3]
    assert (alpha[np.asarray(image)[..., 0] == 255] == 0).all()


def test_sixteen_bit_grey_is_scaled_not_clipped(tmp_path):
    levels = np.full((40, 40), 65535, dtype=np.uint16)
    levels[10:30, 10:30] = 16384
    Image.fromarray(levels).save(tmp_path / "grey.png")
    target = load_target(tmp_path / "grey.png", point_count=400)
    assert (target.colours - 0.25).abs().max() < 0.02


def test_picture_is_turned_as_its_exif_says(tmp_path):
    image = Image.new("RGB", (80, 40), "white")
    ImageDraw.Draw(image).rectangle((10, 10, 70, 30), fill=BLUE)
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(tmp_path / "turned.jpg", exif=exif)
    assert read_image(tmp_path / "turned.jpg").size == (40, 80)


def truncated(kind: str) -> bytes:
    buffer = io.BytesIO()
    disk_picture("RGB", "white").save(buffer, kind)
    data = buffer.getvalue()
    return data[: len(data) // 2]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty file"),
        (b"this is no picture, only text", "none that Pillow knows"),
        (truncated("PNG"), "truncated or damaged"),
        (truncated("JPEG"), "truncated or damaged"),
        (truncated("WEBP"), "truncated or damaged"),
    ],
    ids=["empty", "text", "png", "jpeg", "webp"],
)
def test_damaged_picture_is_a_clear_error(tmp_path, content, message):
    path = tmp_path / "bad.png"
    path.write_bytes(content)
    with pytest.raises(NPAError, match=message) as caught:
        load_target(path)
    assert str(path) in str(caught.value)


def test_missing_picture_and_folder_are_clear_errors(tmp_path):
    with pytest.raises(NPAError, match="does not exist"):
        load_target(str(tmp_path / "nowhere.png"))
    with pytest.raises(NPAError, match="is a folder"):
        load_target(tmp_path)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads everything")
def test_unreadable_picture_is_a_clear_error(tmp_path):
    disk_picture().save(tmp_path / "secret.png")
    (tmp_path / "secret.png").chmod(0)
    with pytest.raises(NPAError, match="permissions"):
        load_target(tmp_path / "secret.png")


def test_transparent_picture_is_a_clear_error(tmp_path):
    Image.new("RGBA", (20, 20), (255, 0, 0, 100)).save(tmp_path / "ghost.png")
    with pytest.raises(NPAError, match=r"alpha above 0.5, the highest is 0.39"):
        load_target(tmp_path / "ghost.png")
    with pytest.raises(NPAError, match="0 x 5 pixels"):
        target_from_image(Image.new("RGBA", (0, 5)), name="nothing")


def test_busy_border_and_plain_picture_without_transparency_are_clear_errors(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (50, 50, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    with pytest.raises(NPAError, match=r"one colour \(the background\).*transparent background"):
        load_target(tmp_path / "noise.png")
    Image.new("RGB", (50, 50), "white").save(tmp_path / "plain.png")
    with pytest.raises(NPAError, match="one colour all over"):
        load_target(tmp_path / "plain.png")


def test_decompression_bomb_is_a_clear_error(tmp_path, monkeypatch):
    disk_picture().save(tmp_path / "bomb.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    with pytest.raises(NPAError, match="at most 2000 pixels"):
        load_target(tmp_path / "bomb.png")
