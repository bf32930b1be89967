"""Pictures of emoji characters, from any colour-emoji font that is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import unicodedata
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from npa_envs.errors import MissingDependencyError, NPAError, shown

# Bitmap fonts open only at the sizes that they hold: 109 is Noto's, 160, 96 ... are Apple's.
_SIZES = (109, 160, 136, 128, 96, 72, 64, 48, 32)
_INK = (255, 0, 254)
_KEYCAP, _PICTURE_STYLE = "\u20e3", "\ufe0f"


def is_emoji(text: str) -> bool:
    """Return whether text looks like an emoji: a few characters, one of them a picture symbol."""
    if not 0 < len(text) <= 16 or text.isascii():
        return False
    if _KEYCAP in text or _PICTURE_STYLE in text:
        return True
    return any(unicodedata.category(c) == "So" or ord(c) >= 0x1F000 for c in text)


def find_emoji_fonts() -> list[Path]:
    """Return the files of the installed fonts that may hold colour emoji, the likeliest first."""
    found: dict[Path, None] = {}
    for path in (*_fonts_of_fontconfig(), *_fonts_of_known_folders()):
        found.setdefault(path.resolve())
    return sorted(found, key=lambda path: "color" not in path.name.lower())


def render_emoji(text: str) -> Image.Image:
    """Return the RGBA picture of one emoji."""
    fonts = find_emoji_fonts()
    if not fonts:
        raise MissingDependencyError(
            f"target {shown(text)} is an emoji and needs an installed colour-emoji font, found "
            "none: install one, on Debian and Ubuntu with 'apt install fonts-noto-color-emoji', or "
            "give a picture file or a built-in target"
        )
    several = False
    for path in fonts:
        font = _open_font(path)
        if font is None:
            continue
        if font.getlength(text) > 1.5 * font.getlength("\U0001f600"):
            several = True
            continue
        image = _draw(font, text)
        if image is not None:
            return image
    names = ", ".join(path.name for path in fonts)
    if several:
        raise NPAError(
            f"target {shown(text)} must be one emoji, but {names} draws several: give one of them"
        )
    raise NPAError(
        f"target {shown(text)} must be an emoji that an installed font draws in colour, but none "
        f"of {names} does: give another emoji, a picture file, or install 'fonts-noto-color-emoji'"
    )


def _open_font(path: Path) -> ImageFont.FreeTypeFont | None:
    for size in _SIZES:
        try:
            return ImageFont.truetype(str(path), size)
        except OSError:
            continue
    return None


def _draw(font: ImageFont.FreeTypeFont, text: str) -> Image.Image | None:
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


def _fonts_of_fontconfig() -> Iterator[Path]:
    program = shutil.which("fc-list")
    if program is None:
        return
    try:
        listing = subprocess.run(
            [program, "--format", "%{file}\n", ":color=true"],
            capture_output=True,
            encoding="utf-8",
            errors="surrogateescape",
            timeout=20,
            check=False,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return
    yield from (Path(line) for line in sorted(set(listing.splitlines())) if line)


def _fonts_of_known_folders() -> Iterator[Path]:
    home = Path.home()
    folders = [home / ".fonts", home / ".local/share/fonts", Path("/usr/local/share/fonts")]
    if sys.platform == "darwin":
        folders += [home / "Library/Fonts", Path("/Library/Fonts"), Path("/System/Library/Fonts")]
    elif sys.platform == "win32":
        folders = [Path(os.environ.get("WINDIR", "C:/Windows")) / "Fonts"]
    else:
        folders.append(Path("/usr/share/fonts"))
    for folder in folders:
        for path in sorted(folder.rglob("*.[to]t[fc]")):
            if any(mark in path.name.lower() for mark in ("emoji", "seguiemj")):
                yield path
