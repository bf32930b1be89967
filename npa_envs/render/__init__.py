"""Pictures and films of particle worlds, and a window that shows them."""

from npa_envs.render.film import write_filmstrip, write_gif, write_mp4, write_png
from npa_envs.render.picture import to_uint8
from npa_envs.render.window import Window
from npa_envs.render.worlds import STYLES, draw_worlds

__all__ = [
    "STYLES",
    "Window",
    "draw_worlds",
    "to_uint8",
    "write_filmstrip",
    "write_gif",
    "write_mp4",
    "write_png",
]
