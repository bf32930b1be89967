"""Worlds to watch and to touch in a browser."""
