"""Targets to grow in 2D: coloured points of a picture, an emoji or a built-in drawing."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from npa_envs.errors import NPAError, suggest
from npa_envs.tasks.targets.drawings import DRAWINGS
from npa_envs.tasks.targets.emoji import is_emoji, render_emoji
from npa_envs.tasks.targets.images import (
    OPAQUE,
    looks_like_path,
    read_image,
    require_opaque_pixels,
    resample,
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
    """Distance h of two neighbouring points [length units]."""

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
    device: str | torch.device = "cpu",
) -> PointTarget:
    """Make a target from a built-in name, a picture file or an emoji.

    A string is taken as a built-in name if it is one, else as a path if the file exists or the
    string has a suffix or a folder in it, else as an emoji. A `Path` is always a path. Pixels with
    an alpha of at least one half become points; a picture without transparency is cut out of its
    plain background.

    Args:
        source: A name from `builtin_targets`, the path of a PNG, JPEG or WebP file, or one emoji.
        point_count: The number of points aimed at; the target's own may differ by a few, where the
            picture does not allow it more closely.
        extent: Side of the smallest square around the origin, the mean of the points, that holds
            the whole target [length units]. The picture shows [-1, 1]; the default leaves a margin
            of 0.1 on each side.
        device: Where the tensors are made.

    Raises:
        NPAError: The name is unknown, the file is missing, unreadable, damaged or fully
            transparent, it has neither transparency nor a plain background, it is too thin for so
            few points, or a number is out of range.
        MissingDependencyError: An emoji is asked for, and no colour-emoji font is installed.
    """
    if isinstance(point_count, bool) or not isinstance(point_count, int) or point_count < 1:
        raise NPAError(
            f"point_count must be an integer of at least 1, got {point_count!r}: try 4096"
        )
    if not (math.isfinite(extent) and extent > 0):
        raise NPAError(f"extent must be finite and above 0 length units, got {extent!r}: try 1.8")
    name, image = load_target_image(source)
    return target_from_image(
        image, name=name, point_count=point_count, extent=extent, device=device
    )


def load_target_image(source: str | Path) -> tuple[str, Image.Image]:
    """Return the name and the full-size RGBA picture of what `load_target` accepts as source.

    Args:
        source: A built-in name, the path of a picture file, or one emoji.

    Raises:
        NPAError: As for `load_target`.
        MissingDependencyError: As for `load_target`.
    """
    if not isinstance(source, str | Path):
        raise NPAError(
            f"target must be a string or a Path, got {type(source).__name__}: "
            "for a Pillow picture in memory use target_from_image"
        )
    if isinstance(source, str) and source in DRAWINGS:
        return source, DRAWINGS[source]()
    if isinstance(source, Path) or looks_like_path(source):
        path = Path(os.path.expanduser(source))
        return path.stem, read_image(path)
    if is_emoji(source):
        return source, render_emoji(source)
    raise NPAError(
        f"target must be a built-in name, the path of a picture file or one emoji, got {source!r}: "
        f"{suggest(source, DRAWINGS)}"
    )


def target_from_image(
    image: Image.Image,
    *,
    name: str,
    point_count: int = 4096,
    extent: float = 1.8,
    device: str | torch.device = "cpu",
) -> PointTarget:
    """Make a target from the opaque pixels of a picture in memory.

    Args:
        image: A Pillow picture, used as it is: what it has no transparency for is all target.
        name: The target's name.
        point_count: The number of points aimed at.
        extent: Side of the square around the origin that the target just fits in [length units].
        device: Where the tensors are made.

    Raises:
        NPAError: No pixel is opaque, or the opaque part is too thin for so few points.
    """
    rgba = image.convert("RGBA")
    require_opaque_pixels(rgba, label=name)
    pixels = np.array(resample(rgba, point_count, label=name))
    rows, columns = np.nonzero(pixels[..., 3] >= OPAQUE)
    grid = np.stack([columns, -rows], axis=1).astype(np.float64)
    grid -= grid.mean(axis=0)
    # Half a pixel more on either side: a point stands for a square of one pixel.
    pixel_size = extent / (2 * float(np.abs(grid).max()) + 1)
    colours = pixels[rows, columns, :3].astype(np.float32) / 255
    return PointTarget(
        name=name,
        points=torch.tensor(grid * pixel_size, dtype=torch.float32, device=device),
        colours=torch.tensor(colours, dtype=torch.float32, device=device),
        pixel_size=pixel_size,
    )
