"""Pictures and films in files, and what pictures, films and windows reject."""

import io
import math
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence
from support.refusals import calls
from support.training_runs import full_disk

from npa_envs.errors import NPAError
from npa_envs.render import (
    Window,
    draw_worlds,
    show,
    show_worlds,
    to_uint8,
    write_filmstrip,
    write_gif,
    write_mp4,
    write_png,
    write_webp,
)
from npa_envs.render.picture_files import encode_frame

WRITERS = [(write_gif, "film.gif"), (write_mp4, "film.mp4"), (write_filmstrip, "film.png")]


def film(count: int = 6, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """A coloured square that moves over white."""
    frames = []
    for k in range(count):
        frame = np.full((height, width, 3), 255, np.uint8)
        frame[10:30, 4 * k : 4 * k + 20] = (200, 30 + 10 * k, 60)
        frames.append(frame)
    return frames


def read_film(path: Path) -> list[np.ndarray]:
    with Image.open(path) as opened:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(opened)]


NAN, INFINITE = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("pixel", "background", "shown"),
    [
        # Nobody is there.
        ((0.0, 0.0, 0.0, 0.0), "white", (255, 255, 255)),
        ((0.0, 0.0, 0.0, 0.0), "black", (0, 0, 0)),
        ((0.0, 0.0, 0.0, 0.0), "#102030", (16, 32, 48)),
        ((0.0, 0.0, 0.0, 0.0), (0.0, 0.5, 1.0), (0, 128, 255)),
        # Overlapping particles average, and thin ones let the background through.
        ((0.5, 0.0, 1.0, 1.0), "white", (128, 0, 255)),
        ((2.0, 0.0, 1.0, 4.0), "white", (128, 0, 64)),
        ((0.0, 0.25, 0.0, 0.25), "white", (191, 255, 191)),
        ((0.0, 0.25, 0.0, 0.25), "black", (0, 64, 0)),
        # Colours are clipped; what is not finite is not there.
        ((9.0, -9.0, 0.5, 1.0), "black", (255, 0, 128)),
        ((NAN, 0.0, 0.0, 1.0), "black", (0, 0, 0)),
        ((0.0, 0.0, 0.0, INFINITE), "black", (0, 0, 0)),
    ],
)
def test_a_pixel_is_shown_over_its_background(pixel, background, shown):
    picture = torch.tensor(pixel, dtype=torch.float64).expand(3, 3, 4).clone().requires_grad_()
    assert (to_uint8(picture, background) == shown).all()


def test_a_png_is_exact_and_a_jpeg_is_smaller_and_nearly_exact(tmp_path):
    axis = np.linspace(0, 6, 96)
    wave = 127.5 + 120 * np.sin(axis[:, None, None] + axis[:, None] * [1.0, 1.1, 1.2])
    frame = (wave + np.random.default_rng(0).normal(0, 1, wave.shape)).astype(np.uint8)
    png, jpeg = encode_frame(frame, "PNG"), encode_frame(frame, "JPEG")
    write_png(tmp_path / "small.png", frame)
    for file in (io.BytesIO(png), tmp_path / "small.png"):
        np.testing.assert_array_equal(np.asarray(Image.open(file)), frame)
    shown = np.asarray(Image.open(io.BytesIO(jpeg)))
    # Seen: 1.2, and 0.16 of the bytes.
    assert np.abs(shown.astype(float) - frame).mean() < 3
    assert len(jpeg) < 0.5 * len(png)


def test_gif_background_is_exact_in_every_frame_however_many_colours_there_are(tmp_path):
    rng = np.random.default_rng(0)
    frames = []
    for _ in range(4):
        frame = np.full((80, 80, 3), 255, np.uint8)
        frame[20:60, 20:60] = rng.integers(0, 250, (40, 40, 3), dtype=np.uint8)
        frame[62:, 20:60] = rng.integers(248, 256, (18, 40, 3), dtype=np.uint8)
        frames.append(frame)
    write_gif(tmp_path / "noise.gif", frames)
    for shown, frame in zip(read_film(tmp_path / "noise.gif"), frames, strict=True):
        background = (frame == 255).all(axis=-1)
        assert (shown[background] == 255).all()
        assert np.abs(shown.astype(int) - frame)[~background].mean() < 25


def test_gif_shows_what_stands_still_the_same_in_every_frame(tmp_path):
    ramp = np.linspace(0, 255, 64).astype(np.uint8)
    still = np.stack([*np.meshgrid(ramp, ramp), np.zeros((64, 64), np.uint8)], -1)
    frames = [np.concatenate((still, frame), axis=1) for frame in film(5, height=64)]
    write_gif(tmp_path / "still.gif", frames)
    pictures = read_film(tmp_path / "still.gif")
    for shown in pictures[1:]:
        np.testing.assert_array_equal(shown[:, :64], pictures[0][:, :64])


@pytest.mark.parametrize("fps", [7, 25, 30, 50])
def test_gif_holds_every_frame_in_nearly_exact_colours_as_long_as_it_lasts(tmp_path, fps):
    frames = film(21, width=128)
    write_gif(tmp_path / "film.gif", frames, fps=fps)
    for shown, frame in zip(read_film(tmp_path / "film.gif"), frames, strict=True):
        assert np.abs(shown.astype(int) - frame).max() <= 6
    with Image.open(tmp_path / "film.gif") as opened:
        assert opened.info["loop"] == 0
        length = sum(frame.info["duration"] for frame in ImageSequence.Iterator(opened))
    assert length == pytest.approx(1000 * len(frames) / fps, abs=10)


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 65)])
def test_mp4_holds_every_frame_at_an_even_size(tmp_path, height, width):
    imageio = pytest.importorskip("imageio.v2")
    frames = film(9, height, width)
    write_mp4(tmp_path / "film.mp4", frames, fps=10)
    with imageio.get_reader(tmp_path / "film.mp4") as reader:
        pictures = list(reader.iter_data())
        assert reader.get_meta_data()["fps"] == pytest.approx(10)
    assert len(pictures) == 9
    assert pictures[0].shape == (height + height % 2, width + width % 2, 3)
    for shown, frame in zip(pictures, frames, strict=True):
        assert np.abs(shown[:height, :width].astype(int) - frame).mean() < 4


def test_filmstrip_holds_the_frames_exactly_in_rows(tmp_path):
    frames = film(5)
    write_filmstrip(tmp_path / "strip.png", frames, columns=3)
    strip = np.asarray(Image.open(tmp_path / "strip.png"))
    assert strip.shape == (2 * 56 + 8, 3 * 72 + 8, 3)
    for k, frame in enumerate(frames):
        top, left = 8 + (k // 3) * 56, 8 + (k % 3) * 72
        np.testing.assert_array_equal(strip[top : top + 48, left : left + 64], frame)


def test_a_filmstrip_is_webp_where_its_name_says_so(tmp_path):
    write_filmstrip(tmp_path / "strip.webp", film(2))
    write_filmstrip(tmp_path / "strip.png", film(2))
    with Image.open(tmp_path / "strip.webp") as small, Image.open(tmp_path / "strip.png") as exact:
        assert (small.format, exact.format) == ("WEBP", "PNG")
        assert small.size == exact.size
        difference = np.asarray(small.convert("RGB"), float) - np.asarray(exact.convert("RGB"))
    assert abs(difference).mean() < 4.0


def test_filmstrip_writes_a_caption_below_each_frame_and_none_beside_it(tmp_path):
    frames = [np.full((64, 96, 3), 255, np.uint8)] * 3
    write_filmstrip(tmp_path / "strip.png", frames, ["step 0", "", "a caption far too long"])
    strip = np.asarray(Image.open(tmp_path / "strip.png")).min(axis=-1)
    below = strip[8 + 64 :]
    assert (strip[: 8 + 64] == 255).all()
    pitch = (strip.shape[1] - 8) // 3
    assert pitch >= 96 + 8
    ink = [(below[:, 8 + pitch * k : pitch * (k + 1)] < 128).sum() for k in range(3)]
    assert ink[0] > 30
    assert ink[1] == 0
    assert ink[2] > ink[0]
    assert (below[-2:] == 255).all()
    # Captions wider than small frames keep apart.
    write_filmstrip(
        tmp_path / "small.png", [np.zeros((32, 32, 3), np.uint8)] * 3, ["wide " * 5] * 3
    )
    small = np.asarray(Image.open(tmp_path / "small.png")).min(axis=-1)
    pitch = (small.shape[1] - 8) // 3
    assert pitch > 32 + 8
    assert all((small[:, pitch * k : pitch * k + 8] > 200).all() for k in range(4))
    assert (small[24] == 0)[8:pitch].sum() == 32


def test_disk_that_fills_up_is_a_clear_error_and_keeps_the_old_file(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (6, 128, 128, 3), dtype=np.uint8)
    for write, name in WRITERS:
        path = tmp_path / name
        path.write_bytes(b"old")
        with full_disk(20_000), pytest.raises(NPAError, match=f"^cannot write '{path}'"):
            write(path, noise)
        assert path.read_bytes() == b"old"
    assert sorted(os.listdir(tmp_path)) == sorted(name for _, name in WRITERS)


# What is rejected.


FRAME = np.zeros((4, 4, 3), np.uint8)
FILM = [FRAME] * 6
X, S = torch.zeros(3, 8, 2), torch.zeros(3, 8, 8)
NO_PICTURES = [
    ([], "at least one picture"),
    ([np.zeros((4, 4, 3))], "must be uint8"),
    ([np.zeros((4, 4, 4), np.uint8)], r"shape \[H, W, 3\]"),
    ([FRAME, np.zeros((5, 4, 3), np.uint8)], "all have one size"),
    ([np.zeros((0, 4, 3), np.uint8)], "not zero"),
]


drawn = calls(draw_worlds, x=X, s=S, resolution=32, pixel_size=0.1)
picture = calls(to_uint8, picture=torch.zeros(8, 8, 4))
strip = calls(write_filmstrip, "strip.png", FILM)
window = calls(Window, "a world")


def show_in_window(frame):
    pytest.importorskip("pygame")
    Window("a world", 32).show(frame)


REFUSED = [
    (picture(picture=torch.zeros(8, 8, 3)), r"\[\.\.\., R, R, 4\].*\(8, 8, 3\)"),
    (picture(picture=torch.zeros(8, 8, 4, dtype=torch.uint8)), r"torch\.uint8"),
    (picture(background="blurple"), "background must be a colour, got 'blurple'"),
    (picture(background=(255, 255, 255)), r"red, green and blue in \[0, 1\]"),
    (partial(encode_frame, FRAME[..., :2], "PNG"), r"uint8 of shape \[H, W, 3\]"),
    *(
        (partial(writer, name, frames), message)
        for writer, name in WRITERS
        for frames, message in NO_PICTURES
    ),
    *((partial(writer, f"nowhere/{name}", FILM), "nowhere") for writer, name in WRITERS),
    *(
        (partial(write_gif, "a.gif", FILM, fps=fps), r"fps .* in \[0\.1, 50\]")
        for fps in (0, -1, 51, math.nan)
    ),
    (
        partial(write_gif, "long.gif", [FRAME] * 70, fps=0.1),
        r"alike for at most 655 s in a GIF.*fps=0\.1: raise fps",
    ),
    (partial(write_mp4, "film.mp4", FILM, fps=0), "fps must be in"),
    (partial(write_webp, "a.webp", FILM, quality=101), "quality must be in"),
    *(
        (strip(captions=captions), "captions must be texts, one for each of the 6 frames, got")
        for captions in (["a", "b"], range(6), [None, *"abcde"], 6, "abcdef")
    ),
    (strip(columns=0), "columns must be an integer of at least 1"),
    (drawn(style="densty"), "did you mean 'density'"),
    (drawn(half_width=0.0), "half_width must be positive"),
    (drawn(pixel_size=math.nan), "pixel_size must be positive"),
    (drawn(sigma=-1.0), "sigma must be positive"),
    (drawn(azimuth=math.inf), "azimuth must be finite"),
    (drawn(centre=(0.0, 0.0, 0.0)), r"centre must have shape \[2\] or \[3, 2\]"),
    (drawn(background="no colour"), "background must be a colour"),
    (drawn(resolution=1), "resolution must be at least 2"),
    (drawn(x=torch.zeros(3, 8, 3), periodic=True), "periodic pictures are of 2D worlds"),
    (drawn(s=S[..., :2]), "at least 3 channels, got 2"),
    (partial(show_worlds, X, S[0]), "give what rollout returns"),
    (partial(show_worlds, X[:, :0], S[:, :0]), "at least one particle"),
    (
        partial(show_worlds, torch.stack([X] * 3), torch.stack([S] * 2)),
        r"same number of steps in front, got \(3, 3, 8, 2\) and \(2, .*: give what rollout returns",
    ),
    (partial(show_worlds, X, S, fps=0), "fps must be in"),
    (partial(show, np.zeros((4, 4, 3))), "must be uint8"),
    (partial(show, []), "at least one picture"),
    *(
        (partial(show_in_window, frame), "frame must be uint8")
        for frame in (FRAME[..., 0], FRAME.astype(np.float32), FRAME[..., :2], FRAME[:0])
    ),
    *((window(size=size), "size must") for size in (0, -1, 12.5, "a", (3, 4), None, True, 20_000)),
    (window(size=32, fps=0.0), "must be"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_what_is_refused_is_named_and_nothing_is_written(call, message, tmp_path, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NPAError, match=message):
        call()
    assert list(tmp_path.iterdir()) == []
