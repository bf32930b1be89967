"""Targets to grow in 2D: coloured points of a picture, an emoji or a built-in drawing."""

from __future__ import annotations

import colorsys
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageColor, ImageDraw
from torch import Tensor

from npa_envs.checks import check_count, is_real
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.files import home_path
from npa_envs.tasks.targets.emoji import is_emoji, render_emoji
from npa_envs.tasks.targets.images import (
    MAX_POINT_COUNT,
    OPAQUE,
    looks_like_path,
    open_image,
    read_image,
    require_opaque_pixels,
    resample,
    with_background,
)


@dataclass(frozen=True, eq=False)
class PointTarget:
    """A picture as points: one for each opaque pixel of a square grid."""

    name: str
    """The built-in name, the emoji, or the picture file's name without its suffix."""

    points: Tensor
    """Pixel centres [length units], shape [M, 2], float32, y upwards, their mean at the origin."""

    colours: Tensor
    """Red, green and blue of each point in [0, 1] (dimensionless), shape [M, 3], float32."""

    pixel_size: float
    """Distance h between neighbouring points [length units]."""

    @property
    def point_count(self) -> int:
        """Number of points M."""
        return self.points.shape[0]

    @property
    def mean_colour(self) -> Tensor:
        """Mean red, green and blue of the points (dimensionless), shape [3]."""
        return self.colours.mean(dim=0)

    def to(self, device: str | torch.device) -> PointTarget:
        """Return the same target with its tensors on another device."""
        return replace(self, points=self.points.to(device), colours=self.colours.to(device))


def builtin_targets() -> tuple[str, ...]:
    """Return the names of the targets that come with the package, in alphabetical order."""
    return tuple(sorted(DRAWINGS))


def load_target(
    source: str | Path,
    *,
    point_count: int = 4096,
    extent: float = 1.8,
    keep_background: bool = False,
    device: str | torch.device = "cpu",
) -> PointTarget:
    """Make a target from a built-in name, a picture file or an emoji.

    A string is a built-in name if there is one, else a path if the file exists or the string has a
    suffix or a folder in it, else an emoji. A `Path` is always a path. Pixels with an alpha of at
    least one half become points; the plain background of a picture without transparency is removed.

    Args:
        source: A name from `builtin_targets`, the path of a PNG, JPEG or WebP file, or one emoji.
        point_count: Number of points; the result may differ by a few, as the picture allows.
        extent: Side of the smallest square around the origin, the mean of the points, that contains
            the target [length units]. Pictures show [-1, 1]; the default leaves a margin of 0.1.
        keep_background: Use the picture's whole rectangle, white where it is transparent: for
            photographs.
        device: Where the tensors are made.

    Raises:
        NPAError: The name is unknown, the file is missing, unreadable, damaged or fully
            transparent, it has neither transparency nor a plain background, it is too thin for so
            few points, or a number is out of range.
        MissingDependencyError: An emoji is asked for, and no colour-emoji font is installed.
    """
    check_count("point_count", point_count, ": try 4096", at_most=MAX_POINT_COUNT)
    if not is_real(extent) or extent <= 0:
        raise NPAError(
            f"extent must be finite and above 0 length units, got {shown(extent)}: try 1.8"
        )
    name, image = load_target_image(source, keep_background=keep_background)
    return target_from_image(
        image, name=name, point_count=point_count, extent=extent, device=device
    )


def load_target_image(
    source: str | Path, *, keep_background: bool = False
) -> tuple[str, Image.Image]:
    """Return the name and the full-size RGBA picture of what `load_target` accepts as source."""
    if not isinstance(source, str | Path):
        raise NPAError(
            f"target must be a string or a Path, got {type(source).__name__}: "
            "for a Pillow picture in memory use target_from_image"
        )
    if isinstance(source, str) and source in DRAWINGS:
        name, image = source, _drawing(source).copy()
    elif isinstance(source, Path) or looks_like_path(source):
        path = home_path(source)
        name, image = path.stem, (open_image if keep_background else read_image)(path)
    elif is_emoji(source):
        name, image = source, render_emoji(source)
    else:
        raise NPAError(
            "target must be a built-in name, the path of a picture file or one emoji, got "
            f"{shown(source)}: {suggest(source, DRAWINGS)}"
        )
    return name, with_background(image) if keep_background else image


@functools.cache
def _drawing(name: str) -> Image.Image:
    """Return a built-in picture, from a cache."""
    return DRAWINGS[name]()


def target_from_image(
    image: Image.Image,
    *,
    name: str,
    point_count: int = 4096,
    extent: float = 1.8,
    device: str | torch.device = "cpu",
) -> PointTarget:
    """Make a target from the opaque pixels of a picture; it fits into a square of side `extent`."""
    rgba = image.convert("RGBA")
    require_opaque_pixels(rgba, label=name)
    pixels = np.array(resample(rgba, point_count, label=name))
    rows, columns = np.nonzero(pixels[..., 3] >= OPAQUE)
    grid = np.stack([columns, -rows], axis=1).astype(np.float64)
    grid -= grid.mean(axis=0)
    # Half a pixel more on either side: a point represents a square of one pixel.
    pixel_size = extent / (2 * float(np.abs(grid).max()) + 1)
    colours = pixels[rows, columns, :3].astype(np.float32) / 255
    return PointTarget(
        name=name,
        points=torch.tensor(grid * pixel_size, dtype=torch.float32, device=device),
        colours=torch.tensor(colours, dtype=torch.float32, device=device),
        pixel_size=pixel_size,
    )


# Built-in targets: silhouettes as masks, painted one over the other. Coordinates are in [-1, 1], y
# upwards. Everything is drawn at three times the final size and averaged down for smooth edges.

SIDE = 512
"""Side of a finished drawing [pixels]."""

_OVERSAMPLING = 3
_WORK_SIDE = SIDE * _OVERSAMPLING

Points = Sequence[tuple[float, float]]


def smooth_curve(points: Points, *, closed: bool = False, steps: int = 16) -> Points:
    """Return a Catmull-Rom curve through the points, with `steps` samples between two."""
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
    """Return the points rotated by `angle` [degrees, counterclockwise], then moved by `centre`."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return [(centre[0] + c * x - s * y, centre[1] + s * x + c * y) for x, y in points]


def mirror(points: Points) -> Points:
    """Return the points reflected left to right."""
    return [(-x, y) for x, y in points]


def union(*masks: Image.Image) -> Image.Image:
    """Return the union of the masks."""
    whole = masks[0]
    for mask in masks[1:]:
        whole = ImageChops.lighter(whole, mask)
    return whole


def polygon(points: Points, *, grow: float = 0) -> Image.Image:
    """Return the mask of a filled polygon, dilated by `grow`."""
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
    """Return the mask of an ellipse with the two radii, rotated by `angle` [degrees]."""
    a, b = radii[0] + grow, radii[1] + grow
    turn = np.linspace(0, 2 * math.pi, 96, endpoint=False)
    outline = [(a * math.cos(t), b * math.sin(t)) for t in turn]
    return polygon(place(outline, centre=centre, angle=angle))


def stroke(points: Points, widths: Sequence[float], *, grow: float = 0) -> Image.Image:
    """Return the mask of a stroke along a smooth curve: `widths` at even distances, + 2 `grow`."""
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
    """Return an RGBA picture that maps `amount` in [0, 1] to a gradient of colours."""
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
        """Paint the mask, or its intersection with `within`, with a colour or a picture."""
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
        """Paint disks (x, y, radius) with a colour."""
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


def draw_gecko() -> Image.Image:
    """A gecko from above: spots, four legs with splayed toes, a tail that curls."""
    canvas, line = Canvas(), 0.03
    spine = [(0.06, 0.5), (-0.03, 0.26), (-0.08, 0.0), (-0.03, -0.24), (0.08, -0.42)]
    tail = [
        (0.08, -0.42), (0.16, -0.62), (0.08, -0.79), (-0.12, -0.84), (-0.34, -0.77),
        (-0.52, -0.8),
    ]  # fmt: skip
    head = [
        (0.04, 0.4), (-0.12, 0.58), (-0.08, 0.8), (0.12, 0.94), (0.31, 0.86), (0.36, 0.66),
        (0.24, 0.44),
    ]  # fmt: skip
    legs = [
        ([(0.02, 0.28), (0.28, 0.22), (0.5, 0.36)], 38),
        ([(-0.06, 0.28), (-0.32, 0.3), (-0.52, 0.5)], 132),
        ([(0.02, -0.28), (0.3, -0.24), (0.5, -0.42)], -42),
        ([(-0.02, -0.24), (-0.32, -0.18), (-0.54, -0.34)], -135),
    ]

    def silhouette(grow: float) -> Image.Image:
        parts = [
            stroke(spine, [0.28, 0.36, 0.46, 0.4, 0.28], grow=grow),
            stroke(tail, [0.28, 0.25, 0.22, 0.19, 0.16, 0.11], grow=grow),
            polygon(smooth_curve(head, closed=True), grow=grow),
        ]
        for path, facing in legs:
            parts.append(stroke(path, [0.22, 0.19, 0.16], grow=grow))
            foot = path[-1]
            for spread in (-72, -24, 24, 72):
                tip = place([(0.19, 0.0)], centre=foot, angle=facing + spread)[0]
                parts.append(stroke([foot, tip], [0.1, 0.085], grow=grow))
                parts.append(ellipse(tip, (0.055, 0.055), grow=grow))
        return union(*parts)

    canvas.paint(silhouette(line), "#15803d")
    body = silhouette(0)
    _, y = grid()
    canvas.paint(body, gradient((0.95 - y) / 1.9, "#a3e635", "#4ade80", "#22c55e", "#0d9488"))
    canvas.paint(stroke(spine, [0.08, 0.13, 0.18, 0.13, 0.08]), "#d9f99d", within=body)
    spots = (
        (0.03, 0.38, 0.062), (-0.12, 0.17, 0.066), (0.05, 0.06, 0.07), (-0.14, -0.1, 0.068),
        (0.03, -0.22, 0.066), (0.08, -0.46, 0.058),
    )  # fmt: skip
    canvas.paint_dots("#f97316", spots, within=body)
    bands = ((0.13, -0.66, -10), (-0.02, -0.83, -80), (-0.24, -0.81, -105), (-0.42, -0.78, -90))
    for bx, by, angle in bands:
        canvas.paint(ellipse((bx, by), (0.16, 0.04), angle=angle), "#fde047", within=body)
    for centre in ((0.0, 0.73), (0.27, 0.76)):
        canvas.paint(ellipse(centre, (0.09, 0.09)), "#fef08a")
        canvas.paint(ellipse(centre, (0.05, 0.06), angle=-15), "#1e293b")
    return canvas.finish()


def draw_heart() -> Image.Image:
    """A red heart with a dark outline and a highlight."""
    canvas = Canvas()
    turns = np.linspace(0, 2 * math.pi, 240, endpoint=False)
    outline = [
        (
            16 * math.sin(t) ** 3 / 18.5,
            (13 * math.cos(t) - 5 * math.cos(2 * t) - 2 * math.cos(3 * t) - math.cos(4 * t) + 2.5)
            / 18.5,
        )
        for t in turns
    ]
    body = polygon(outline)
    canvas.paint(polygon(outline, grow=0.055), "#7f1d1d")
    x, y = grid()
    amount = np.hypot(x + 0.35, y - 0.4) / 1.5
    canvas.paint(body, gradient(amount, "#ff6b81", "#f43f5e", "#e11d48", "#9f1239"))
    shine = [(-0.64, 0.2), (-0.62, 0.44), (-0.46, 0.58), (-0.27, 0.57)]
    canvas.paint(stroke(shine, [0.06, 0.13, 0.13, 0.06]), "#ffe4e6", within=body)
    canvas.paint(ellipse((-0.58, 0.03), (0.055, 0.055)), "#ffe4e6", within=body)
    return canvas.finish()


def draw_letter_a() -> Image.Image:
    """A capital A with serifs, an outline and a seam of light."""
    canvas, line = Canvas(), 0.035
    left = [(-0.7, -0.8), (-0.52, -0.8), (0.06, 0.86), (-0.12, 0.86)]
    right = [(0.3, -0.8), (0.7, -0.8), (0.14, 0.86), (-0.2, 0.86)]
    bar = [(-0.45, -0.34), (-0.4, -0.16), (0.4, -0.16), (0.44, -0.34)]
    feet = [
        [(-0.9, -0.94), (-0.9, -0.84), (-0.7, -0.76), (-0.5, -0.76), (-0.3, -0.84), (-0.3, -0.94)],
        [(0.07, -0.94), (0.07, -0.84), (0.28, -0.76), (0.69, -0.76), (0.95, -0.84), (0.95, -0.94)],
        [(-0.36, 0.94), (-0.34, 0.84), (-0.1, 0.78), (0.14, 0.78), (0.28, 0.84), (0.3, 0.94)],
    ]  # fmt: skip
    parts = [left, right, bar, *feet]
    canvas.paint(union(*(polygon(p, grow=line) for p in parts)), "#1e1b4b")
    body = union(*(polygon(p) for p in parts))
    x, y = grid()
    amount = (0.95 - y + 0.3 * x) / 2
    canvas.paint(body, gradient(amount, "#fb923c", "#ec4899", "#8b5cf6", "#2563eb"))
    canvas.paint(stroke([(0.0, 0.66), (0.46, -0.7)], [0.05, 0.07]), "#fde68a", within=body)
    return canvas.finish()


def draw_ring() -> Image.Image:
    """A ring around the colour wheel, with a thin inner ring on eight spokes."""
    canvas = Canvas()
    x, y = grid()
    hue = ((np.arctan2(y, x) / (2 * math.pi)) % 1.0).astype(np.float32)
    stops = [colorsys.hsv_to_rgb(k / 12, 0.9, 1.0) for k in range(13)]
    wheel = ["#" + "".join(f"{round(255 * v):02x}" for v in rgb) for rgb in stops]

    def band(inner: float, outer: float) -> Image.Image:
        return ImageChops.subtract(ellipse((0, 0), (outer, outer)), ellipse((0, 0), (inner, inner)))

    for k in range(8):
        spoke = [(0.36, 0.0), (0.7, 0.0)]
        canvas.paint(stroke(place(spoke, angle=45 * k + 22.5), [0.07, 0.07]), "#475569")
    canvas.paint(band(0.66, 0.96), "#1e293b")
    canvas.paint(band(0.7, 0.92), gradient(hue, *wheel))
    canvas.paint(band(0.3, 0.4), gradient(1 - hue, *wheel))
    return canvas.finish()


def draw_butterfly() -> Image.Image:
    """A butterfly with rimmed, spotted wings, a striped body and clubbed antennae."""
    canvas, line = Canvas(), 0.055
    upper = [
        (0.04, 0.12), (0.2, 0.5), (0.56, 0.84), (0.88, 0.82), (0.9, 0.5), (0.7, 0.14),
        (0.36, -0.02),
    ]  # fmt: skip
    lower = [
        (0.04, 0.02), (0.4, 0.0), (0.68, -0.18), (0.72, -0.46), (0.54, -0.62), (0.5, -0.84),
        (0.38, -0.66), (0.14, -0.36),
    ]  # fmt: skip
    x, y = grid()
    distance = np.hypot(x, y - 0.05)
    warm = gradient(distance / 1.05, "#fef08a", "#fbbf24", "#f97316", "#dc2626")
    cool = gradient(distance / 0.9, "#a5f3fc", "#38bdf8", "#2563eb", "#6d28d9")
    wings = (
        (smooth_curve(upper, closed=True), warm),
        (smooth_curve(lower, closed=True), cool),
    )
    for side in (list, mirror):
        for outline, _ in wings:
            canvas.paint(polygon(side(outline), grow=line), "#1c1917")
        for outline, colours in reversed(wings):
            canvas.paint(polygon(side(outline)), colours)
        for vein in (
            [(0.08, 0.14), (0.34, 0.42), (0.72, 0.8)],
            [(0.08, 0.1), (0.42, 0.26), (0.86, 0.46)],
        ):
            canvas.paint(stroke(side(vein), [0.03, 0.03]), "#1c1917")
        (px, py), (qx, qy), (rx, ry), (ex, ey) = side(
            [(0.76, 0.66), (0.6, 0.58), (0.66, 0.28), (0.48, -0.32)]
        )
        canvas.paint_dots("#fef9c3", ((px, py, 0.075), (qx, qy, 0.05), (rx, ry, 0.06)))
        for colour, size in (("#1e1b4b", 0.14), ("#f472b6", 0.095), ("#fef9c3", 0.045)):
            canvas.paint_dots(colour, ((ex, ey, size),))
        feeler = side([(0.02, 0.36), (0.1, 0.62), (0.26, 0.85)])
        canvas.paint(stroke(feeler, [0.06, 0.055]), "#1c1917")
        canvas.paint(ellipse(feeler[-1], (0.07, 0.055)), "#1c1917")
    canvas.paint(stroke([(0, 0.26), (0, 0.0), (0, -0.5)], [0.16, 0.19, 0.17, 0.08]), "#1c1917")
    canvas.paint(ellipse((0, 0.35), (0.1, 0.1)), "#1c1917")
    for y0 in (0.12, -0.02, -0.16, -0.3):
        canvas.paint(ellipse((0, y0), (0.06, 0.025)), "#f59e0b")
    return canvas.finish()


def draw_octopus() -> Image.Image:
    """An octopus with eight curling arms."""
    canvas, line = Canvas(), 0.03
    right = [
        [(0.22, -0.02), (0.5, 0.1), (0.76, 0.02), (0.9, 0.2), (0.76, 0.34)],
        [(0.24, -0.12), (0.56, -0.16), (0.74, -0.34), (0.92, -0.26)],
        [(0.18, -0.2), (0.42, -0.44), (0.52, -0.72), (0.74, -0.76), (0.78, -0.6)],
        [(0.08, -0.2), (0.16, -0.54), (0.1, -0.82), (0.26, -0.92)],
    ]
    arms = [*right, *(mirror(a) for a in right)]
    head = [
        (0, 0.94), (0.32, 0.82), (0.43, 0.5), (0.32, 0.16), (0.28, -0.14), (0, -0.26),
        (-0.28, -0.14), (-0.32, 0.16), (-0.43, 0.5), (-0.32, 0.82),
    ]  # fmt: skip

    def silhouette(grow: float) -> Image.Image:
        return union(
            polygon(smooth_curve(head, closed=True), grow=grow),
            *(stroke(a, [0.2, 0.16, 0.12, 0.08], grow=grow) for a in arms),
        )

    canvas.paint(silhouette(line), "#4c1d95")
    body = silhouette(0)
    x, y = grid()
    amount = np.hypot(x, y - 0.5) / 1.5
    canvas.paint(body, gradient(amount, "#f0abfc", "#d946ef", "#a855f7", "#fb7185", "#fdba74"))
    for arm in arms:
        suckers = [(px, py, 0.03) for px, py in smooth_curve(arm, steps=3)[3:]]
        canvas.paint_dots("#fff1f2", suckers, within=body)
    canvas.paint_dots("#fae8ff", ((-0.2, 0.66, 0.06), (0.04, 0.78, 0.05), (0.22, 0.62, 0.045)))
    for side in (-1, 1):
        canvas.paint(ellipse((0.16 * side, 0.3), (0.12, 0.14)), "#ffffff")
        canvas.paint(ellipse((0.14 * side, 0.28), (0.065, 0.085)), "#111827")
        canvas.paint(ellipse((0.14 * side + 0.025, 0.32), (0.025, 0.025)), "#ffffff")
    canvas.paint(stroke([(-0.1, 0.06), (0, 0.02), (0.1, 0.06)], [0.04, 0.05, 0.04]), "#4c1d95")
    return canvas.finish()


def draw_flower() -> Image.Image:
    """A sunflower with a stem and two leaves."""
    canvas, line, middle = Canvas(), 0.026, (0.0, 0.32)
    stem = [(0.0, 0.1), (0.05, -0.3), (-0.03, -0.62), (0.02, -0.9)]
    leaf = smooth_curve(
        [(0.0, -0.74), (0.16, -0.44), (0.44, -0.32), (0.7, -0.36), (0.56, -0.62), (0.3, -0.78)],
        closed=True,
    )
    for outline in (leaf, [(0.9 * x, y - 0.06) for x, y in mirror(leaf)]):
        canvas.paint(polygon(outline, grow=line), "#14532d")
        canvas.paint(polygon(outline), "#4ade80")
        (ax, ay), (bx, by) = outline[16], outline[80]
        rib = [outline[0], ((ax + bx) / 2, (ay + by) / 2), outline[40]]
        canvas.paint(stroke(rib, [0.05, 0.035]), "#15803d")
    canvas.paint(stroke(stem, [0.11, 0.11], grow=line), "#14532d")
    canvas.paint(stroke(stem, [0.11, 0.11]), "#22c55e")
    x, y = grid()
    amount = np.hypot(x - middle[0], y - middle[1]) / 0.66
    petals = gradient(amount, "#ea580c", "#f97316", "#facc15", "#fef08a")
    petal = smooth_curve(
        [(0.2, 0.07), (0.42, 0.1), (0.62, 0.0), (0.42, -0.1), (0.2, -0.07)], closed=True
    )
    for ring in (15, 0):
        for k in range(12):
            shape = place(petal, centre=middle, angle=30 * k + ring)
            canvas.paint(polygon(shape, grow=line), "#9a3412")
            canvas.paint(polygon(shape), petals)
    canvas.paint(ellipse(middle, (0.28, 0.28)), "#431407")
    canvas.paint(ellipse(middle, (0.24, 0.24)), "#7c2d12")
    seeds = []
    for k in range(40):
        radius, turn = 0.215 * math.sqrt((k + 0.5) / 40), k * math.pi * (3 - math.sqrt(5))
        seeds.append((radius * math.cos(turn), middle[1] + radius * math.sin(turn), 0.018))
    canvas.paint_dots("#fbbf24", seeds)
    return canvas.finish()


DRAWINGS: dict[str, Callable[[], Image.Image]] = {
    "butterfly": draw_butterfly,
    "flower": draw_flower,
    "gecko": draw_gecko,
    "heart": draw_heart,
    "letter-a": draw_letter_a,
    "octopus": draw_octopus,
    "ring": draw_ring,
}
"""Every built-in target by name; each draws an RGBA picture."""
