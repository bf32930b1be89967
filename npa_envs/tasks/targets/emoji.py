"""Pictures of emoji characters, from a colour-emoji font that is installed."""

from __future__ import annotations

import contextlib
import unicodedata

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from npa_envs.errors import MissingDependencyError, NPAError, shown

FONTS = (
    "NotoColorEmoji.ttf",
    "Apple Color Emoji.ttc",
    "seguiemj.ttf",
    "Twemoji.ttf",
    "TwemojiMozilla.ttf",
    "JoyPixels.ttf",
)
"""Files of colour-emoji fonts, of Linux, macOS, Windows and others."""

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


def find_emoji_fonts() -> list[ImageFont.FreeTypeFont]:
    """Return the colour-emoji fonts that Pillow finds in the system's folders of fonts."""
    fonts = []
    for name in FONTS:
        for size in _SIZES:
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
        image = _draw(font, text)
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
