"""A window for frames; the only module that uses pygame."""

from __future__ import annotations

import contextlib
import importlib
import os
import warnings
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

import numpy as np

from npa_envs.checks import checked_count
from npa_envs.errors import MissingDependencyError, NPAError, shown
from npa_envs.render.film import Frame, check_rate

_SETTINGS = {
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    # SDL would swallow SIGTERM and make a click on the window's cross of it.
    "SDL_NO_SIGNAL_HANDLERS": "1",
}

_NO_SCREEN = ("offscreen", "dummy")
"""SDL's drivers without a screen; `SDL_VIDEODRIVER` may ask for one by name."""

_shown: Window | None = None
"""The open window: pygame has one for each process."""


class Window:
    """A window on the screen; without a screen it warns once and then does nothing.

    A process has one window: a new one closes the older one.

    Args:
        title: Text of the title bar.
        size: Width and height [screen pixels], or one number for both. Frames of another size are
            scaled to it.
        fps: Most frames a second, for which `show` waits; None: no limit.

    Raises:
        MissingDependencyError: pygame is not installed.
    """

    def __init__(
        self, title: str, size: int | tuple[int, int] = 512, *, fps: float | None = None
    ) -> None:
        global _shown
        if fps is not None:
            check_rate(fps)
        self.size = _checked_size(size)
        """Width and height [screen pixels]."""
        self.fps = fps
        """Most frames shown a second; None: no limit."""
        self.closed = False
        """Whether the user, `close` or another window has closed it."""
        self._pygame = _import_pygame()
        self._clock = self._pygame.time.Clock()
        self._surface: Any = None
        if _shown is not None:
            _shown.close()
        reason = self._open(title)
        if reason is None:
            _shown = self
        else:
            warnings.warn(
                f"there is no screen to open a window on ({reason}): nothing will be shown; for "
                "pictures without a screen use render_mode='rgb_array'",
                stacklevel=2,
            )

    @property
    def visible(self) -> bool:
        """Whether it is on the screen."""
        return self._surface is not None

    def show(self, frame: Frame) -> None:
        """Show a frame, uint8, shape [H, W, 3]; handle events and keep to `fps`."""
        pixels = np.asarray(frame)
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[-1] != 3 or not pixels.size:
            raise NPAError(
                f"frame must be uint8 of shape [H, W, 3], got {pixels.dtype} {pixels.shape}: "
                "make frames with npa_envs.render.draw_worlds"
            )
        self.answer_events()
        if self._surface is None:
            return
        # pygame counts columns first.
        picture = self._pygame.surfarray.make_surface(pixels.swapaxes(0, 1))
        if picture.get_size() != self.size:
            picture = self._pygame.transform.smoothscale(picture, self.size)
        self._surface.blit(picture, (0, 0))
        self._pygame.display.flip()
        if self.fps is not None:
            self._clock.tick(self.fps)

    def answer_events(self) -> None:
        """Handle the window's events, also between frames that come slowly."""
        if self._surface is None:
            return
        # Another library of the process may have shut the display down.
        lost = not self._pygame.display.get_init()
        if lost or any(event.type == self._pygame.QUIT for event in self._pygame.event.get()):
            self.close()

    def close(self) -> None:
        """Close the window; closing it again does nothing."""
        global _shown
        self.closed = True
        if self._surface is not None:
            self._surface = None
            _shown = None
            self._pygame.display.quit()

    def _open(self, title: str) -> str | None:
        """Open the window; return why it could not be opened, or None."""
        display = self._pygame.display
        try:
            with _settings():
                display.init()
            driver = display.get_driver()
            if driver not in _NO_SCREEN or os.environ.get("SDL_VIDEODRIVER") == driver:
                self._surface = display.set_mode(self.size)
                display.set_caption(title)
                return None
            reason = f"SDL found only its driver {shown(driver)}"
        except self._pygame.error as error:
            reason = str(error)
        display.quit()
        return reason

    def __enter__(self) -> Self:
        """Return the window itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the window."""
        self.close()


def _checked_size(size: Any) -> tuple[int, int]:
    sides = size if isinstance(size, tuple | list) else (size, size)
    try:
        width, height = (checked_count("size", side) for side in sides)
    except ValueError:
        width = height = 0
    if min(width, height) < 1:
        raise NPAError(
            f"size must be a whole number of pixels, at least 1, or two of them, got "
            f"{shown(size)}: try 512"
        )
    return width, height


def _import_pygame() -> Any:
    try:
        with _settings(), warnings.catch_warnings():
            # pygame's use of setuptools is deprecated.
            warnings.simplefilter("ignore")
            return importlib.import_module("pygame")
    except ImportError as error:
        raise MissingDependencyError(
            f"a window needs pygame, which is not installed ({error}): "
            "pip install 'npa-envs[human]', or use render_mode='rgb_array'"
        ) from error


@contextlib.contextmanager
def _settings() -> Iterator[None]:
    """Set pygame's environment variables for a while, unless the user has set them."""
    missing = {name: value for name, value in _SETTINGS.items() if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)
