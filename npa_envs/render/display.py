"""Pictures and films in notebooks."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.render.film import Frame, check_rate, checked_frames, encode_frame, encode_webp
from npa_envs.render.worlds import draw_worlds

MOST_SHOWN = 16
"""Most worlds side by side."""

_CELL_PARTICLES = 4
_GAP = 4


class Shown:
    """A picture or a repeating film, which a notebook displays as the value of a cell.

    Args:
        frames: Pictures of one size, uint8, shape [H, W, 3] each.
        fps: Frames a second of a film.
    """

    def __init__(self, frames: list[Frame], fps: float) -> None:
        self.frames = frames
        self.fps = fps

    def __repr__(self) -> str:
        height, width, _ = self.frames[0].shape
        if len(self.frames) == 1:
            return f"a picture of {width} × {height} pixels"
        return f"a film of {len(self.frames)} pictures of {width} × {height} pixels"

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """Return a JPEG, a tenth of a PNG, or a film within HTML, which more programs show."""
        shown: dict[str, Any] = {"text/plain": repr(self)}
        if len(self.frames) == 1:
            return shown | {"image/jpeg": _base64(encode_frame(self.frames[0], "JPEG"))}
        film = _base64(encode_webp(self.frames, self.fps))
        return shown | {"text/html": f'<img alt="{self!r}" src="data:image/webp;base64,{film}">'}


def show(frames: Frame | Iterable[Frame], *, fps: float = 25.0) -> Shown:
    """Return one picture [H, W, 3], as of `env.render()`, or several as a film for a notebook."""
    check_rate(fps)
    if isinstance(frames, np.ndarray) and frames.ndim == 3:
        return Shown(checked_frames([frames]), fps)
    return Shown(checked_frames(frames), fps)


def show_worlds(
    x: Tensor, s: Tensor, *, fps: float = 12.5, pixel_size: float | None = None, **drawing: Any
) -> Shown:
    """Return worlds side by side for a notebook; a trajectory becomes a film.

    Args:
        x: Particle positions [length units], shape [B, N, D], or [K, B, N, D] of a trajectory, as
            `rollout(..., keep_every=...)` returns it.
        s: Particle states (dimensionless), shape [B, N, C] or [K, B, N, C]; of a rule with a
            read-out the value of `rule.read_out(s)`.
        fps: Frames a second of a film.
        pixel_size: Distance between particles [length units]; None: that of the last step.
        drawing: Other arguments of `draw_worlds`.
    """
    check_rate(fps)
    if not (isinstance(x, Tensor) and isinstance(s, Tensor) and x.ndim == s.ndim):
        raise NPAError(
            "x and s must be tensors of shape [B, N, D] and [B, N, C], or with one dimension "
            "more at the front: give what rollout returns"
        )
    if x.ndim == 4 and len(x) != len(s):
        raise NPAError(
            f"x and s must have as many steps, got {len(x)} and {len(s)}: give what rollout returns"
        )
    steps = [(x, s)] if x.ndim != 4 else list(zip(x, s, strict=True))
    if not steps or 0 in x.shape:
        raise NPAError(f"x must hold at least one particle, got shape {tuple(x.shape)}")
    spacing = _spacing(steps[-1][0]) if pixel_size is None else pixel_size
    frames = [
        side_by_side(draw_worlds(a[:MOST_SHOWN], b[:MOST_SHOWN], pixel_size=spacing, **drawing))
        for a, b in steps
    ]
    return Shown(frames, fps)


def side_by_side(pictures: NDArray[np.uint8]) -> Frame:
    """Return pictures [B, R, R, 3] as one, in rows of about as many as there are rows."""
    count, height, width, _ = pictures.shape
    across = math.ceil(math.sqrt(count))
    down = math.ceil(count / across)
    sheet = np.full(
        (down * (height + _GAP) - _GAP, across * (width + _GAP) - _GAP, 3), 255, np.uint8
    )
    for k, picture in enumerate(pictures):
        top, left = (k // across) * (height + _GAP), (k % across) * (width + _GAP)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _spacing(x: Tensor) -> float:
    """Return the distance between particles of the first world, by the cells that they fill."""
    places = x[0].detach().double()
    places = places[places.isfinite().all(dim=-1)]
    if not len(places):
        return 1.0
    count, space_dim = places.shape
    extent = (places.amax(dim=0) - places.amin(dim=0)).clamp(min=1e-6)
    side = (float(extent.prod()) * _CELL_PARTICLES / count) ** (1.0 / space_dim)
    filled = len(torch.unique(torch.floor(places / side), dim=0))
    spacing: float = (filled / count) ** (1.0 / space_dim) * side
    return max(spacing, 1e-6)
