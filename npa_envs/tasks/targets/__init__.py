"""Targets of the tasks, from pictures, emoji, meshes, views, textures, digits."""
