import os
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest

from npa_envs.render import Window

pygame = pytest.importorskip("pygame")


@pytest.fixture
def screen(monkeypatch):
    """SDL's driver without a screen, asked for by name."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def picture() -> np.ndarray:
    frame = np.zeros((20, 20, 3), np.uint8)
    frame[:10, 10:] = (200, 100, 50)
    return frame


def shown_on(window):
    window.show(picture())
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)


def test_a_frame_appears_as_it_is_and_one_of_another_size_fills_the_window(screen):
    np.testing.assert_array_equal(shown_on(Window("a world", 20)), picture())
    assert pygame.display.get_caption()[0] == "a world"
    shown = shown_on(Window("a world", np.int64(60)))
    assert shown.shape == (60, 60, 3)
    assert (shown[:25, 35:] == (200, 100, 50)).all()
    assert (shown[35:] == 0).all()


def test_frames_come_no_faster_than_the_rate(screen):
    window = Window("a world", 32, fps=40)
    window.show(picture())
    start = time.perf_counter()
    for _ in range(8):
        window.show(picture())
    assert time.perf_counter() - start > 0.8 * 8 / 40


@pytest.mark.parametrize(
    "shut",
    [
        lambda window: pygame.event.post(pygame.event.Event(pygame.QUIT)),
        lambda window: pygame.display.quit(),
        lambda window: window.close(),
    ],
    ids=["a click on the cross", "another library", "its owner"],
)
def test_a_window_that_was_shut_stays_closed(screen, shut):
    window = Window("a world", 32)
    window.show(picture())
    assert not window.closed
    shut(window)
    window.show(picture())
    assert window.closed
    assert not pygame.display.get_init()
    window.show(picture())
    window.close()


def test_a_new_window_takes_the_place_of_the_old_one(screen):
    old = Window("old", 32)
    new = Window("new", 48)
    assert old.closed
    old.close()
    old.show(picture())
    new.show(picture())
    assert pygame.display.get_surface().get_size() == (48, 48)
    new.close()


@pytest.mark.parametrize("driver", ["not a driver", None])
def test_without_a_screen_it_warns_once_and_does_nothing(monkeypatch, driver):
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
            window.show(picture())
        # A window that waits takes 40 s.
        assert time.perf_counter() - start < 20.0
        assert not window.closed
        window.close()
        window.close()


def test_pygame_starts_with_the_first_window_and_without_a_banner():
    code = (
        "import os, sys, npa_envs.render as render\n"
        # Gymnasium, where it was imported, hides the banner as well.
        "os.environ.pop('PYGAME_HIDE_SUPPORT_PROMPT', None)\n"
        "assert 'pygame' not in sys.modules\n"
        "render.Window('a world', 32).close()\n"
        "assert 'pygame' in sys.modules\n"
    )
    environment = {**os.environ, "SDL_VIDEODRIVER": "dummy"}
    command = [sys.executable, "-W", "error", "-c", code]
    assert subprocess.check_output(command, env=environment) == b""
