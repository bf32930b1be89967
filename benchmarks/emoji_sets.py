"""Random sets of emoji for development and for tests."""

from __future__ import annotations

import argparse
import contextlib
import random
import unicodedata

from PIL import Image

from npa_envs.errors import NPAError
from npa_envs.tasks.targets.images import render_emoji

BLOCKS = (
    (0x1F300, 0x1F5FF),
    (0x1F600, 0x1F64F),
    (0x1F680, 0x1F6FF),
    (0x1F900, 0x1F9FF),
    (0x1FA70, 0x1FAFF),
)
"""Code points of pictures in Unicode, first and last."""

SKIN_TONES = (0x1F3FB, 0x1F3FF)
"""Those of them that change others."""

DRAWN = 12
"""Number of pictures for development, and for tests."""


def single_emoji() -> dict[str, Image.Image]:
    """Return the picture of every one-character emoji in the installed font, by name."""
    emoji = {}
    for code in (code for first, last in BLOCKS for code in range(first, last + 1)):
        name = unicodedata.name(chr(code), "")
        if name and not SKIN_TONES[0] <= code <= SKIN_TONES[1]:
            with contextlib.suppress(NPAError):
                emoji[name.lower().replace(" ", "-")] = render_emoji(chr(code))
    return emoji


def draw_pictures(arguments: argparse.Namespace) -> None:
    """Write random emoji as PNG files, always the same ones of the same font."""
    emoji = single_emoji()
    drawn = random.Random(0).sample(list(emoji), 2 * DRAWN)
    for number, name in enumerate(drawn):
        folder = arguments.out / ("development" if number < DRAWN else "test")
        folder.mkdir(parents=True, exist_ok=True)
        emoji[name].save(folder / f"{name}.png", optimize=True)
