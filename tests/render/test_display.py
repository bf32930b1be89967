"""What notebooks show of worlds and environments, and a window on a screen."""

import base64
import io
import os
import re
import sys
import time
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image
from support.crowds import small as small_crowd

from npa_envs.envs import multispecies_v0
from npa_envs.render import Window, draw_worlds, show_worlds, write_webp

SIZE = 24


def worlds(*, steps=(), count=2):
    generator = torch.Generator().manual_seed(3)
    x = torch.rand(*steps, count, 64, 2, generator=generator) - 0.5
    return x, torch.rand(*steps, count, 64, 8, generator=generator) - 0.5


def shown_picture(thing):
    """The picture that Jupyter shows of something."""
    bundle = thing._repr_mimebundle_()
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(bundle["image/jpeg"]))))


def test_worlds_are_shown_side_by_side():
    x, s = worlds()
    s[..., -3:] = torch.tensor([[0.5, -0.5, -0.5], [-0.5, -0.5, 0.5]])[:, None]
    drawing = {"resolution": SIZE, "pixel_size": 0.1, "half_width": 0.5}
    picture = shown_picture(show_worlds(x, s, **drawing))
    assert picture.shape == (SIZE, 2 * SIZE + 4, 3)
    expected = draw_worlds(x, s, **drawing)
    # JPEG is not exact.
    assert np.abs(picture[:, :SIZE].astype(float) - expected[0]).mean() < 12
    assert np.abs(picture[:, -SIZE:].astype(float) - expected[1]).mean() < 12
    assert np.abs(expected[0].astype(float) - expected[1]).mean() > 20


def test_a_trajectory_is_shown_as_a_film():
    x, s = worlds(steps=(5,), count=1)
    film = show_worlds(x, s, fps=10, resolution=SIZE)
    assert repr(film) == f"a film of 5 pictures of {SIZE} × {SIZE} pixels"
    html = film._repr_mimebundle_()["text/html"]
    (data,) = re.fullmatch(r'<img alt="[^"]+" src="data:image/webp;base64,([^"]+)">', html).groups()
    opened = Image.open(io.BytesIO(base64.b64decode(data)))
    assert (opened.n_frames, opened.size) == (5, (SIZE, SIZE))
    opened.load()
    assert opened.info["duration"] == 100


def test_particles_that_stand_apart_are_drawn_as_large_as_they_stand_apart():
    side = torch.linspace(-0.5, 0.5, 11)
    x = torch.cartesian_prod(side, side)[None]
    s = torch.zeros(1, 121, 8)
    expected = show_worlds(x, s, resolution=SIZE, pixel_size=0.1).frames[0]
    measured = show_worlds(x, s, resolution=SIZE).frames[0]
    assert np.abs(expected.astype(float) - measured).mean() < 10


def test_a_webp_repeats_and_keeps_its_rate(tmp_path):
    frames = [np.full((8, 12, 3), 40 * k, np.uint8) for k in range(4)]
    write_webp(tmp_path / "film.webp", frames, 20)
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.n_frames, film.size, film.info["loop"]) == (4, (12, 8), 0)
        film.seek(3)
        assert abs(int(np.asarray(film.convert("RGB")).mean()) - 120) <= 2


@pytest.mark.parametrize("kind", ["single", "vector", "species"])
def test_environments_show_their_worlds(kind):
    if kind == "species":
        env = multispecies_v0.parallel_env(**small_crowd("mixing"))
    else:
        small = {"particle_count": 32, "render_size": SIZE}
        name = "npa/Morphogenesis2D-v0"
        made = gym.make_vec(name, 3, **small) if kind == "vector" else gym.make(name, **small)
        env = made.unwrapped
    assert list(env._repr_mimebundle_()) == ["text/plain"]
    env.reset(seed=0)
    picture = shown_picture(env)
    size = env.config.render_size
    side = 2 * size + 4 if kind == "vector" else size
    assert picture.shape == (side, side, 3)
    assert picture.std() > 5
    assert env._repr_mimebundle_()["text/plain"] == str(env)
    env.close()


# A window


@pytest.fixture
def screen(monkeypatch):
    """pygame, with SDL's driver without a screen, asked for by name."""
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield pygame
    pygame.display.quit()


FRAME = np.zeros((20, 20, 3), np.uint8)
FRAME[:10, 10:] = (200, 100, 50)


def test_a_frame_appears_as_it_is_and_one_of_another_size_fills_the_window(screen):
    def shown_on(window):
        window.show(FRAME)
        return screen.surfarray.array3d(screen.display.get_surface()).swapaxes(0, 1)

    np.testing.assert_array_equal(shown_on(Window("a world", 20)), FRAME)
    assert screen.display.get_caption()[0] == "a world"
    shown = shown_on(Window("a world", np.int64(60)))
    assert shown.shape == (60, 60, 3)
    assert (shown[:25, 35:] == (200, 100, 50)).all()
    assert (shown[35:] == 0).all()


def test_frames_come_no_faster_than_the_rate(screen):
    window = Window("a world", 32, fps=40)
    window.show(FRAME)
    start = time.perf_counter()
    for _ in range(8):
        window.show(FRAME)
    assert time.perf_counter() - start > 0.8 * 8 / 40


@pytest.mark.parametrize(
    "shut",
    [
        lambda _, pygame: pygame.event.post(pygame.event.Event(pygame.QUIT)),
        lambda _, pygame: pygame.display.quit(),
        lambda window, _: window.close(),
    ],
    ids=["a click on the cross", "another library", "its owner"],
)
def test_a_window_that_was_shut_stays_closed(screen, shut):
    window = Window("a world", 32)
    window.show(FRAME)
    assert not window.closed
    shut(window, screen)
    window.show(FRAME)
    assert window.closed
    assert not screen.display.get_init()
    window.show(FRAME)
    window.close()


def test_a_new_window_takes_the_place_of_the_old_one(screen):
    old = Window("old", 32)
    new = Window("new", 48)
    assert old.closed
    old.close()
    old.show(FRAME)
    new.show(FRAME)
    assert screen.display.get_surface().get_size() == (48, 48)
    new.close()


@pytest.mark.parametrize("driver", ["not a driver", None])
def test_without_a_screen_it_warns_once_and_does_nothing(monkeypatch, driver):
    pytest.importorskip("pygame")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    if driver is not None:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    elif sys.platform != "linux" or os.path.exists("/dev/dri"):
        pytest.skip("there may be a screen")
    with pytest.warns(UserWarning, match="there is no screen") as caught:
        window = Window("a world", 32, fps=0.1)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        start = time.perf_counter()
        for _ in range(5):
            window.show(FRAME)
        # A window that waits takes 40 s.
        assert time.perf_counter() - start < 20.0
        assert not window.closed
        window.close()
        window.close()
