"""Pictures and films in notebooks (`show`, `show_worlds`), and a window (`Window`)."""

from __future__ import annotations

import base64
import importlib
import math
import os
import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import checked_side
from npa_envs.errors import NPAError, importing, shown
from npa_envs.render.picture_files import (
    Frame,
    check_rate,
    checked_frames,
    encode_frame,
    encode_webp,
)
from npa_envs.render.worlds import draw_worlds

MAX_SHOWN = 16
"""Maximum number of worlds in a picture; further ones are not drawn."""

_GAP = 4


class Shown:
    """A picture or a repeating film, which a notebook displays when it is the value of a cell.

    Frames are pictures of one size, uint8, shape [H, W, 3] each; `fps` is their number per second.
    """

    def __init__(self, frames: Iterable[Frame], fps: float) -> None:
        check_rate(fps)
        self.frames = checked_frames(frames)
        self.fps = fps

    def __repr__(self) -> str:
        height, width, _ = self.frames[0].shape
        count = len(self.frames)
        what = "a picture" if count == 1 else f"a film of {count} pictures"
        return f"{what} of {width} × {height} pixels"

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """Return data by MIME type, for IPython: text, and a JPEG or a film (WebP in HTML)."""
        bundle: dict[str, Any] = {"text/plain": repr(self)}
        if len(self.frames) == 1:
            picture = encode_frame(self.frames[0], "JPEG")
            return bundle | {"image/jpeg": base64.b64encode(picture).decode()}
        film = base64.b64encode(encode_webp(self.frames, self.fps)).decode()
        return bundle | {"text/html": f'<img alt="{self!r}" src="data:image/webp;base64,{film}">'}


def show(frames: Frame | Iterable[Frame], *, fps: float = 25.0) -> Shown:
    """Return a picture for a notebook, or a film of several; frames are uint8, [H, W, 3] each."""
    if isinstance(frames, np.ndarray) and frames.ndim == 3:
        frames = [frames]
    return Shown(frames, fps)


def show_worlds(
    x: Tensor, s: Tensor, *, fps: float = 12.5, pixel_size: float | None = None, **drawing: Any
) -> Shown:
    """Return a picture of worlds side by side for a notebook, or the film of a trajectory.

    Args:
        x: Particle positions [length units], shape [B, N, D], or [K, B, N, D] of a trajectory, as
            `rollout(..., keep_every=...)` returns it.
        s: Particle states (dimensionless), shape [B, N, C] or [K, B, N, C]; for a rule with a
            read-out give `rule.read_out(s)`.
        fps: Frames per second of a film.
        pixel_size: Usual distance of neighbours [length units]; None: estimated at the last step.
        drawing: Further arguments of `draw_worlds`.
    """
    tensors = isinstance(x, Tensor) and isinstance(s, Tensor)
    if not tensors or x.ndim != s.ndim or (x.ndim == 4 and len(x) != len(s)):
        sizes = [tuple(each.shape) if isinstance(each, Tensor) else shown(each) for each in (x, s)]
        raise NPAError(
            "x and s must be tensors of shape [B, N, D] and [B, N, C], or with the same number of "
            f"steps in front, got {sizes[0]} and {sizes[1]}: give what rollout returns"
        )
    steps = [(x, s)] if x.ndim != 4 else list(zip(x, s, strict=True))
    if 0 in x.shape:
        raise NPAError(f"x must hold at least one particle, got shape {tuple(x.shape)}")
    drawing["pixel_size"] = _spacing(steps[-1][0]) if pixel_size is None else pixel_size
    drawn = (draw_worlds(a[:MAX_SHOWN], b[:MAX_SHOWN], **drawing) for a, b in steps)
    return Shown(map(side_by_side, drawn), fps)


def side_by_side(pictures: NDArray[np.uint8]) -> Frame:
    """Return pictures [B, R, R, 3] as one, uint8, row by row in a nearly square grid."""
    count = len(pictures)
    across = math.ceil(math.sqrt(count))
    down = math.ceil(count / across)
    padding = ((0, across * down - count), (0, _GAP), (0, _GAP), (0, 0))
    cells = np.pad(pictures, padding, constant_values=255)
    _, height, width, _ = cells.shape
    rows = cells.reshape(down, across, height, width, 3).swapaxes(1, 2)
    return rows.reshape(down * height, across * width, 3)[:-_GAP, :-_GAP]


def _spacing(x: Tensor) -> float:
    """Return the usual distance of neighbours in the first world, from the area they cover."""
    points = x[0].detach().double()
    points = points[points.isfinite().all(dim=-1)]
    if not len(points):
        return 1.0
    count, space_dim = points.shape
    spans = (points.amax(dim=0) - points.amin(dim=0)).clamp(min=1e-6)
    # About four particles in a cell.
    side = (float(spans.prod()) * 4 / count) ** (1.0 / space_dim)
    filled = len(torch.unique(torch.floor(points / side), dim=0))
    return max(float((filled / count) ** (1.0 / space_dim) * side), 1e-6)


# A window on the screen, which needs pygame.

_open_window: Window | None = None
"""The open window of this process, or None: pygame allows one for each process."""


class Window:
    """A window on the screen, by pygame. Without a screen it warns, and its methods do nothing.

    A process has one window: a new one closes the previous one.

    Args:
        title: Text of the title bar.
        size: Side of the square window [screen pixels]. Frames of another size are scaled to it.
        fps: Maximum number of frames per second, kept by waiting in `show`; None: no limit.
    """

    def __init__(self, title: str, size: int = 512, *, fps: float | None = None) -> None:
        global _open_window
        if fps is not None:
            check_rate(fps)
        self.size = (checked_side("size", size),) * 2
        """Width and height [screen pixels]."""
        self.fps = fps
        self.closed = False
        """Whether the window was closed, by the user, by `close` or by a new window."""
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        # SDL would turn SIGTERM into a QUIT event of the window.
        os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")
        hint = "pip install 'npa-envs[human]', or use render_mode='rgb_array'"
        with importing("pygame", "a window", hint), warnings.catch_warnings():
            # pygame's use of setuptools is deprecated.
            warnings.simplefilter("ignore")
            self._pygame = importlib.import_module("pygame")
        self._clock = self._pygame.time.Clock()
        self._surface: Any = None
        if _open_window is not None:
            _open_window.close()
        reason = self._open(title)
        if reason is None:
            _open_window = self
        else:
            warnings.warn(
                f"there is no screen to open a window on ({reason}): nothing will be shown; for "
                "pictures without a screen use render_mode='rgb_array'",
                stacklevel=2,
            )

    def show(self, frame: Frame) -> None:
        """Show a frame, uint8, [H, W, 3], and wait as `fps` requires; do nothing if closed."""
        (pixels,) = checked_frames([frame])
        if self._surface is None:
            return
        # Another library of the process may have shut the display down.
        pygame = self._pygame
        shut_down = not pygame.display.get_init()
        if shut_down or any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            return
        # pygame counts columns first.
        picture = pygame.surfarray.make_surface(pixels.swapaxes(0, 1))
        if picture.get_size() != self.size:
            picture = pygame.transform.smoothscale(picture, self.size)
        self._surface.blit(picture, (0, 0))
        pygame.display.flip()
        if self.fps is not None:
            self._clock.tick(self.fps)

    def close(self) -> None:
        """Close the window; closing it again does nothing."""
        global _open_window
        self.closed = True
        if self._surface is not None:
            self._surface = None
            _open_window = None
            self._pygame.display.quit()

    def _open(self, title: str) -> str | None:
        """Open the window; return None, or the reason why it cannot be opened, as text."""
        display = self._pygame.display
        try:
            display.init()
            driver = display.get_driver()
            # The drivers without a screen may be selected by name.
            if driver not in ("offscreen", "dummy") or os.environ.get("SDL_VIDEODRIVER") == driver:
                self._surface = display.set_mode(self.size)
                display.set_caption(title)
                return None
            reason = f"SDL found only its driver {shown(driver)}"
        except self._pygame.error as error:
            reason = str(error)
        display.quit()
        return reason
