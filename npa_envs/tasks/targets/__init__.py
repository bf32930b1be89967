"""Targets: what rules are to grow, from pictures, emoji, meshes, views, textures, digits."""
