"""Pictures and films of particle worlds."""

from npa_envs.render.film import write_filmstrip, write_gif, write_mp4, write_png
from npa_envs.render.picture import to_uint8

__all__ = ["to_uint8", "write_filmstrip", "write_gif", "write_mp4", "write_png"]
