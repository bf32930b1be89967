"""A small drawing surface on Pillow: silhouettes as masks, painted one over the other.

Coordinates are in [-1, 1], y upwards. Everything is drawn at three times the final size and
averaged down, so that edges come out smooth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageColor, ImageDraw

SIDE = 512
"""Side of a finished drawing [pixels]."""

_OVERSAMPLING = 3
_WORK_SIDE = SIDE * _OVERSAMPLING

Points = Sequence[tuple[float, float]]


def smooth_curve(points: Points, *, closed: bool = False, steps: int = 16) -> Points:
    """Return a Catmull-Rom curve through the points.

    Args:
        points: Corner points, in drawing coordinates.
        closed: Whether the last point joins the first.
        steps: Samples between two corner points.
    """
    corner = np.asarray(points, dtype=np.float64)
    if closed:
        padded = np.concatenate([corner[-1:], corner, corner[:2]])
    else:
        padded = np.concatenate([corner[:1], corner, corner[-1:]])
    t = (np.arange(steps) / steps)[:, None]
    pieces = []
    for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        linear, square, cube = c - a, 2 * a - 5 * b + 4 * c - d, 3 * b - a - 3 * c + d
        pieces.append(b + 0.5 * t * (linear + t * (square + t * cube)))
    if not closed:
        pieces.append(corner[-1:])
    return [(float(x), float(y)) for x, y in np.concatenate(pieces)]


def place(points: Points, *, centre: tuple[float, float] = (0, 0), angle: float = 0) -> Points:
    """Turn the points about the origin by `angle` [degrees, counter-clockwise], then move them."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return [(centre[0] + c * x - s * y, centre[1] + s * x + c * y) for x, y in points]


def mirror(points: Points) -> Points:
    """Return the points reflected left to right."""
    return [(-x, y) for x, y in points]


def union(*masks: Image.Image) -> Image.Image:
    """Return the silhouette that covers all of the masks."""
    whole = masks[0]
    for mask in masks[1:]:
        whole = ImageChops.lighter(whole, mask)
    return whole


def polygon(points: Points, *, grow: float = 0) -> Image.Image:
    """Return the mask of a filled polygon, widened on every side by `grow`."""
    mask, draw = _blank()
    corners = [_pixel(p) for p in points]
    draw.polygon(corners, fill=255)
    if grow > 0:
        radius = grow * _WORK_SIDE / 2
        draw.line([*corners, corners[0]], fill=255, width=max(1, round(2 * radius)))
        for x, y in corners:
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
    return mask


def ellipse(
    centre: tuple[float, float], radii: tuple[float, float], *, angle: float = 0, grow: float = 0
) -> Image.Image:
    """Return the mask of an ellipse with the two radii, turned by `angle` [degrees]."""
    a, b = radii[0] + grow, radii[1] + grow
    turn = np.linspace(0, 2 * math.pi, 96, endpoint=False)
    outline = [(a * math.cos(t), b * math.sin(t)) for t in turn]
    return polygon(place(outline, centre=centre, angle=angle))


def stroke(points: Points, widths: Sequence[float], *, grow: float = 0) -> Image.Image:
    """Return the mask of a brush stroke along a smooth curve, with round ends.

    Args:
        points: Points on the curve.
        widths: Widths of the stroke, spread evenly along the curve and interpolated in between.
        grow: How far the stroke is widened on each side.
    """
    mask, draw = _blank()
    curve = np.asarray(smooth_curve(points))
    lengths = np.hypot(*np.diff(curve, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    stops = np.linspace(0, along[-1], max(2, int(along[-1] * 200)))
    middle = np.stack([np.interp(stops, along, curve[:, k]) for k in range(2)], axis=1)
    knots = np.linspace(0, along[-1], len(widths))
    radii = (np.interp(stops, knots, widths) / 2 + grow) * _WORK_SIDE / 2
    for centre, radius in zip(middle, radii, strict=True):
        x, y = _pixel((centre[0], centre[1]))
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
    return mask


def grid() -> tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]]:
    """Return the coordinates x and y of every pixel of the working picture."""
    axis = ((np.arange(_WORK_SIDE) + 0.5) * 2 / _WORK_SIDE - 1).astype(np.float32)
    x, y = np.meshgrid(axis, -axis)
    return x, y


def gradient(amount: NDArray[np.floating[Any]], *colours: str) -> Image.Image:
    """Return an RGBA picture that runs through the colours as `amount` goes from 0 to 1."""
    stops = np.linspace(0, 1, len(colours))
    rgb = np.array([ImageColor.getrgb(c)[:3] for c in colours], dtype=np.float32)
    channels = [np.interp(amount, stops, rgb[:, k]) for k in range(3)]
    return Image.fromarray(np.stack(channels, axis=-1).round().astype(np.uint8)).convert("RGBA")


class Canvas:
    """A transparent square picture that silhouettes are painted on."""

    def __init__(self) -> None:
        self._image = Image.new("RGBA", (_WORK_SIDE, _WORK_SIDE), (0, 0, 0, 0))

    def paint(
        self, mask: Image.Image, paint: str | Image.Image, *, within: Image.Image | None = None
    ) -> None:
        """Cover the mask with a colour or a picture.

        Args:
            mask: What is painted.
            paint: A colour such as "#20a040", or a picture of the working size (see `gradient`).
            within: Another mask that the paint must not leave.
        """
        if within is not None:
            mask = ImageChops.darker(mask, within)
        if isinstance(paint, str):
            self._image.paste(ImageColor.getrgb(paint), mask=mask)
        else:
            self._image.paste(paint, mask=mask)

    def paint_dots(
        self,
        colour: str,
        dots: Sequence[tuple[float, float, float]],
        *,
        within: Image.Image | None = None,
    ) -> None:
        """Cover disks, each given by x, y and radius, with a colour."""
        disks = union(*(ellipse((x, y), (radius, radius)) for x, y, radius in dots))
        self.paint(disks, colour, within=within)

    def finish(self) -> Image.Image:
        """Return the drawing at its final size, as an RGBA picture."""
        return self._image.resize((SIDE, SIDE), Image.Resampling.BOX)


def _blank() -> tuple[Image.Image, ImageDraw.ImageDraw]:
    mask = Image.new("L", (_WORK_SIDE, _WORK_SIDE), 0)
    return mask, ImageDraw.Draw(mask)


def _pixel(point: tuple[float, float]) -> tuple[float, float]:
    return ((point[0] + 1) * _WORK_SIDE / 2, (1 - point[1]) * _WORK_SIDE / 2)
