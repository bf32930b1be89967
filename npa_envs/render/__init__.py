"""Pictures and films of particle worlds, and a window that shows them.

Wrong arguments and files that cannot be written raise NPAError.
"""

from npa_envs.render.colours import to_uint8
from npa_envs.render.display import Shown, Window, show, show_worlds
from npa_envs.render.picture_files import (
    turntable_frames,
    write_filmstrip,
    write_gif,
    write_mp4,
    write_png,
    write_webp,
)
from npa_envs.render.point_files import write_gaussians, write_points, write_splat
from npa_envs.render.worlds import STYLES, draw_worlds

__all__ = [
    "STYLES",
    "Shown",
    "Window",
    "draw_worlds",
    "show",
    "show_worlds",
    "to_uint8",
    "turntable_frames",
    "write_filmstrip",
    "write_gaussians",
    "write_gif",
    "write_mp4",
    "write_png",
    "write_points",
    "write_splat",
    "write_webp",
]
