"""Target textures: from picture files, and built-in patterns whose opposite edges fit together.

A pattern is a function of positions (u, v), arrays [H, W] in the periodic unit square. It returns
red, green, blue and alpha there, in [0, 1], [H, W, 4]; alpha is the target's density.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import ImageColor
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from npa_envs.atomic_files import home_path
from npa_envs.checks import check_count
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.tasks.targets.images import (
    is_cut_out,
    looks_like_path,
    opaque_share,
    open_image,
    require_opaque_pixels,
    scaled_square,
    summary_of,
)
from npa_envs.tasks.targets.notes import tell

Array = NDArray[np.floating[Any]]
Pattern = Callable[[Array, Array, np.random.Generator], Array]

Layers = Iterator[tuple[NDArray[np.bool_], Array | float]]
"""Masks [H, W] of the parts of a pattern with their colours; each part covers earlier ones."""


@dataclass(frozen=True, eq=False)
class TextureTarget:
    """A texture on a square of R x R pixels."""

    name: str
    """The built-in name, or the picture file's name without its suffix."""
    picture: Tensor
    """Red, green and blue, each times the density, and the density, dimensionless, shape
    [R, R, 4], float32; the first row is the bottom."""
    tiles: bool
    """Whether opposite edges fit together."""
    summary: str = ""
    """What was read, in one line; empty for a built-in target."""

    @property
    def coverage(self) -> float:
        """Mean density: the fraction of the square that particles should cover (dimensionless)."""
        return float(self.picture[..., 3].double().mean())

    @property
    def gap(self) -> float:
        """Median distance from an object to the nearest other one, as a fraction of the side.

        Objects are connected components of covered pixels; opposite edges are connected. 0 with
        fewer than two objects.
        """
        covered = self.picture[..., 3] > COVERED
        side = len(covered)
        edge = covered & (_neighbour_maximum(~covered) > 0.0)
        owner, position = _component_numbers(covered)[edge], edge.nonzero().double()
        gaps = []
        for number in sorted(set(owner.tolist())):
            apart = position[owner == number][:, None] - position[owner != number]
            if apart.numel() == 0:
                return 0.0
            apart -= side * (apart / side).round()
            # Centres of touching pixels are one pixel apart, with no gap.
            gaps.append(max(0.0, float(apart.square().sum(dim=-1).min()) ** 0.5 - 1.0))
        return median(gaps) / side if gaps else 0.0

    @property
    def mean_colour(self) -> Tensor:
        """Mean red, green and blue where particles should be (dimensionless), shape [3]."""
        sums = self.picture.double().sum(dim=(0, 1))
        return (sums[:3] / sums[3]).to(self.picture)


COVERED = 0.5
"""Density above which a pixel belongs to an object."""


def _component_numbers(covered: Tensor) -> Tensor:
    """Return a number for each pixel's connected component, 0 where not covered, [R, R]."""
    numbers = torch.arange(1, covered.numel() + 1, dtype=torch.float64, device=covered.device)
    number = numbers.view_as(covered) * covered
    while True:
        # The largest number in a component spreads over all of it.
        spread = _neighbour_maximum(number) * covered
        if torch.equal(spread, number):
            return number
        number = spread


def _neighbour_maximum(values: Tensor) -> Tensor:
    """Return the maximum of each pixel and its eight neighbours in a periodic picture [R, R]."""
    wrapped = pad(values.double()[None, None], (1, 1, 1, 1), mode="circular")
    return max_pool2d(wrapped, kernel_size=3, stride=1)[0, 0]


def builtin_textures() -> tuple[str, ...]:
    """Return the names of the textures that come with the package, in alphabetical order."""
    return tuple(sorted(PATTERNS))


def load_texture(
    source: str | Path, *, resolution: int = 128, tiles: bool = False
) -> TextureTarget:
    """Make a target from a built-in name or a picture file.

    The density is the picture's alpha: transparent parts stay empty, and a picture without
    transparency is covered evenly. The largest square in the middle of the picture is scaled to
    `resolution` pixels along each side. `tiles` says whether the opposite edges of a picture file
    fit together, as those of built-in textures do.
    """
    check_count("resolution", resolution, ": try 128", at_most=MAX_RESOLUTION)
    if isinstance(source, str) and source in PATTERNS:
        return _texture_target(source, draw_pattern(source, resolution), True)
    if not isinstance(source, Path) and not (
        isinstance(source, str) and source and looks_like_path(str(home_path(source)))
    ):
        raise NPAError(
            "target must be a built-in texture or the path of a picture file, "
            f"got {shown(source)}: {suggest(source, PATTERNS)}"
        )
    path = home_path(source)
    image = open_image(path)
    require_opaque_pixels(image, label=str(path))
    side = min(image.size)
    if side < 2:
        raise NPAError(
            f"target {shown(str(path))} must have at least 2 x 2 pixels, got {image.width} x "
            f"{image.height}: give a larger picture"
        )
    text = f"its middle square of {side} x {side}, " if image.width != image.height else ""
    text += f"alpha covers {opaque_share(image)}" if is_cut_out(image) else "covered evenly"
    summary = summary_of(path.name, image, text)
    tell(summary)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    square = image.crop((left, top, left + side, top + side))
    target = _texture_target(path.stem, scaled_square(square, resolution)[::-1], tiles)
    return replace(target, summary=summary)


def _texture_target(name: str, picture: Array, tiles: bool) -> TextureTarget:
    """Return the target with a picture of `TextureTarget.picture`'s channels and rows."""
    tensor = torch.tensor(np.ascontiguousarray(picture), dtype=torch.float32)
    return TextureTarget(name, tensor, tiles)


MAX_RESOLUTION = 2048
"""Maximum side of a target [pixels]."""

STRIP_SAMPLES = 2**20
"""Number of samples that are computed at once, in a strip of the picture, about."""

OVERSAMPLING = 4
"""Number of samples along each side of a pixel."""


def draw_pattern(name: str, resolution: int, *, seed: int = 0) -> Array:
    """Return the pattern `name` as a picture [R, R, 4], float64, with the bottom row first.

    Channels are colours times alpha, and alpha. `seed` is that of random shapes.
    """
    samples = resolution * OVERSAMPLING
    axis = (np.arange(samples) + 0.5) / samples
    strips = []
    rows = max(1, STRIP_SAMPLES // samples // OVERSAMPLING) * OVERSAMPLING
    for first in range(0, samples, rows):
        positions = np.meshgrid(axis, axis[first : first + rows])
        # The same random numbers for each strip: scattered shapes stay where they are.
        rgba = PATTERNS[name](*positions, np.random.default_rng(seed))
        rgba[..., :3] *= rgba[..., 3:]
        blocks = rgba.reshape(-1, OVERSAMPLING, resolution, OVERSAMPLING, 4)
        strips.append(blocks.mean(axis=(1, 3)))
    return np.concatenate(strips)


def stripes(u: Array, v: Array, _: np.random.Generator) -> Array:
    """Slanted, slightly waving bands in four colours."""
    phase = 3.0 * u + 2.0 * v + 0.12 * np.sin(2.0 * math.pi * (2.0 * u - 3.0 * v))
    bands = _colours("#1d3557", "#457b9d", "#f1faee", "#e63946")
    return _opaque(bands[np.floor(4.0 * phase).astype(int) % 4])


def cells(u: Array, v: Array, random: np.random.Generator) -> Array:
    """Voronoi cells of random points in warm colours, with dark walls between them."""
    centres = _scattered(random, 20, 0.17)
    distance = np.stack([np.hypot(*_offsets(u, v, centre)) for centre in centres])
    order = np.argsort(distance, axis=0)
    nearest = np.take_along_axis(distance, order[:2], axis=0)
    shades = _colours("#e9c46a", "#f4a261", "#e76f51", "#d4a373", "#faedcd")
    colour = shades[order[0] % len(shades)]
    shine = np.clip(1.15 - 2.2 * nearest[0], 0.55, 1.0)[..., None]
    wall = (nearest[1] - nearest[0] < 0.028)[..., None]
    return _opaque(np.where(wall, _colours("#3d1f14"), colour * shine))


def _painted(layers: Callable[[Array, Array, np.random.Generator], Layers]) -> Pattern:
    """Return the pattern that paints the layers one over the other on a transparent ground."""

    @functools.wraps(layers)
    def pattern(u: Array, v: Array, random: np.random.Generator) -> Array:
        colour = np.zeros((*u.shape, 3))
        covered = np.zeros(u.shape, dtype=bool)
        for mask, tint in layers(u, v, random):
            colour[mask] = tint
            covered |= mask
        return _with_alpha(colour, covered)

    return pattern


@_painted
def dots(u: Array, v: Array, _: np.random.Generator) -> Layers:
    """Rimmed dots of two sorts on a slanted lattice, nothing between them."""
    inner, rim = _colours("#f4a261", "#2a9d8f"), _colours("#6b2d0c", "#0b3b3f")
    for j, k in itertools.product(range(4), range(4)):
        away = np.hypot(*_offsets(u, v, np.array((k / 4.0 + j / 8.0, j / 4.0))))
        yield away < 0.09, rim[k % 2]
        yield away < 0.062, inner[k % 2]


@_painted
def bubbles(u: Array, v: Array, random: np.random.Generator) -> Layers:
    """Rings of several sizes with a glint, nothing around them."""
    centres = _scattered(random, 12, 0.23)
    gaps = [
        min(math.hypot(*_offsets(one[0], one[1], other)) for other in centres if other is not one)
        for one in centres
    ]
    tints = _colours("#48cae4", "#0096c7", "#5e60ce", "#80ffdb")
    for k, centre in enumerate(centres):
        radius, tint = 0.46 * gaps[k], tints[k % len(tints)]
        away = np.hypot(*_offsets(u, v, centre))
        yield away < radius, 0.45 + 0.55 * tint
        yield (away > 0.72 * radius) & (away < radius), 0.75 * tint
        glint = np.hypot(*_offsets(u, v, centre + radius * np.array([-0.3, 0.35])))
        yield glint < 0.2 * radius, 1.0


def grid(u: Array, v: Array, _: np.random.Generator) -> Array:
    """Bands woven over and under each other, with holes between them."""
    across, along = 4.0 * u, 4.0 * v
    upright = np.abs(across % 1.0 - 0.5) < 0.27
    level = np.abs(along % 1.0 - 0.5) < 0.27
    over = (np.floor(across) + np.floor(along)) % 2 == 0
    warm, cold = _colours("#ffb703", "#8e3b02"), _colours("#8ecae6", "#023047")
    edge_upright = np.abs(across % 1.0 - 0.5) > 0.19
    edge_level = np.abs(along % 1.0 - 0.5) > 0.19
    first = np.where(edge_upright[..., None], warm[1], warm[0])
    second = np.where(edge_level[..., None], cold[1], cold[0])
    shown = upright & (over | ~level)
    return _with_alpha(np.where(shown[..., None], first, second), upright | level)


def maze(u: Array, v: Array, random: np.random.Generator) -> Array:
    """Winding paths of one width, rimmed: where waves of one length and all directions sum up."""
    vectors = [(k, m) for k in range(6) for m in range(-5, 6) if (k, m) > (0, 0)]
    waves = [(k, m) for k, m in vectors if 4.5 <= math.hypot(k, m) <= 5.5]
    shifts = random.random(len(waves))
    height = sum(
        np.cos(2.0 * math.pi * (k * u + m * v + shift))
        for (k, m), shift in zip(waves, shifts, strict=True)
    ) / math.sqrt(0.5 * len(waves))
    ground, rim, path = _colours("#264653", "#7f2f1d", "#e9c46a")
    inside = np.where((height > 0.2)[..., None], path, rim)
    return _opaque(np.where((height > -0.2)[..., None], inside, ground))


@_painted
def hearts(u: Array, v: Array, _: np.random.Generator) -> Layers:
    """Upright hearts in rows, alternately red and pink, nothing between them."""
    centres = [((k + 0.5 * (j % 2)) / 4.0, j / 4.0) for j in range(4) for k in range(4)]
    inner, rim = _colours("#e63946", "#ffafcc"), _colours("#8d0f20", "#d6407f")
    for number, centre in enumerate(centres):
        across, up = (offset / 0.084 for offset in _offsets(u, v, np.array(centre)))
        # Two round halves above a point.
        depth = across**2 + (1.15 * up - 0.25 - 0.72 * np.sqrt(np.abs(across))) ** 2
        depth = np.where(np.abs(across) < 1.5, depth, np.inf)
        yield depth < 1.1, rim[number % 2]
        yield depth < 0.62, inner[number % 2]


@_painted
def droplets(u: Array, v: Array, random: np.random.Generator) -> Layers:
    """Slanted drops of three blues, dark at the rim, with a glint; transparent background."""
    centres = _scattered(random, 14, 0.21)
    rim, *inner = _colours("#03045e", "#90e0ef", "#4895ef", "#3f37c9")
    for number, centre in enumerate(centres):
        across, up = (offset / 0.068 for offset in _offsets(u, v, centre))
        across, up = 0.94 * across + 0.34 * up, 0.94 * up - 0.34 * across
        # A disk below, drawn out to a point above.
        taper = np.where(up > 0.0, np.clip(1.0 - up / 2.0, 0.0, 1.0) ** 0.9, 1.0)
        width = np.where(up > 0.0, taper, np.sqrt(np.clip(1.0 - up**2, 0.0, 1.0)))
        depth = np.abs(across) - width
        yield (depth < 0.0) & (up < 2.0) & (up > -1.0), rim
        yield (depth < -0.27) & (up < 1.3) & (up > -0.78), inner[number % 3]
        yield np.hypot(across + 0.3, up + 0.2) < 0.22, 1.0


@_painted
def stars(u: Array, v: Array, random: np.random.Generator) -> Layers:
    """Five-pointed stars of two colours, turned and scattered, on a night-blue ground."""
    centres = _scattered(random, 13, 0.23)
    turns = random.random(len(centres)) * 0.8 - 0.4
    ground, *tints = _colours("#14213d", "#fca311", "#f1faee")
    yield np.ones(u.shape, dtype=bool), ground
    for number, (centre, turn) in enumerate(zip(centres, turns, strict=True)):
        across, up = _offsets(u, v, centre)
        # The angle to the nearest of the five points, and the straight edge that lies there.
        fifth, inner = 2.0 * math.pi / 5.0, 0.45
        half = 0.5 * fifth
        angle = np.abs((np.arctan2(across, up) + turn + half) % fifth - half)
        below = np.sin(angle) * (1.0 - inner * math.cos(half))
        edge = inner * math.sin(half) / (below + np.cos(angle) * inner * math.sin(half))
        yield np.hypot(across, up) < 0.105 * edge, tints[number % 2]


PATTERNS: dict[str, Pattern] = {
    pattern.__name__: pattern
    for pattern in (bubbles, cells, dots, droplets, grid, hearts, maze, stars, stripes)
}
"""All built-in textures by name."""


def _colours(*names: str) -> Array:
    """Return colours such as "#20a040" as numbers in [0, 1], shape [K, 3]."""
    return np.array([ImageColor.getrgb(name)[:3] for name in names]) / 255.0


def _with_alpha(colour: Array, covered: NDArray[np.bool_]) -> Array:
    return np.concatenate([colour, covered[..., None].astype(float)], axis=-1)


def _opaque(colour: Array) -> Array:
    return _with_alpha(colour, np.ones(colour.shape[:2], dtype=bool))


def _offsets(u: Any, v: Any, centre: Array) -> tuple[Any, Any]:
    """Return the shortest offsets of positions (u, v) from `centre` in the periodic unit square."""
    across, along = u - centre[0], v - centre[1]
    return across - np.round(across), along - np.round(along)


def _scattered(random: np.random.Generator, count: int, gap: float) -> list[Array]:
    """Return random positions at least `gap` apart, or less where that is too hard to find."""
    centres: list[Array] = []
    while len(centres) < count:
        centre = random.random(2)
        if all(math.hypot(*_offsets(centre[0], centre[1], other)) >= gap for other in centres):
            centres.append(centre)
        # Lowered at each try, so that the loop ends.
        gap *= 0.999
    return centres
