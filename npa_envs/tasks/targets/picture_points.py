"""Targets to grow in 2D: coloured points of a picture, an emoji or a built-in drawing."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from npa_envs.atomic_files import home_path
from npa_envs.checks import check_count
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.tasks.targets.images import (
    MAX_POINT_COUNT,
    OPAQUE,
    is_emoji,
    looks_like_path,
    read_image,
    render_emoji,
    require_opaque_pixels,
    resample,
    summary_of,
    with_background,
)
from npa_envs.tasks.targets.notes import tell


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
    summary: str = ""
    """What was read, in one line; empty for a built-in target."""

    @property
    def mean_colour(self) -> Tensor:
        """Mean red, green and blue of the points (dimensionless), shape [3]."""
        return self.colours.mean(dim=0)

    def to(self, device: str | torch.device) -> PointTarget:
        """Return the same target with its tensors on another device."""
        return replace(self, points=self.points.to(device), colours=self.colours.to(device))


TARGET_SIDE = 1.8
"""Side of the smallest square around the origin that contains a target [length units]; pictures
show [-1, 1]²."""

DRAWINGS = Path(__file__).resolve().parent / "drawings"
"""Folder of the built-in targets: RGBA pictures of 512 x 512 pixels, named as their targets."""


@functools.cache
def builtin_targets() -> tuple[str, ...]:
    """Return the names of the targets that come with the package, in alphabetical order."""
    return tuple(sorted(path.stem for path in DRAWINGS.glob("*.png")))


def load_target(
    source: str | Path, *, point_count: int = 4096, keep_background: bool = False
) -> PointTarget:
    """Make a target from a built-in name, a picture file or an emoji.

    A string is a built-in name if there is one, else a path if the file exists or the string has a
    suffix or a folder in it, else an emoji. A `Path` is always a path. The picture is scaled, and
    pixels with an alpha of at least one half become points, about `point_count`. The plain
    background of a picture without transparency is removed. With `keep_background`, for
    photographs, the whole rectangle is used, white where it is transparent.
    """
    check_count("point_count", point_count, ": try 4096", at_most=MAX_POINT_COUNT)
    if not isinstance(source, str | Path):
        raise NPAError(
            f"target must be a string or a Path, got {type(source).__name__}: "
            "for a Pillow picture in memory use target_from_image"
        )
    summary = ""
    if isinstance(source, str) and source in builtin_targets():
        with Image.open(DRAWINGS / f"{source}.png") as drawing:
            name, image = source, drawing.convert("RGBA")
    elif isinstance(source, Path) or looks_like_path(source):
        path = home_path(source)
        name, (image, summary) = path.stem, read_image(path, keep_background=keep_background)
    elif is_emoji(source):
        name, image = source, render_emoji(source)
        summary = summary_of(source, image, "drawn by an installed font")
    else:
        raise NPAError(
            "target must be a built-in name, the path of a picture file or one emoji, got "
            f"{shown(source)}: {suggest(source, builtin_targets())}"
        )
    if keep_background:
        image = with_background(image)
    target = target_from_image(image, name=name, point_count=point_count)
    tell(summary)
    return replace(target, summary=summary)


def target_from_image(image: Image.Image, *, name: str, point_count: int = 4096) -> PointTarget:
    """Make a target called `name` from the opaque pixels of a picture, scaled to `point_count`."""
    rgba = image.convert("RGBA")
    require_opaque_pixels(rgba, label=name)
    pixels = np.array(resample(rgba, point_count, label=name))
    rows, columns = np.nonzero(pixels[..., 3] >= OPAQUE)
    grid = np.stack([columns, -rows], axis=1).astype(np.float64)
    grid -= grid.mean(axis=0)
    # Half a pixel more on either side: a point represents a square of one pixel.
    pixel_size = TARGET_SIDE / (2 * float(np.abs(grid).max()) + 1)
    colours = pixels[rows, columns, :3].astype(np.float32) / 255
    return PointTarget(
        name=name,
        points=torch.tensor(grid * pixel_size, dtype=torch.float32),
        colours=torch.tensor(colours, dtype=torch.float32),
        pixel_size=pixel_size,
    )
