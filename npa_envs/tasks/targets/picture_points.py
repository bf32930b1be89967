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
from npa_envs.checks import check_count, is_real
from npa_envs.errors import NPAError, shown, suggest
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


DRAWINGS = Path(__file__).resolve().parent / "drawings"
"""Folder of the built-in targets: RGBA pictures of 512 x 512 pixels, named as their targets."""


@functools.cache
def builtin_targets() -> tuple[str, ...]:
    """Return the names of the targets that come with the package, in alphabetical order."""
    return tuple(sorted(path.stem for path in DRAWINGS.glob("*.png")))


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
    if not isinstance(source, str | Path):
        raise NPAError(
            f"target must be a string or a Path, got {type(source).__name__}: "
            "for a Pillow picture in memory use target_from_image"
        )
    if isinstance(source, str) and source in builtin_targets():
        with Image.open(DRAWINGS / f"{source}.png") as drawing:
            name, image = source, drawing.convert("RGBA")
    elif isinstance(source, Path) or looks_like_path(source):
        path = home_path(source)
        name, image = path.stem, (open_image if keep_background else read_image)(path)
    elif is_emoji(source):
        name, image = source, render_emoji(source)
    else:
        raise NPAError(
            "target must be a built-in name, the path of a picture file or one emoji, got "
            f"{shown(source)}: {suggest(source, builtin_targets())}"
        )
    if keep_background:
        image = with_background(image)
    return target_from_image(
        image, name=name, point_count=point_count, extent=extent, device=device
    )


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
