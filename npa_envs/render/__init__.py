"""Pictures and films of particle worlds, and a window that shows them."""

from npa_envs.render.colours import to_uint8
from npa_envs.render.film import turntable_frames, write_filmstrip, write_gif, write_mp4, write_png
from npa_envs.render.point_files import write_gaussians, write_points, write_splat
from npa_envs.render.window import Window
from npa_envs.render.worlds import STYLES, draw_worlds

__all__ = [
    "STYLES",
    "Window",
    "draw_worlds",
    "to_uint8",
    "turntable_frames",
    "write_filmstrip",
    "write_gaussians",
    "write_gif",
    "write_mp4",
    "write_png",
    "write_points",
    "write_splat",
]
