"""Warp kernels, without torch: sorting into cells, perception, its adjoints, updates, pictures."""
