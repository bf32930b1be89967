"""Draw the built-in textures, `docs/images/textures.webp`: each as two by two tiles.

python docs/scripts/draw_textures.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from npa_envs.render import to_uint8, write_filmstrip
from npa_envs.tasks.targets.textures import builtin_textures, load_texture

PICTURE = Path(__file__).resolve().parents[1] / "images" / "textures.webp"
RESOLUTION = 128


def main() -> None:
    """Draw the picture."""
    names = builtin_textures()
    tiles = [to_uint8(load_texture(name, resolution=RESOLUTION).picture) for name in names]
    write_filmstrip(PICTURE, [np.tile(tile, (2, 2, 1)) for tile in tiles], list(names), columns=3)


if __name__ == "__main__":
    main()
