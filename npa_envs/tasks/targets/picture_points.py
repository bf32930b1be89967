"""Targets to grow in 2D: coloured points of a picture, an emoji or a built-in drawing."""

from __future__ import annotations

import contextlib
import functools
import unicodedata
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from npa_envs.atomic_files import home_path
from npa_envs.checks import check_count
from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest
from npa_envs.tasks.targets.images import (
    MAX_POINT_COUNT,
    OPAQUE,
    looks_like_path,
    read_image,
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


# Pictures of emoji characters, from a colour-emoji font that is installed.

FONTS = (
    "NotoColorEmoji.ttf",
    "Apple Color Emoji.ttc",
    "seguiemj.ttf",
    "Twemoji.ttf",
    "TwemojiMozilla.ttf",
    "JoyPixels.ttf",
)
"""Names of files of colour-emoji fonts, of Linux, macOS, Windows and others."""

# Bitmap fonts open only at the sizes that they hold: 109 is Noto's, 160, 96 ... are Apple's.
_FONT_SIZES = (109, 160, 136, 128, 96, 72, 64, 48, 32)
_INK = (255, 0, 254)
_KEYCAP, _PICTURE_STYLE = "\u20e3", "\ufe0f"


def is_emoji(text: str) -> bool:
    """Return whether text looks like an emoji: a few characters, one of them a picture symbol."""
    if not 0 < len(text) <= 16 or text.isascii():
        return False
    if _KEYCAP in text or _PICTURE_STYLE in text:
        return True
    return any(unicodedata.category(c) == "So" or ord(c) >= 0x1F000 for c in text)


def find_emoji_fonts() -> list[ImageFont.FreeTypeFont]:
    """Return the fonts of `FONTS` that Pillow finds in the system's folders of fonts."""
    fonts = []
    for name in FONTS:
        for size in _FONT_SIZES:
            with contextlib.suppress(OSError):
                fonts.append(ImageFont.truetype(name, size))
                break
    return fonts


def render_emoji(text: str) -> Image.Image:
    """Return the RGBA picture of one emoji."""
    fonts = find_emoji_fonts()
    if not fonts:
        raise MissingDependencyError(
            f"target {shown(text)} is an emoji and needs an installed colour-emoji font, found "
            "none: install one, on Debian and Ubuntu with 'apt install fonts-noto-color-emoji', or "
            "give a picture file or a built-in target"
        )
    singles = [font for font in fonts if font.getlength(text) <= 1.5 * font.getlength("\U0001f600")]
    for font in singles:
        image = _drawn_emoji(font, text)
        if image is not None:
            return image
    names = ", ".join(font.getname()[0] or "a font" for font in fonts)
    if len(singles) < len(fonts):
        raise NPAError(
            f"target {shown(text)} must be one emoji, but {names} draws several: give one of them"
        )
    raise NPAError(
        f"target {shown(text)} must be an emoji that an installed font draws in colour, but none "
        f"of {names} does: give another emoji, a picture file, or install 'fonts-noto-color-emoji'"
    )


def _drawn_emoji(font: ImageFont.FreeTypeFont, text: str) -> Image.Image | None:
    """Return text in a font's own colours as RGBA, without margin; None: it has no such glyph."""
    side = 3 * int(font.size)
    image = Image.new("RGBA", (side, side), (0, 0, 0, 0))
    try:
        ImageDraw.Draw(image).text(
            (side // 4, side // 4), text, font=font, embedded_color=True, fill=_INK
        )
    except (OSError, ValueError):
        return None
    pixels = np.asarray(image).astype(np.float32)
    # Text is drawn with colours multiplied by alpha; undone here, or edges would darken.
    pixels[..., :3] *= 255 / np.maximum(pixels[..., 3:], 1)
    solid = pixels[pixels[..., 3] > 127][:, :3]
    # A font without this emoji draws nothing; one without colours draws in the ink it is given.
    if len(solid) == 0 or np.abs(solid - _INK).max() <= 4:
        return None
    whole = Image.fromarray(pixels.round().clip(0, 255).astype(np.uint8))
    return whole.crop(image.getbbox())
