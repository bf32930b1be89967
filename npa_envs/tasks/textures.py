"""What a texture is learned from: a built-in pattern or a picture, as colour sums and density."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from npa_envs.errors import NPAError, suggest
from npa_envs.tasks.images import open_image, require_opaque_pixels
from npa_envs.tasks.patterns import PATTERNS, draw_pattern


@dataclass(frozen=True, eq=False)
class TextureTarget:
    """A texture on a square of R x R pixels."""

    name: str
    """The built-in name, or the picture file's name without its suffix."""

    picture: Tensor
    """Red, green and blue, each times the density, and the density, dimensionless, shape
    [R, R, 4], float32; rows point up, as in the pictures of worlds."""

    tiles: bool
    """Whether opposite edges fit together."""

    @property
    def coverage(self) -> float:
        """Mean density: how much of the square particles should cover (dimensionless)."""
        return float(self.picture[..., 3].double().mean())

    @property
    def mean_colour(self) -> Tensor:
        """Mean red, green and blue of what is covered (dimensionless), shape [3]."""
        sums = self.picture.double().sum(dim=(0, 1))
        return (sums[:3] / sums[3]).to(self.picture)


def builtin_textures() -> tuple[str, ...]:
    """Return the names of the textures that come with the package, in alphabetical order."""
    return tuple(sorted(PATTERNS))


def load_texture(
    source: str | Path,
    *,
    resolution: int = 128,
    tiles: bool = False,
    device: str | torch.device = "cpu",
) -> TextureTarget:
    """Make a target from a built-in name or a picture file.

    The density is the picture's alpha: a picture without transparency is to be covered evenly, and
    shows its background in colour; of one with transparency the background stays empty. The largest
    square in the middle of a picture is taken, scaled to the resolution.

    Args:
        source: A name from `builtin_textures`, or the path of a PNG, JPEG or WebP file.
        resolution: Pixels R along each side.
        tiles: Whether the opposite edges of a picture file fit together; built-in textures tile.
        device: Where the tensor is made.

    Raises:
        NPAError: The name is unknown, the file is missing, unreadable, damaged, fully transparent
            or smaller than 2 x 2 pixels, or the resolution is not positive.
    """
    if not isinstance(source, str | Path) or not str(source):
        raise NPAError(
            f"target must be a built-in texture or the path of a picture, got {source!r}: "
            "for example 'cells'"
        )
    if isinstance(resolution, bool) or not isinstance(resolution, int) or resolution < 1:
        raise NPAError(f"resolution must be an integer of at least 1, got {resolution!r}: try 128")
    if isinstance(source, str) and source in PATTERNS:
        drawn = draw_pattern(source, resolution)
        return _target(source, drawn, True, device)
    path = Path(os.path.expanduser(source))
    if isinstance(source, str) and not _looks_like_path(source, path):
        raise NPAError(
            "target must be a built-in texture or the path of a picture file, "
            f"got {source!r}: {suggest(source, PATTERNS)}"
        )
    image = open_image(path)
    require_opaque_pixels(image, label=str(path))
    side = min(image.size)
    if side < 2:
        raise NPAError(
            f"target {str(path)!r} must have at least 2 x 2 pixels, got {image.width} x "
            f"{image.height}: give a larger picture"
        )
    left, top = (image.width - side) // 2, (image.height - side) // 2
    square = image.crop((left, top, left + side, top + side)).convert("RGBa")
    kind = Image.Resampling.BOX if side >= resolution else Image.Resampling.BICUBIC
    # Pillow's premultiplied mode: colours of transparent pixels do not leak.
    scaled = square.resize((resolution, resolution), kind)
    return _target(path.stem, np.asarray(scaled)[::-1] / 255.0, tiles, device)


def _target(
    name: str, picture: np.ndarray, tiles: bool, device: str | torch.device
) -> TextureTarget:
    tensor = torch.tensor(np.ascontiguousarray(picture), dtype=torch.float32, device=device)
    return TextureTarget(name, tensor, tiles)


def _looks_like_path(source: str, path: Path) -> bool:
    if "/" in source or "\\" in source or path.suffix:
        return True
    try:
        return path.exists()
    except (OSError, ValueError):
        return False
