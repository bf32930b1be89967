"""What pictures, films and windows reject, and what they say."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from support.refusals import calls

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
    write_webp,
)
from npa_envs.render.picture_files import encode_frame

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
WRITERS = [(write_gif, "film.gif"), (write_mp4, "film.mp4"), (write_filmstrip, "film.png")]


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
