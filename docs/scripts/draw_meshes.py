"""Draw the built-in targets of 3D morphogenesis, `docs/images/meshes.webp`: each from four sides.

python docs/scripts/draw_meshes.py
"""

from __future__ import annotations

from pathlib import Path

import torch

from npa_envs.ops import orbit
from npa_envs.render import to_uint8, write_filmstrip
from npa_envs.tasks.targets.meshes import builtin_meshes, load_mesh
from npa_envs.tasks.targets.views import ANGLE, DISTANCE, draw_mesh

PICTURE = Path(__file__).resolve().parents[1] / "images" / "meshes.webp"
RESOLUTION = 160
SIDES = 4


def main() -> None:
    """Draw the picture."""
    frames, captions = [], []
    for name in builtin_meshes():
        cameras = orbit(SIDES, 20.0, DISTANCE, ANGLE, width=RESOLUTION, height=RESOLUTION)
        views = torch.from_numpy(draw_mesh(load_mesh(name), cameras))
        frames += list(to_uint8(views.flip(1)))
        captions += [name] * SIDES
    write_filmstrip(PICTURE, frames, captions, columns=2 * SIDES)


if __name__ == "__main__":
    main()
